"""Predictions for the points of crops against known poses, in the colour coding of the published figure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from kmn_jax.detection import Detection, into, symmetry_transforms
from kmn_jax.objects import Part

TRUTH_COLORS = {
    "background, taken for background": (1.0, 1.0, 1.0),
    "background, taken for the object": (0.85, 0.10, 0.10),
    "object, taken for background": (0.98, 0.83, 0.05),
    "object, but keypoint wrong": (0.15, 0.30, 0.95),
    "object, and keypoint right": (0.10, 0.70, 0.20),
}
"""Colours in [0, 1] by what a point of a crop is and was taken for; `truth_codes` returns rows of it."""
BACKGROUND, FALSE_PART, MISSED, WRONG_KEYPOINT, RIGHT = range(5)  # the rows of TRUTH_COLORS
_ON_SURFACE = 0.02  # of the diameter: points nearer than that to a copy lie on it
_DISC = 0.6  # radius of what a surface point stands for, of the square root of its share of the area
_SEED_REACH = 0.05  # of the diameter: a seed is on the nearest copy, unless that is further away


def truth_codes(part: Part, detection: Detection, truth: Sequence[Float[np.ndarray, "4 4"]]) -> Int[np.ndarray, " n"]:
    """Return the row of `TRUTH_COLORS` for each point of a detection's crop, given all true poses `T_scene_object`.

    The crop is of the copy that its seed is on; other copies are background. A point is on that copy within 2 % of the
    part's diameter, and its true keypoint is the nearest one; of poses that look the same, the one that agrees most
    often counts. Part and scene have the same unit.
    """
    prediction = detection.prediction
    codes = np.where(prediction.on_object, FALSE_PART, BACKGROUND)
    if not truth:
        return codes
    seeds = np.concatenate([into(T, detection.seed[None].astype(np.float64)) for T in truth])
    reach = surface_distances(part, seeds)
    if reach.min() > _SEED_REACH * part.diameter:
        return codes
    points = into(truth[int(np.argmin(reach))], prediction.points.astype(np.float64))
    on_copy = surface_distances(part, points) <= _ON_SURFACE * part.diameter
    codes[on_copy] = np.where(prediction.on_object[on_copy], WRONG_KEYPOINT, MISSED)
    both = np.flatnonzero(on_copy & prediction.on_object)
    rights = [
        nearest_keypoint(part, into(T.astype(np.float64), points[both])) == prediction.keypoint[both]
        for T in symmetry_transforms(part.symmetries)
    ]
    codes[both[max(rights, key=lambda right: int(right.sum()))]] = RIGHT
    return codes


def nearest_keypoint(part: Part, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Return the keypoint that is nearest to each point of the object's frame."""
    keypoints = part.points[: part.num_keypoints].astype(np.float64) - part.origin
    return ((keypoints**2).sum(axis=1) - 2 * (points - part.origin) @ keypoints.T).argmin(axis=1)


def surface_distances(part: Part, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return distances of points of the object's frame from the surface, as discs around the part's points."""
    from scipy.spatial import cKDTree

    radius = _DISC * np.sqrt(part.area / len(part.points))
    count = min(6, len(part.points))
    _, rows = cKDTree(part.points).query(points, k=count)
    rows = rows.reshape(len(points), count)
    offsets = points[:, None] - part.points[rows]
    height = (offsets * part.normals[rows]).sum(axis=2)
    aside = np.sqrt(np.maximum((offsets**2).sum(axis=2) - height**2, 0))
    from_discs = np.hypot(height, np.maximum(aside - radius, 0)).min(axis=1)
    # Discs stick out over edges, but not by more than the part's box allows.
    from_box = np.linalg.norm(np.maximum(np.maximum(part.minimum - points, points - part.maximum), 0), axis=1)
    return np.maximum(from_discs, from_box)
