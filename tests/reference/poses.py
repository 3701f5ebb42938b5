"""Random rigid poses."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tests.reference.meshes import random_rotations


def some_poses(count: int, seed: int = 0, spread: float = 100.0) -> Float[np.ndarray, "c 4 4"]:
    """Return rotations drawn evenly, with translations up to `spread` along each axis."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = random_rotations(count, seed)
    poses[:, :3, 3] = np.random.default_rng(seed).uniform(-spread, spread, (count, 3))
    return poses
