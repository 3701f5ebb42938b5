"""Results for people and programs: a table, JSON and BOP's csv."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kmn_jax.bop import BopEstimate, write_results
from kmn_jax.detection._result import Detection, Detections, pose_notes
from kmn_jax.objects import Part
from kmn_jax.units import place_text

_COLUMNS = ("rank", "probability", "visible", "gap", "inliers", "x", "y", "z", "rotation vector (degrees)")


def as_json(found: Detections, object_name: str, scene_name: str, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result as JSON values, see docs/detect.md; `facts`, such as the command's settings, are added."""
    return {**found.to_dict(), "object": object_name, "scene": scene_name, **facts}


def json_text(found: Mapping[str, Any]) -> str:
    """Return JSON values as text, in which other characters than ASCII are escaped."""
    return json.dumps(found, indent=1, allow_nan=False)


def write_bop_csv(
    found: Detections, path: str | Path, scene_id: int = 0, image_id: int = 0, object_id: int = 1
) -> None:
    """Write a result as rows of BOP's csv; the score is the probability, the time that of the whole image."""
    seconds = found.timing.total
    estimates = [
        BopEstimate(scene_id, image_id, object_id, pose.probability, pose.T_scene_object, seconds)
        for pose in found.poses
    ]
    write_results(path, estimates, found.unit)


def table(found: Detections, accepted: float) -> str:
    """Return a result as text for a terminal."""
    lines = [f"note: {warning}" for warning in found.warnings]
    if found.poses:
        likely = sum(pose.probability >= accepted for pose in found.poses)
        frame = "" if found.poses[0].T_base_object is None else ", in the robot's frame"
        doubtful = f"{len(found.poses) - likely} doubtful"
        lines.append(f"{found.part}: {likely} found, {doubtful} (lengths in {found.unit}{frame})")
        rows = [_COLUMNS, *(_row(rank, pose, found.unit) for rank, pose in enumerate(found.poses, start=1))]
        if found.poses[0].grasps is not None:
            last = ("grasps", *(str(len(pose.grasps or ())) for pose in found.poses))
            rows = [(*row, cell) for row, cell in zip(rows, last, strict=True)]
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        lines += ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
        lines += [f"note: {note}" for note in pose_notes(found)]
    else:
        lines.append(f"{found.part}: nothing found, because {found.reason}")
    if found.unexplained is not None:
        lines.append(f"{found.unexplained:.0%} of the foreground is on no pose that was found")
    stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in found.timing.stages.items())
    running = found.timing.total - found.timing.compile
    lines.append(f"{running:.2f} s ({stages}) and {found.timing.compile:.2f} s of compiling")
    return "\n".join(lines)


def _row(rank: int, pose: Detection, unit: str) -> tuple[str, ...]:
    shown = pose.T_scene_object if pose.T_base_object is None else pose.T_base_object
    turn = ", ".join(f"{angle:.1f}" for angle in np.degrees(_rotation_vector(shown[:3, :3])))
    numbers = (f"{pose.probability:.2f}", f"{pose.visible_fraction:.2f}", f"{pose.runner_up_gap:.2f}")
    return (str(rank), *numbers, str(pose.num_inliers), *place_text(shown[:3, 3], unit), turn)


def _rotation_vector(rotation: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def describe(part: Part) -> str:
    """Return name, size and symmetry of a part for people."""
    x, y, z = part.maximum - part.minimum
    size = f"{x:.4g} x {y:.4g} x {z:.4g} {part.unit}, diameter {part.diameter:.4g} {part.unit}"
    return f"{part.name}: {size}, {part.symmetries}"
