"""Convex collision shapes: a few coarse convex parts of an object, and the mass properties of their union."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from kmn_jax.errors import InputError

FLAT_SHARE = 1e-3  # a surface thinner than this share of the diagonal counts as flat
QHULL_OPTIONS = "Qt Pp"  # triangulated, and no remarks on the terminal
STEP_SHARE = 1e-3  # a cut runs this share of the diagonal beside a flat face, so that the face falls to one side


@dataclass(frozen=True)
class HullConfig:
    """How an object is cut into convex parts. Lengths are shares of its diagonal, volumes of its convex hull.

    Parts thinner than `thickness` jam or tunnel in simulation, whatever its step, so no cut makes one: an object whose
    pins or sheets are thinner keeps them inside of a thicker part.
    """

    parts: int = 8
    thickness: float = 0.1
    gain: float = 0.02  # a cut must empty this share of the volume
    faces: int = 6  # cuts tried a direction: beside its largest flat faces, ...
    spaced: int = 3  # ... and evenly spaced

    def __post_init__(self) -> None:
        if self.parts < 1 or self.faces < 0 or self.spaced < 0:
            raise InputError(f"hulls: parts = {self.parts} must be 1 or more, faces and spaced 0 or more")
        if not 0 < self.thickness < 1 or not 0 < self.gain < 1:
            raise InputError(f"hulls: thickness = {self.thickness} and gain = {self.gain} must lie between 0 and 1")


@dataclass(frozen=True, eq=False)
class CollisionShape:
    """What physics needs to know of an object: convex parts, in the object's frame and unit, and how mass is spread.

    `inertia` is that of unit mass about the centre, along the columns of the rotation `R_object_principal`.
    """

    parts: tuple[Float[np.ndarray, "_ 3"], ...]
    diagonal: float
    volume: float
    center: Float[np.ndarray, "3"]
    R_object_principal: Float[np.ndarray, "3 3"]
    inertia: Float[np.ndarray, "3"]


class _Piece(NamedTuple):
    triangles: Float[np.ndarray, "t 3 3"]  # corners
    outline: Any  # scipy.spatial.ConvexHull of outermost points


def _fibonacci_sphere(count: int) -> Float[np.ndarray, "{count} 3"]:
    index = np.arange(count) + 0.5
    z, angle = 1 - 2 * index / count, index * np.pi * (1 + 5**0.5)
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


DIRECTIONS = _fibonacci_sphere(256)  # cuts are compared on the outermost points in these; hulls have all corners


def collision_shape(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], config: HullConfig = HullConfig()
) -> CollisionShape:
    """Cut a surface along its frame's axes where that empties most volume; return the parts' hulls, for `settle`.

    The surface need be neither closed nor consistently wound: the parts cover all of it, holes and recesses too where
    no cut opens them. The result is deterministic.

    Raises:
        InputError: the surface is empty, not finite, or flat.
    """
    corners = triangle_corners(vertices, triangles)
    low = corners.min(axis=(0, 1))
    diagonal = float(np.linalg.norm(corners.max(axis=(0, 1)) - low))
    unit = (corners - low) / (diagonal or 1.0)
    centered = unit.reshape(-1, 3) - unit.mean(axis=(0, 1))
    least = float(np.ptp(centered @ np.linalg.eigh(centered.T @ centered)[1], axis=0).min())
    if least < FLAT_SHARE:
        raise InputError(f"the surface is flat: its thickness is {least:.1e} of its diagonal, but must be {FLAT_SHARE}")
    pieces = [_piece(unit)]
    whole = pieces[0].outline.volume
    cuts = [_best_cut(pieces[0], whole, config)]
    while len(pieces) < config.parts:
        best = int(np.argmax([gain for gain, _ in cuts]))
        halves = cuts[best][1]
        if not halves:
            break
        pieces[best : best + 1] = halves
        cuts[best : best + 1] = [_best_cut(half, whole, config) for half in halves]
    parts = tuple(_hull_corners(piece.triangles) * diagonal + low for piece in pieces)
    volume, center, inertia = _mass_properties(parts)
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return CollisionShape(parts, diagonal, volume, center, axes, moments / volume)


def triangle_corners(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> Float[np.ndarray, "t 3 3"]:
    """Return the corners of a surface's triangles; raise InputError for one that is empty or not finite."""
    vertices, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(triangles)
    if len(triangles) == 0 or len(vertices) == 0:
        raise InputError("the surface has no triangles: there is nothing to see or to collide with")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise InputError(f"triangles name vertices from {triangles.min()} to {triangles.max()} of {len(vertices)}")
    corners = vertices[triangles]
    if not np.isfinite(corners).all():
        raise InputError("the surface has vertices that are NaN or infinite: export the object again")
    return corners


def _piece(triangles: np.ndarray) -> _Piece:
    return _Piece(triangles, _outline(_distinct(triangles.reshape(-1, 3))))


def _distinct(points: np.ndarray) -> np.ndarray:
    """Return points without their copies (told apart by one projection, which is fast)."""
    return points[np.unique(points @ [1.0, 2**0.5, 3**0.5], return_index=True)[1]]


def _hull_corners(triangles: np.ndarray) -> np.ndarray:
    from scipy.spatial import ConvexHull

    hull = ConvexHull(_distinct(triangles.reshape(-1, 3)), qhull_options=QHULL_OPTIONS)
    return hull.points[hull.vertices]


def _outermost(points: np.ndarray) -> np.ndarray:
    if len(points) <= len(DIRECTIONS):
        return points
    return points[np.unique(np.argmax(DIRECTIONS @ points.T, axis=1))]


def _outline(points: np.ndarray) -> Any:
    """Return the convex hull of the outermost points, or None where they are flat."""
    from scipy.spatial import ConvexHull, QhullError

    if len(points) < 4:
        return None
    try:
        return ConvexHull(_outermost(points), qhull_options=QHULL_OPTIONS)
    except QhullError:
        return None


def _thickness(hull: Any) -> float:
    """Return the least extent along the normals of the facets."""
    along = hull.points[hull.vertices] @ hull.equations[:, :3].T
    return float(np.ptp(along, axis=0).min())


def _best_cut(piece: _Piece, whole: float, config: HullConfig) -> tuple[float, list[_Piece]]:
    """Return the volume that the best allowed cut empties, and its two halves (none where no cut is worth it)."""
    best, gain = None, config.gain * whole
    if config.parts > 1 and _thickness(piece.outline) >= config.thickness:
        points = _distinct(piece.triangles.reshape(-1, 3))
        for axis in range(3):
            offsets = _offsets(piece.triangles, axis, config)
            slabs = np.searchsorted(offsets, points[:, axis], side="right")
            outermost = [_outermost(points[slabs == slab]) for slab in range(len(offsets) + 1)]
            for number, offset in enumerate(offsets):
                border = _crossings(piece.triangles, axis, offset)
                sides = outermost[: number + 1], outermost[number + 1 :]
                outlines = [_outline(np.concatenate([*side, border])) for side in sides]
                if None in outlines or piece.outline.volume - sum(outline.volume for outline in outlines) <= gain:
                    continue
                if min(_thickness(outline) for outline in outlines) >= config.thickness:
                    gain = piece.outline.volume - sum(outline.volume for outline in outlines)
                    best = (axis, offset)
    return (0.0, []) if best is None else (gain, [_piece(side) for side in _split(piece.triangles, *best)])


def _offsets(triangles: np.ndarray, axis: int, config: HullConfig) -> np.ndarray:
    """Return where to try cuts: on both sides of the largest flat faces across the axis, and evenly spaced."""
    along = triangles[:, :, axis]
    low, high = along.min() + config.thickness / 2, along.max() - config.thickness / 2
    if low >= high:
        return np.zeros(0)
    flat = np.ptp(along, axis=1) < STEP_SHARE
    normals = np.cross(triangles[flat, 1] - triangles[flat, 0], triangles[flat, 2] - triangles[flat, 0])
    bins = np.round(along[flat].mean(axis=1) / STEP_SHARE).astype(np.int64)
    places, inverse = np.unique(bins, return_inverse=True)
    areas = np.bincount(inverse, weights=np.linalg.norm(normals, axis=1), minlength=len(places))
    largest = places[np.argsort(-areas, kind="stable")[: config.faces]] * STEP_SHARE
    spaced = np.linspace(low, high, config.spaced + 2)[1:-1]
    offsets = np.concatenate([largest - 1.5 * STEP_SHARE, largest + 1.5 * STEP_SHARE, spaced])
    return np.unique(offsets[(offsets > low) & (offsets < high)])


def _crossings(triangles: np.ndarray, axis: int, offset: float) -> np.ndarray:
    """Return the points where edges cross a plane."""
    low, high = triangles[:, :, axis].min(axis=1), triangles[:, :, axis].max(axis=1)
    crossed = triangles[(low < offset) & (high >= offset)]
    start, end = crossed.reshape(-1, 3), np.roll(crossed, -1, axis=1).reshape(-1, 3)
    across = (start[:, axis] < offset) != (end[:, axis] < offset)
    start, end = start[across], end[across]
    share = (offset - start[:, axis]) / (end[:, axis] - start[:, axis])
    return start + share[:, None] * (end - start)


def _split(triangles: np.ndarray, axis: int, offset: float) -> list[np.ndarray]:
    """Return the triangles below and above a plane; those across it are cut in three."""
    below = triangles[:, :, axis] < offset
    count = below.sum(axis=1)
    sides = [[triangles[count == 3]], [triangles[count == 0]]]
    for lone, side in ((1, 0), (2, 1)):  # the corner that is alone on its side comes first
        chosen = triangles[count == lone]
        first = np.argmax(below[count == lone] == (lone == 1), axis=1)
        a, b, c = (chosen[np.arange(len(chosen)), (first + k) % 3] for k in range(3))
        ab = a + ((offset - a[:, axis]) / (b[:, axis] - a[:, axis]))[:, None] * (b - a)
        ac = a + ((offset - a[:, axis]) / (c[:, axis] - a[:, axis]))[:, None] * (c - a)
        sides[side].append(np.stack([a, ab, ac], axis=1))
        sides[1 - side] += [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
    return [np.concatenate(side) for side in sides]


def _mass_properties(parts: Sequence[np.ndarray]) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume, centre and inertia about it at unit density, summed over convex parts."""
    from scipy.spatial import ConvexHull

    volume, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    origin = np.concatenate(parts).mean(axis=0)
    for part in parts:
        hull = ConvexHull(part, qhull_options=QHULL_OPTIONS)
        inside = part.mean(axis=0) - origin
        corners = part[hull.simplices] - origin
        # tetrahedra from an inner point to the facets: exact integrals of 1, x and x x^T
        volumes = np.abs(np.linalg.det(corners - inside)) / 6
        points = np.concatenate([corners, np.broadcast_to(inside, (len(corners), 1, 3))], axis=1)
        total = points.sum(axis=1)
        volume += volumes.sum()
        first += volumes @ total / 4
        second += np.einsum("t,ti,tj->ij", volumes, total, total) / 20
        second += np.einsum("t,tki,tkj->ij", volumes, points, points) / 20
    center = first / volume
    second -= volume * np.outer(center, center)
    return float(volume), center + origin, np.trace(second) * np.eye(3) - second
