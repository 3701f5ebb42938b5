"""What of a scene is still to be searched: where no seed is near and no likely pose explains the points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from kmn_jax.detection._frames import into, placed
from kmn_jax.detection._scene import Scene
from kmn_jax.detection._search import Candidates
from kmn_jax.detection._voxels import cell_numbers
from kmn_jax.objects import Part

# Shares of the object's diameter.
EXPLAINED = 0.05  # points so near to the surface of a found part are done
SEARCHED = 0.5  # those so near to a seed
SEARCHED_FINELY = 0.2  # the same, as long as rounds find new copies
AMONG = 1.0  # points so near to the centre of a promising pose are searched finely
_CELL = 0.4  # points are stray if few others lie in their cell
_LEAST_CROWD = 16  # points of a cell: fewer make no crop
_SURFACE_POINTS = 1024  # on a part
_NEARLY = 1.001  # times what is near: farther seeds need not be found


class Coverage(NamedTuple):
    """The state of a search."""

    left: Bool[np.ndarray, " r"]  # of the scene's points: foreground that no likely pose explains
    away: Float[np.ndarray, " r"]  # from the nearest seed that is near; it is not kept up where a point is not left
    places: Float[np.ndarray, "p 3"]  # centres of promising poses
    barren: int  # rounds since one was found in a new place


def nothing_covered(scene: Scene) -> Coverage:
    """Return the state before the first round."""
    return Coverage(scene.foreground.copy(), np.full(len(scene.points), np.inf), np.zeros((0, 3)), 0)


def cover(
    before: Coverage,
    scene: Scene,
    part: Part,
    found: Candidates,
    likely: Bool[np.ndarray, " s"],
    promising: Bool[np.ndarray, " s"],
    reach: float,
) -> Coverage:
    """Return the state after a round, in which likely poses explain points.

    A promising pose is in a new place if none before it is nearer than `reach`.
    """
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(before.left)
    away = before.away.copy()
    seeds, near = cKDTree(scene.points[found.seed_rows]), SEARCHED * part.diameter * _NEARLY
    distance, _ = seeds.query(scene.points[rows], distance_upper_bound=near, workers=2)
    away[rows] = np.minimum(away[rows], distance)

    centers = (found.T_camera_object @ np.append((part.minimum + part.maximum) / 2, 1))[:, :3]
    left = unexplained(before.left, scene, part, found.T_camera_object[likely])

    apart = np.linalg.norm(before.places[None] - centers[promising][:, None], axis=2)
    new = (apart > reach).all(axis=1).any()
    return Coverage(left, away, np.concatenate([before.places, centers[promising]]), 0 if new else before.barren + 1)


def unexplained(
    rows: Bool[np.ndarray, " r"], scene: Scene, part: Part, T_camera_object: Float[np.ndarray, "k 4 4"]
) -> Bool[np.ndarray, " r"]:
    """Return which of a scene's chosen points lie near to the part's surface at none of the poses."""
    size = min(len(part.points), _SURFACE_POINTS)
    near = EXPLAINED * part.diameter + float(np.sqrt(part.area / size))
    result = rows.copy()
    result[rows] = ~near_surface(scene.points[rows], part.points[:size], T_camera_object.astype(np.float64), near)
    return result


def near_surface(
    points: Float[np.ndarray, "n 3"],
    surface: Float[np.ndarray, "m 3"],
    T_camera_object: Float[np.ndarray, "k 4 4"],
    near: float,
) -> Bool[np.ndarray, " n"]:
    """Return which points are nearer than `near` to one of those of an object's surface, at any of the poses."""
    from scipy.spatial import cKDTree

    tree, apart = cKDTree(surface), np.ones(len(points), dtype=bool)
    middle = (surface.min(axis=0) + surface.max(axis=0)) / 2
    reach = float(np.linalg.norm(surface - middle, axis=1).max()) + near
    across = np.ascontiguousarray(points[:, 0])
    for pose in T_camera_object:
        center = placed(pose, middle)
        rows = np.flatnonzero((np.abs(across - center[0]) <= reach) & apart)  # most are ruled out by that
        rows = rows[((points[rows] - center) ** 2).sum(axis=1) <= reach**2]
        distance, _ = tree.query(into(pose, points[rows]), distance_upper_bound=near)
        apart[rows[np.isfinite(distance)]] = False
    return ~apart


def to_search(state: Coverage, scene: Scene, part: Part, patience: int | None) -> Bool[np.ndarray, " r"]:
    """Return the points to spread the next seeds over, without stray ones; none when the search is done.

    It is searched finely among promising poses, as copies lie among copies, or all over while there is none, but no
    more after `patience` rounds that found nothing promising; None searches all over, and goes on.
    """
    far = _crowded(state.left & (state.away > SEARCHED * part.diameter), scene, part)
    if far.any() or (patience is not None and state.barren >= patience):
        return far
    fine = state.left & (state.away > SEARCHED_FINELY * part.diameter)
    if patience is not None and len(state.places):
        fine[fine] = near_surface(scene.points[fine], state.places, np.eye(4)[None], AMONG * part.diameter)
    return _crowded(fine, scene, part)


def _crowded(chosen: Bool[np.ndarray, " r"], scene: Scene, part: Part) -> Bool[np.ndarray, " r"]:
    rows = np.flatnonzero(chosen)
    cells = cell_numbers(scene.points[rows], _CELL * part.diameter)
    _, which, counts = np.unique(cells, return_inverse=True, return_counts=True)
    result = np.zeros_like(chosen)
    result[rows[counts[which] >= _LEAST_CROWD]] = True
    return result
