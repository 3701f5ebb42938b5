"""What stands beside the panels of a picture: the part in the colours of its keypoints, and the list of poses."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from kmn_jax.detection import DetectConfig, Detections, pose_notes
from kmn_jax.geometry import Camera
from kmn_jax.objects import Part
from kmn_jax.viz._raster import Canvas
from kmn_jax.viz._shading import as_bytes, brightness, distinct_colors, surface_hexagons
from kmn_jax.viz._truth import nearest_keypoint

ACCEPTED = DetectConfig().accepted  # poses below that probability are drawn pale
NOT_THE_PART = (0.30, 0.32, 0.36)  # the colour of points of crops that are on no copy
UNEXPLAINED = (0.62, 0.40, 0.22)  # that of foreground on no pose
_LISTED = 16  # poses
_ROWS, _COLUMNS = 30, 50  # of text in the list
_NOTE_LINE, _NOTE_GAP = 0.72, 0.35  # rows: the lines of notes stand closer
_PART_SIDE = 300  # pixels


def summary(found: Detections) -> str:
    """Return a result in half a sentence."""
    if not found.poses:
        return found.reason or "no pose was found"
    accepted = sum(pose.probability >= ACCEPTED for pose in found.poses)
    return f"{accepted} found, {len(found.poses) - accepted} doubtful"


def center_of(part: Part) -> Float[np.ndarray, "3"]:
    """Return the centre of the box around a part."""
    return (part.minimum + part.maximum) / 2


def draw_part(axis: Any, part: Part, direction: tuple[float, float, float], title: str) -> None:
    """Draw the part's surface in the colours of its nearest keypoints, as seen from a direction of its frame."""
    z = -np.array(direction) / np.linalg.norm(direction)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    R_view_object = np.stack([x, np.cross(z, x), z])
    normals, corners = surface_hexagons(part)
    colors = distinct_colors(part.num_keypoints)[nearest_keypoint(part, corners.mean(axis=1))]
    normals = normals @ R_view_object.T
    focal, side = 3.8 * _PART_SIDE, _PART_SIDE  # the part fills most of the image from four diameters away
    canvas = Canvas(Camera(focal, focal, side / 2, side / 2, side, side), 0.0, 0.0, 1.0, side, side)
    index = canvas.seen(normals, (corners - center_of(part)) @ R_view_object.T + [0, 0, 4 * part.diameter])
    image = np.ones((side, side, 4))
    image[..., 3] = index >= 0
    image[..., :3] = (colors * (0.3 + 0.7 * brightness(normals))[:, None])[index]
    axis.imshow(as_bytes(image), interpolation="nearest")
    axis.set_axis_off()
    axis.set_title(title, fontsize=10)


def draw_list(axis: Any, found: Detections) -> None:
    """List the poses, and the warnings about them."""
    axis.set_axis_off()
    axis.set(xlim=(0, 1), ylim=(_ROWS, 0))
    if found.poses:
        axis.text(0.1, 0, "rank probability visible inliers", fontsize=9, va="center", color="0.35", family="monospace")
    for row, (pose, color) in enumerate(zip(found.poses, distinct_colors(_LISTED), strict=False), start=1):
        mark = "!" if pose.warnings else " "
        line = f"{row:>3}{mark} {pose.probability:>11.2f} {pose.visible_fraction:>7.0%} {pose.num_inliers:>7}"
        axis.text(0, row, "■", fontsize=12, va="center", color=color)
        gray = "black" if pose.probability >= ACCEPTED else "0.5"
        axis.text(0.1, row, line, fontsize=9, va="center", color=gray, family="monospace")
    notes = [*dict.fromkeys(found.warnings), *pose_notes(found)]
    if len(found.poses) > _LISTED:
        notes.insert(0, f"and {len(found.poses) - _LISTED} more poses")
    below = min(len(found.poses), _LISTED) + 1.6
    for text in fitting([textwrap.fill(note, _COLUMNS) for note in notes], _ROWS - below):
        axis.text(0.0, below, text, fontsize=8.5, va="top", color="#a04000", parse_math=False)
        below += _rows_of(text)


def fitting(notes: Sequence[str], rows: float) -> list[str]:
    """Return the first notes, as many as fit whole; if that is not all, the last text says how many are left out."""
    ends = np.cumsum([_rows_of(note) for note in notes])
    if len(notes) == 0 or ends[-1] <= rows:
        return list(notes)
    whole = int((ends <= rows - _rows_of("and more")).sum())
    left = len(notes) - whole
    return [*notes[:whole], f"and {left} more {'notes' if left > 1 else 'note'}"]


def _rows_of(note: str) -> float:
    return _NOTE_LINE * (1 + note.count("\n")) + _NOTE_GAP
