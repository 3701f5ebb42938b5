"""Neighbours found by groups are those that all distances say."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.synthetic import box_surface
from kmn_jax.geometry import group_points, nearest, nearest_within


def cloud(name: str, key: jax.Array, count: int) -> jax.Array:
    match name:
        case "surface":
            return box_surface(key, count, 1.0)[0]
        case "volume":
            return jax.random.uniform(key, (count, 3))
        case "lattice":  # of equally far points, and points in one place
            return jnp.round(4 * jax.random.uniform(key, (count, 3))) / 4
        case _:  # all in one place
            return jnp.full((count, 3), 0.25)


@jax.jit
def both(queries: jax.Array, points: jax.Array, mask: jax.Array, asked: jax.Array, reach: jax.Array) -> list[jax.Array]:
    blocks = group_points(queries, asked)
    rows, distance = nearest_within(
        jnp.where(blocks.mask[..., None], blocks.points, 0), blocks.mask, group_points(points, mask), reach
    )
    dense, far = nearest(queries, points, mask)
    real = blocks.mask.reshape(-1)
    asked_for = blocks.rows.reshape(-1)
    return [real, asked_for, rows.reshape(-1), dense[asked_for], distance.reshape(-1), far[asked_for]]


@pytest.mark.parametrize("counts", [(700, 900), (1, 33)])
@pytest.mark.parametrize("name", ["surface", "volume", "lattice", "one place"])
def test_neighbours_are_those_of_all_distances(name: str, counts: tuple[int, int]) -> None:
    keys = jax.random.split(jax.random.key(0), 4)
    queries, points = cloud("volume", keys[0], counts[0]), cloud(name, keys[1], counts[1])
    mask, asked = (jax.random.uniform(key, (count,)) < 0.7 for key, count in zip(keys[2:], counts[::-1], strict=True))
    points = jnp.where(mask[:, None], points, jnp.nan)
    queries = jnp.where(asked[:, None], queries, jnp.nan)
    for reach in (0.05, 0.3, 10.0):
        real, asked_for, rows, dense, distance, far = map(
            np.asarray, both(queries, points, mask, asked, jnp.float32(reach))
        )
        assert sorted(asked_for[real]) == list(np.flatnonzero(asked))
        inside = far[real] <= reach
        np.testing.assert_array_equal(np.isfinite(distance[real]), inside)
        np.testing.assert_array_equal(rows[real][inside], dense[real][inside])
        np.testing.assert_allclose(distance[real][inside], far[real][inside], rtol=1e-6)


def test_groups_hold_neighbours() -> None:
    points = box_surface(jax.random.key(1), 2048, 1.0)[0]
    groups = jax.jit(group_points)(points)
    assert sorted(np.asarray(groups.rows).reshape(-1)) == list(range(2048))
    np.testing.assert_array_equal(groups.points, points[groups.rows])
    assert np.median(np.ptp(np.asarray(groups.points), axis=1).max(axis=1)) < 0.25
