"""What stands beside the panels of a picture: the part in the colours of its keypoints, and the list of poses."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
from jaxtyping import Float

from kmn_jax.detection import Detection, Detections
from kmn_jax.geometry import Camera
from kmn_jax.objects import Part
from kmn_jax.viz._raster import Canvas, as_bytes, brightness, distinct_colors, surface_discs
from kmn_jax.viz._truth import nearest_keypoint

LIKELY = 0.5  # poses below that probability are drawn pale
NOT_THE_PART = (0.30, 0.32, 0.36)  # the colour of points of crops that are on no copy
_LISTED = 16  # poses
_LISTED_WARNINGS = 6
_PART_SIDE = 300  # pixels


def summary(found: Detections) -> str:
    """Return a result in half a sentence."""
    if not found.poses:
        return found.reason or "no pose was found"
    count, likely = len(found.poses), sum(pose.probability >= LIKELY for pose in found.poses)
    return f"{count} pose{'s' if count > 1 else ''}, {likely} of them likely"


def ranked(found: Detections) -> list[tuple[int, Detection]]:
    """Return the poses with their ranks, from 1 on."""
    return list(enumerate(found.poses, start=1))


def center_of(part: Part) -> Float[np.ndarray, "3"]:
    """Return the centre of the box around a part."""
    return (part.minimum + part.maximum) / 2


def draw_part(axis: Any, part: Part, direction: tuple[float, float, float], title: str) -> None:
    """Draw the part's surface in the colours of its nearest keypoints, as seen from a direction of its frame."""
    z = -np.array(direction) / np.linalg.norm(direction)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    R_view_object = np.stack([x, np.cross(z, x), z])
    points, normals, radii = surface_discs(part.points, part.normals)
    away, side = 4 * part.diameter, _PART_SIDE
    focal = 0.95 * side * away / part.diameter
    canvas = Canvas(Camera(focal, focal, side / 2, side / 2, side, side), 0.0, 0.0, 1.0, side, side)
    normals = normals @ R_view_object.T
    index, _ = canvas.seen_discs((points - center_of(part)) @ R_view_object.T + [0, 0, away], normals, radii)
    colors = distinct_colors(part.num_keypoints)[nearest_keypoint(part, points)]
    image = np.ones((side, side, 4))
    image[..., 3] = index >= 0
    image[..., :3] = (colors * (0.3 + 0.7 * brightness(normals))[:, None])[index]
    axis.imshow(as_bytes(image), interpolation="nearest")
    axis.set_axis_off()
    axis.set_title(title, fontsize=10)


def draw_list(axis: Any, found: Detections) -> None:
    """List the poses, and what is to be said of them."""
    from matplotlib.patches import Rectangle

    axis.set_axis_off()
    axis.set(xlim=(0, 1), ylim=(_LISTED + 2 * _LISTED_WARNINGS + 2, 0))
    colors = distinct_colors(max(1, len(found.poses)))
    headings = ("rank", "probability", "visible", "inliers") if found.poses else ()
    places = (0.10, 0.52, 0.78, 1.0)
    rows = [("black" if pose.probability >= LIKELY else "0.5", _cells(rank, pose)) for rank, pose in ranked(found)]
    for row, (color, cells) in enumerate([("0.35", headings), *rows[:_LISTED]]):
        for place, cell in zip(places, cells, strict=False):
            axis.text(place, row, cell, fontsize=9.5, va="center", color=color, ha="left" if place < 0.5 else "right")
        if row:
            axis.add_patch(Rectangle((0, row - 0.3), 0.05, 0.6, color=colors[row - 1]))
    notes = list(found.warnings)
    notes += [f"{rank}: {note}" for rank, pose in ranked(found) for note in pose.warnings]
    if len(found.poses) > _LISTED:
        notes.insert(0, f"and {len(found.poses) - _LISTED} more poses")
    below = min(len(found.poses), _LISTED) + 1.6
    if len(notes) > _LISTED_WARNINGS:
        notes[_LISTED_WARNINGS - 1 :] = [f"and {len(notes) - _LISTED_WARNINGS + 1} more warnings"]
    for note in notes:
        text = textwrap.fill(textwrap.shorten(note, 100, placeholder=" ..."), 50)
        axis.text(0.0, below, text, fontsize=8.5, va="top", color="#a04000", parse_math=False)
        below += 1 + text.count("\n")


def _cells(rank: int, pose: Detection) -> tuple[str, ...]:
    mark = " !" if pose.warnings else ""
    return f"{rank}{mark}", f"{pose.probability:.2f}", f"{pose.visible_fraction:.0%}", str(pose.num_inliers)
