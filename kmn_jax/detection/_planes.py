"""Planes in clouds of points, by random triples and least squares."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int

_TRIPLES = 1000  # of points, each of which may lie in the plane: one of a fifth of the points gets 8 of them
_SAMPLE = 5000  # points by which planes are compared
_REFINEMENTS = 3
_CHUNK = 100  # planes at a time
_ROUNDED = 16  # points: by as many fewer in single precision, a plane may still be the one of most
_NEAR = 64  # neighbours in the sample, of which a local triple is made


@dataclass(frozen=True, eq=False)
class Plane:
    """Points x with normal · x = offset. Where the offset is not below zero, behind the plane, seen from the sensor at
    the origin, is above it."""

    normal: Float64[np.ndarray, "3"]
    offset: float  # its distance from the origin

    def height(self, points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Return how far points are behind the plane, below zero in front of it."""
        return points.astype(np.float64) @ self.normal - self.offset


def dominant_plane(
    points: Float[np.ndarray, "n 3"], margin: float, random_seed: int = 0, local: bool = False
) -> Plane | None:
    """Return the plane with the most points nearer to it than `margin`, refined by all of those; None if there is none.

    Planes through three random points are compared: the same `random_seed` gives the same plane. Those of `local`
    triples lie near to each other, which finds planes that hold few of the points.
    """
    generator = np.random.default_rng(random_seed)
    if len(points) < 3:
        return None
    center = points.astype(np.float64).mean(axis=0)
    everything = points.astype(np.float64) - center
    sample = everything if len(points) <= _SAMPLE else everything[generator.integers(0, len(points), _SAMPLE)]
    corners = _local_triples(sample, generator) if local else sample[generator.integers(0, len(sample), (_TRIPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    proper = length > 0
    if not proper.any():
        return None
    normals, corner = normals[proper] / length[proper, None], corners[proper, 0]
    offsets = (normals * corner).sum(axis=1)

    with ThreadPoolExecutor(2) as pool:  # NumPy lets others run as it counts
        rough = _counts(sample.astype(np.float32), normals.astype(np.float32), offsets.astype(np.float32), margin, pool)
        most = np.flatnonzero(rough >= rough.max() - _ROUNDED)
        best = int(most[_counts(sample, normals[most], offsets[most], margin, pool).argmax()])
    found = fitted_plane(everything, normals[best], float(offsets[best]), margin)
    offset = found.offset + float(found.normal @ center)
    return Plane(found.normal, offset) if offset >= 0 else Plane(-found.normal, -offset)


def _counts(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "t 3"],
    offsets: Float[np.ndarray, " t"],
    margin: float,
    pool: ThreadPoolExecutor,
) -> Int[np.ndarray, " t"]:
    """Return how many points are not farther from each plane than `margin`."""

    def counts_of(start: int) -> Int[np.ndarray, " c"]:
        some = slice(start, start + _CHUNK)
        away = normals[some] @ points.T
        away -= offsets[some, None]
        near = np.abs(away, out=away) <= margin
        return np.array([np.count_nonzero(row) for row in near])  # many times as fast as a sum

    return np.concatenate(list(pool.map(counts_of, range(0, len(normals), _CHUNK))))


def fitted_plane(
    points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"], offset: float, margin: float
) -> Plane:
    """Return a plane fitted, in a few steps, to the points that are nearer to it than `margin`."""
    for _ in range(_REFINEMENTS):
        inner = points[np.abs(points @ normal - offset) <= margin].astype(np.float64)
        if len(inner) < 3:
            break
        middle = inner.mean(axis=0)
        _, axes = np.linalg.eigh((inner - middle).T @ (inner - middle))
        normal = axes[:, 0] if axes[:, 0] @ normal >= 0 else -axes[:, 0]
        offset = float(normal @ middle)
    return Plane(normal, offset)


def extent(points: Float[np.ndarray, "n 3"]) -> float:
    """Return the longer side of what is seen of a plane, without the outermost percent of its points."""
    offsets = points.astype(np.float64) - points.astype(np.float64).mean(axis=0)
    axis = np.linalg.eigh(offsets.T @ offsets)[1][:, 2]
    low, high = np.percentile(offsets @ axis, (1, 99))
    return float(high - low)


def _local_triples(sample: Float[np.ndarray, "n 3"], generator: np.random.Generator) -> Float[np.ndarray, "t 3 3"]:
    """Return triples of a point and two of its neighbours in the sample."""
    from scipy.spatial import cKDTree

    first = generator.integers(0, len(sample), _TRIPLES)
    count = min(_NEAR, len(sample))
    _, near = cKDTree(sample).query(sample[first], k=count, workers=2)
    columns = generator.integers(0, count, (_TRIPLES, 2))
    others = np.take_along_axis(near, columns, axis=1)
    return sample[np.concatenate([first[:, None], others], axis=1)]
