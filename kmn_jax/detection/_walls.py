"""The walls of a bin: planes that stand upright at the edge of what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from kmn_jax.detection._planes import Plane, dominant_plane, extent, fitted_plane

_SAMPLE = 20_000  # points among which walls are looked for
_TRIED = 10  # planes, of which some are walls
_SHARE = 0.01  # of the points, which a wall holds
_BEYOND = 0.05  # share of the points, and of the floor's, that may lie outside of a wall: rims, errors
_ALONG_SIGHT = 0.6  # cosine between a wall's normal and the line of sight, where the ground is not known
_UPRIGHT = 0.3  # cosine between the normals of a wall and the ground
_PARALLEL = 0.9
_STRAY = 0.005  # share of the points that may lie behind a floor, measured in error
_FLOOR_SHARE = 0.01


@dataclass(frozen=True, eq=False)
class Ground:
    """What is known of the plane that parts lie on, or of a layer of their tops: walls stand upright on it."""

    plane: Plane
    points: Float32[np.ndarray, "f 3"]  # of the floor, as far as it was measured; none of a layer of tops


def off_walls(
    points: Float32[np.ndarray, "n 3"],
    ground: Ground | None,
    floor_is_known: bool,
    margin: float,
    least_extent: float,
    random_seed: int = 0,
) -> Bool[np.ndarray, " n"]:
    """Return which points, in the sensor's frame, are neither of a bin's walls nor outside of them; all without walls.

    A wall is longer than `least_extent`, stands upright and has nearly all points on one side of it, those of the floor
    too: behind a row of parts on a table the table goes on. There is one at most to each side. Points nearer to it than
    `margin` are its own. If the floor is not known, what lies deepest between two walls is left out, too: in a full bin
    too little of it is seen to be found as a large plane. Something always stays.
    """
    generator = np.random.default_rng(random_seed)
    sample = points if len(points) <= _SAMPLE else points[generator.integers(0, len(points), _SAMPLE)]
    borders = _walls(sample, ground, margin, least_extent, random_seed)
    if not floor_is_known:
        inside = _inside(sample, borders, margin)
        hidden = _floor_between(sample[inside], borders, margin)
        borders += [hidden] if hidden is not None and (hidden.height(sample[inside]) < -margin).any() else []
    return _inside(points, borders, margin)


def _walls(
    points: Float32[np.ndarray, "n 3"], ground: Ground | None, margin: float, least_extent: float, random_seed: int
) -> list[Plane]:
    """Return walls, whose normals point out of the bin."""
    walls: list[Plane] = []
    kept: Bool[np.ndarray, " n"] = np.ones(len(points), dtype=bool)
    open_points = kept.copy()  # not yet in a plane that was tried
    for _ in range(_TRIED):
        plane = dominant_plane(points[open_points], margin, random_seed, local=True)
        if plane is None:
            break
        height = plane.height(points)
        within = open_points & (np.abs(height) <= margin)
        if within.sum() < _SHARE * len(points):
            break
        open_points &= ~within
        if (kept & (height > margin)).sum() > (kept & (height < -margin)).sum():
            plane, height = Plane(-plane.normal, -plane.offset), -height
        inner = kept & (height < -margin)
        if (
            inner.any()
            and (height > margin).mean() <= _BEYOND
            and extent(points[within]) > least_extent
            and all(plane.normal @ wall.normal < _PARALLEL for wall in walls)
            and _stands(plane, points[within], ground, margin)
        ):
            walls.append(plane)
            kept = inner
            open_points &= kept
    return walls


def _inside(points: Float32[np.ndarray, "n 3"], borders: list[Plane], margin: float) -> Bool[np.ndarray, " n"]:
    inside: Bool[np.ndarray, " n"] = np.ones(len(points), dtype=bool)
    for border in borders:
        inside &= border.height(points) < -margin
    return inside


def _stands(plane: Plane, points: Float32[np.ndarray, "n 3"], ground: Ground | None, margin: float) -> bool:
    """Tell whether a plane is upright, and the floor ends there."""
    if ground is not None:
        ends = not len(ground.points) or (plane.height(ground.points) > margin).mean() <= _BEYOND
        return bool(ends and abs(plane.normal @ ground.plane.normal) < _UPRIGHT)
    sight = points.astype(np.float64).mean(axis=0)
    return bool(abs(plane.normal @ sight) < _ALONG_SIGHT * np.linalg.norm(sight))


def _floor_between(points: Float32[np.ndarray, "n 3"], walls: list[Plane], margin: float) -> Plane | None:
    """Return the plane across the walls that lies farthest down, if enough of it is seen."""
    up = _across(walls)
    if up is None or not len(points):
        return None
    up = up if up @ points.astype(np.float64).mean(axis=0) >= 0 else -up  # away from the sensor
    level = float(np.quantile(points.astype(np.float64) @ up, 1 - _STRAY))
    plane = fitted_plane(points, up, level, 2 * margin)
    height = plane.height(points)
    seen, below = (np.abs(height) <= margin).mean(), (height > margin).mean()
    lies = abs(plane.normal @ up) > _PARALLEL
    return plane if lies and seen >= _FLOOR_SHARE and below <= _STRAY else None


def _across(walls: list[Plane]) -> Float64[np.ndarray, "3"] | None:
    """Return the direction along all walls; None if fewer than two differ."""
    for wall in walls[1:]:
        if abs(wall.normal @ walls[0].normal) < _PARALLEL:
            direction = np.cross(walls[0].normal, wall.normal)
            return direction / np.linalg.norm(direction)
    return None
