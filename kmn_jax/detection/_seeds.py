"""Seeds: the points of a scene around which poses are searched."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.detection._scene import Scene, nearest_row
from kmn_jax.detection._voxels import cell_numbers
from kmn_jax.geometry import PaddedCloud, farthest_point_indices
from kmn_jax.objects import Part
from kmn_jax.programs import kept

NUM_SEEDS = 32  # that are spread in one call: one number, so one compilation
SPACING = 0.4  # diameters: seeds are at most about so far apart, as far as there are enough


def seeds_over(
    scene: Scene, open_points: Bool[np.ndarray, " r"], part: Part, most: int = NUM_SEEDS
) -> Int[np.ndarray, " s"]:
    """Return rows of up to `most` seeds spread over points of a scene, no more than it takes to be near to all.

    Lengths of the part are in the scene's unit.
    """
    capacity = scene.cloud.mask.shape[0]
    flags = jnp.asarray(np.pad(open_points, (0, capacity - len(open_points))))
    rows, real = _spread(scene.cloud, flags, count=NUM_SEEDS)
    cells = np.unique(cell_numbers(scene.points[open_points], SPACING * part.diameter))
    return np.asarray(rows)[np.asarray(real)][: min(most, len(cells))]


def seeds_at(scene: Scene, places: Float[np.ndarray, "k 3"]) -> Int[np.ndarray, " k"]:
    """Return the rows of the points nearest to places in the camera's frame."""
    return np.array([nearest_row(scene.points, place) for place in places], dtype=np.int32)


def spread_seeds(
    cloud: PaddedCloud, candidates: Bool[Array, " r"], count: int
) -> tuple[Int[Array, " count"], Bool[Array, " count"]]:
    """Return rows of candidates spread over a cloud, each the farthest from those before it, and which are real.

    With fewer candidates than `count` the others repeat one, and are not real.
    """
    usable = cloud.mask & candidates
    anchor = jnp.argmax(usable).astype(jnp.int32)
    # What is no candidate sits on one: it is the farthest only when no other is left.
    rows = farthest_point_indices(jnp.where(usable[:, None], cloud.points, cloud.points[anchor][None]), count, None)
    rows = jnp.where(usable[rows], rows, anchor)
    same = jnp.tril(rows[:, None] == rows[None, :], -1).any(axis=1)
    return rows, ~same & usable[anchor]


_spread = kept("count")(spread_seeds)
