"""Synthetic clouds with normals that tests and benchmarks share."""

from __future__ import annotations

import numpy as np


def box_cloud(seed: int, count: int, size: tuple[float, float, float] = (40.0, 25.0, 15.0)) -> np.ndarray:
    """Return (count, 6) float32 points on the surface of a box centred at the origin, with outward normals."""
    rng = np.random.default_rng(seed)
    extent = np.asarray(size)
    areas = np.array([extent[1] * extent[2], extent[0] * extent[2], extent[0] * extent[1]])
    axis = rng.choice(3, size=count, p=areas / areas.sum())
    side = rng.choice([-1.0, 1.0], size=count)
    points = (rng.random((count, 3)) - 0.5) * extent
    points[np.arange(count), axis] = side * extent[axis] / 2
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = side
    return np.concatenate([points, normals], axis=1).astype(np.float32)


def scene_crop(seed: int, count: int) -> np.ndarray:
    """Return (count, 6) points of three boxes in random poses, the seed point at the origin."""
    rng = np.random.default_rng(seed)
    parts = []
    for index in range(3):
        cloud = box_cloud(seed + 100 * index, count // 3 + 1).astype(np.float64)
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        offset = rng.normal(size=3) * 15 * index
        parts.append(np.concatenate([cloud[:, :3] @ rotation.T + offset, cloud[:, 3:] @ rotation.T], axis=1))
    crop = rng.permutation(np.concatenate(parts))[:count]
    crop[:, :3] -= crop[0, :3]
    return crop.astype(np.float32)
