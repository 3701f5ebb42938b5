"""Neighbours found by groups are those that all distances say."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.geometry import group_points, nearest, nearest_within
from tests.reference.clouds import box_cloud

BOX = (0.8, 0.5, 0.33)  # of diameter 1


def cloud(name: str, seed: int, count: int) -> np.ndarray:
    inside = np.random.default_rng(seed).random((count, 3), np.float32)
    match name:
        case "surface":
            return box_cloud(seed, count, BOX)[:, :3]
        case "volume":
            return inside
        case "lattice":  # of equally far points, and points in one place
            return np.round(4 * inside) / 4
        case _:  # all in one place
            return np.full((count, 3), 0.25, np.float32)


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
    queries, points = cloud("volume", 0, counts[0]), cloud(name, 1, counts[1])
    asked, mask = (np.random.default_rng(2).random(count) < 0.7 for count in counts)
    points = np.where(mask[:, None], points, np.float32(np.nan))
    queries = np.where(asked[:, None], queries, np.float32(np.nan))
    for reach in (0.05, 0.3, 10.0):
        given = queries, points, mask, asked, np.float32(reach)
        real, asked_for, rows, dense, distance, far = jax.device_get(both(*given))
        assert sorted(asked_for[real]) == list(np.flatnonzero(asked))
        inside = far[real] <= reach
        np.testing.assert_array_equal(np.isfinite(distance[real]), inside)
        np.testing.assert_array_equal(rows[real][inside], dense[real][inside])
        np.testing.assert_allclose(distance[real][inside], far[real][inside], rtol=1e-6)


def test_groups_hold_neighbours() -> None:
    points = box_cloud(1, 2048, BOX)[:, :3]
    groups = jax.device_get(jax.jit(group_points)(points))
    assert sorted(groups.rows.reshape(-1)) == list(range(2048))
    np.testing.assert_array_equal(groups.points, points[groups.rows])
    assert np.median(np.ptp(groups.points, axis=1).max(axis=1)) < 0.25
