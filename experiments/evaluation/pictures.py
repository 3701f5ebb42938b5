"""Cases of a method as pictures: what was seen, what was said of it, the pose, and a rival's where that is right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.evaluation.cases import Case
from experiments.evaluation.methods import Ours
from experiments.evaluation.plots import as_png, new_figure
from experiments.evaluation.scores import THRESHOLD
from kmn_jax.detection import Detection
from kmn_jax.objects import ObjectModel, Part
from kmn_jax.viz import TRUTH_COLORS, distinct_colors, draw_part, truth_codes

_DOT = 3.0
_RIGHT, _WRONG, _RIVAL = "tab:green", "tab:red", "tab:blue"


@dataclass(frozen=True)
class Picture:
    """A PNG file of the report; one with a title comes first, under it."""

    content: bytes
    title: str = ""
    text: str = ""


@dataclass(frozen=True)
class RivalPose:
    """What another method found in the same case."""

    method: str
    T_camera_object: Float[np.ndarray, "4 4"]
    error: float  # ADI in diameters


@dataclass(frozen=True)
class Shown:
    """A case with the pose that was found."""

    title: str
    model: ObjectModel
    case: Case
    T_camera_object: Float[np.ndarray, "4 4"] | None
    error: float  # ADI in diameters
    rival: RivalPose | None = None


def case_grid(method: Ours, shown: Sequence[Shown]) -> bytes:
    """Return a PNG with a row for each case: the object, the crop, the prediction, its accuracy, the pose."""
    figure, canvas = new_figure((16, 3.3 * len(shown)))
    grid = figure.subplots(len(shown), 5, squeeze=False)
    for row, one in zip(grid, shown, strict=True):
        _draw(row, method, one)
    handles = [_dot(color, name) for name, color in TRUTH_COLORS.items()]
    handles += [_dot(_RIGHT, "our pose, right"), _dot(_WRONG, "our pose, wrong")]
    if any(one.rival is not None for one in shown):
        handles.append(_dot(_RIVAL, "the other method's pose"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=9)
    return as_png(canvas)


def _draw(row: Sequence[Any], method: Ours, one: Shown) -> None:
    part = method.part(one.model)
    draw_part(row[0], part, (0.5, 0.6, -0.62), one.model.name[:28])
    points = _thinned(one.case.points)
    shade = points[:, 2]
    _scatter(row[1], points, shade, f"{one.title}: {one.case.name}", cmap="bone_r")
    said = method.predict(part, one.case)
    colors = np.tile([0.75, 0.75, 0.75], (len(said.points), 1))
    colors[said.on_object] = distinct_colors(part.num_keypoints)[said.keypoint[said.on_object]]
    _scatter(row[2], said.points, colors, "prediction: keypoints", box=points)
    codes = truth_codes(part, _detection(one, said), list(one.case.T_camera_object))
    _scatter(row[3], said.points, np.array(list(TRUTH_COLORS.values()))[codes], "accuracy", box=points, dark=True)
    _scatter(row[4], points, np.full((len(points), 3), 0.8), _verdict(one), box=points)
    if one.T_camera_object is not None:
        placed = _seen(part, one.T_camera_object)
        row[4].scatter(*_plane(placed, points), s=_DOT, c=_RIGHT if one.error < THRESHOLD else _WRONG, lw=0)
    if one.rival is not None:
        placed = _seen(part, one.rival.T_camera_object)
        row[4].scatter(*_plane(placed, points), s=_DOT, c=_RIVAL, lw=0)


def _verdict(one: Shown) -> str:
    if one.T_camera_object is None:
        ours = "no pose"
    elif not np.isfinite(one.error):
        ours = "pose: far from every copy"
    else:
        ours = f"pose: ADI {one.error:.3f} diameters"
    return ours if one.rival is None else f"{ours}\n{one.rival.method}: ADI {one.rival.error:.3f} diameters"


def _seen(part: Part, T_camera_object: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 3"]:
    """Return the side of a part that looks at the camera, under a pose."""
    points = part.points @ T_camera_object[:3, :3].T + T_camera_object[:3, 3]
    normals = part.normals @ T_camera_object[:3, :3].T
    return points[(points * normals).sum(axis=1) < 0]


def _detection(one: Shown, said: Any) -> Detection:
    """Return what the colours of the truth need: the crop, and where its seed is."""
    return Detection(
        T_scene_object=np.eye(4),
        probability=0.0,
        num_inliers=0,
        visible_fraction=0.0,
        runner_up_gap=0.0,
        explained=0.0,
        violated=0.0,
        occluded=0.0,
        unknown=0.0,
        seed=one.case.points[0],
        prediction=said,
    )


def _thinned(points: Float[np.ndarray, "n 3"], most: int = 4000) -> Float[np.ndarray, "m 3"]:
    return points[:: max(1, len(points) // most)]


def _plane(points: Float[np.ndarray, "n 3"], around: Float[np.ndarray, "m 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return where points lie in the picture, from the middle of others."""
    middle = around.mean(axis=0)
    x, y = ((points[:, axis] / points[:, 2] - middle[axis] / middle[2]) * middle[2] for axis in (0, 1))
    return x, y


def _scatter(
    axis: Any,
    points: Float[np.ndarray, "n 3"],
    color: np.ndarray,
    title: str,
    box: Float[np.ndarray, "m 3"] | None = None,
    cmap: str | None = None,
    dark: bool = False,
) -> None:
    axis.scatter(*_plane(points, points if box is None else box), s=_DOT, c=color, cmap=cmap, lw=0)
    axis.set_title(title, fontsize=9)
    axis.set(aspect="equal", xticks=[], yticks=[])
    axis.invert_yaxis()
    if dark:
        axis.set_facecolor((0.35, 0.37, 0.4))


def _dot(color: tuple[float, float, float] | str, name: str) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], ls="", marker="o", color=color, markeredgecolor="0.5", label=name)
