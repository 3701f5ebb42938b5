"""What a page says: its heading, the facts of a pose, and texts to copy."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from kmn_jax.detection import Detection, Detections, warnings_once
from kmn_jax.units import place_text
from kmn_jax.viz._legend import summary
from kmn_jax.viz._shading import as_bytes

_LEAST_COMPILING = 0.05  # seconds that are told
# The button is beside the box that it copies. Older ways of copying work on other machines' pages, too.
_COPY = (
    "const box = this.previousElementSibling; box.select();"
    " this.textContent = document.execCommand('copy') ? 'Copied' : 'Press Ctrl+C'"
)


def heading(found: Detections, scan: str | None, num_points: int, doing: str = "") -> str:
    """Return what stands above everything: the result in a sentence, the scan, the times, and warnings."""
    timing = found.timing
    seconds = f"searched in {timing.total - timing.compile:.2f} s"
    if timing.compile > _LEAST_COMPILING:
        seconds += f", after compiling for {timing.compile:.2f} s"
    name = "scan" if scan is None else html.escape(scan)
    lines = [f"<b>{html.escape(summary(found))}</b>", f"{name} of {num_points:,} points, {seconds}"]
    lines += [_warning(text) for text in warnings_once(found)[0]]
    if doing:
        lines.append(f"<b>{html.escape(doing)}</b>")
    return small("<br>".join(lines))


def facts(pose: Detection, color: Float[np.ndarray, "3"], warnings: Sequence[str]) -> str:
    """Return a pose in a line, and the warnings that it alone has."""
    red, green, blue = as_bytes(color)
    swatch = f'<span style="color: rgb({red}, {green}, {blue})">&#9632;</span>'
    numbers = f"probability {pose.probability:.2f}, {pose.visible_fraction:.0%} visible, {pose.num_inliers} inliers"
    return small("<br>".join([f"{swatch} {numbers}", *map(_warning, warnings)]))


def details(pose: Detection, part: str, unit: str) -> str:
    """Return all numbers of a pose, and its JSON to copy."""
    shown = pose.T_scene_object
    turn = ", ".join(f"{value:.1f}" for value in np.degrees(_rotation_vector(shown[:3, :3])))
    rows = {
        f"x, y, z ({unit})": ", ".join(place_text(shown[:3, 3], unit)),
        "rotation vector (degrees)": turn,
        "explained, violated": f"{pose.explained:.0%}, {pose.violated:.0%}",
        "occluded, unknown": f"{pose.occluded:.0%}, {pose.unknown:.0%}",
        "runner-up gap": f"{pose.runner_up_gap:.2f}",
    }
    if pose.T_base_object is not None:
        rows[f"for the robot ({unit})"] = ", ".join(place_text(pose.T_base_object[:3, 3], unit))
    if pose.grasps is not None:
        rows["free grasps"] = str(len(pose.grasps))
    cells = "".join(f"<tr><td>{html.escape(name)}&nbsp;</td><td>{value}</td></tr>" for name, value in rows.items())
    values = json.dumps({"object": part, "unit": unit, **pose.to_dict()}, allow_nan=False)
    return small(f"<table>{cells}</table>{copy_box(values, 5)}")


def copy_box(text: str, rows: int) -> str:
    """Return a box with a text, and a button that copies it."""
    return (
        f'<textarea readonly rows="{rows}" style="width: 100%; font: 0.75rem monospace">{html.escape(text)}</textarea>'
        f'<button type="button" onclick="{html.escape(_COPY)}">Copy</button>'
    )


def small(content: str) -> str:
    """Return a piece of the panel."""
    return f'<div style="font-size: 0.8rem; line-height: 1.35; padding: 0 0.75em 0.4em">{content}</div>'


def _warning(text: str) -> str:
    return f'<span style="color: #b34700">{html.escape(text)}</span>'


def _rotation_vector(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())
