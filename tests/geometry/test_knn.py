"""Nearest neighbours against float64 distances in NumPy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.geometry import k_nearest, nearest, neighbor_graph, squared_distances

SEEDS = range(3)
jitted = jax.jit(k_nearest, static_argnums=2)
jitted_graph = jax.jit(neighbor_graph, static_argnums=1)
jitted_nearest = jax.jit(nearest)


def clouds(seed: int, queries: int, points: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=(queries, width)).astype(np.float32),
        rng.normal(size=(points, width)).astype(np.float32),
    )


def dense_distances(queries: np.ndarray, points: np.ndarray) -> np.ndarray:
    return ((queries[:, None].astype(np.float64) - points[None].astype(np.float64)) ** 2).sum(-1)


@pytest.mark.parametrize("width", [3, 64])
@pytest.mark.parametrize("seed", SEEDS)
def test_squared_distances_equal_the_sum_of_squared_differences(seed: int, width: int) -> None:
    queries, points = clouds(seed, 50, 70, width)
    # 1e-6 of the largest squared norm: what rounding of the expanded square leaves.
    tolerance = 1e-6 * max((queries**2).sum(-1).max(), (points**2).sum(-1).max())
    found = jax.jit(squared_distances)(queries, points)
    np.testing.assert_allclose(found, dense_distances(queries, points), atol=tolerance)


@pytest.mark.parametrize("width", [3, 64])
@pytest.mark.parametrize("seed", SEEDS)
def test_k_nearest_are_the_nearest(seed: int, width: int) -> None:
    queries, points = clouds(seed, 53, 70, width)
    found = np.asarray(jitted(queries, points, 9))
    distances = dense_distances(queries, points)
    assert all(len(set(row)) == 9 for row in found)
    np.testing.assert_allclose(
        np.sort(np.take_along_axis(distances, found, 1)), np.sort(distances)[:, :9], atol=1e-6 * distances.max()
    )


def test_k_nearest_eager_equals_jitted() -> None:
    queries, points = clouds(0, 53, 70, 3)
    np.testing.assert_array_equal(k_nearest(jnp.asarray(queries), jnp.asarray(points), 9), jitted(queries, points, 9))


@pytest.mark.parametrize("seed", SEEDS)
def test_k_nearest_contains_the_point_itself(seed: int) -> None:
    _, points = clouds(seed, 1, 70, 3)
    assert (np.asarray(jitted(points, points, 5)) == np.arange(70)[:, None]).any(axis=1).all()


def test_ties_go_to_the_lower_index() -> None:
    points = np.float32([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 0]])
    assert sorted(np.asarray(jitted(np.zeros((1, 3), np.float32), points, 3))[0].tolist()) == [0, 1, 4]


@pytest.mark.parametrize("seed", SEEDS)
def test_padding_is_never_found_whatever_it_holds(seed: int) -> None:
    queries, points = clouds(seed, 53, 70, 3)
    mask = np.arange(70) % 3 != 0
    padded = np.where(mask[:, None], points, np.nan).astype(np.float32)
    found = np.asarray(jitted(queries, padded, 9, mask))
    unpadded = np.flatnonzero(mask)[np.asarray(jitted(queries, points[mask], 9))]
    np.testing.assert_array_equal(np.sort(found), np.sort(unpadded))


def test_with_fewer_real_points_than_k_the_nearest_repeats() -> None:
    queries, points = clouds(0, 53, 70, 3)
    mask = np.isin(np.arange(70), [4, 31, 60])
    found = np.asarray(jitted(queries, points, 9, mask))
    closest = np.argmin(np.where(mask[None], dense_distances(queries, points), np.inf), axis=1)
    for row, first in zip(found, closest, strict=True):
        assert sorted(row.tolist()) == sorted([4, 31, 60] + [first] * 6)


def test_vmap_equals_a_loop() -> None:
    rng = np.random.default_rng(0)
    points, mask = rng.normal(size=(4, 40, 3)).astype(np.float32), rng.random((4, 40)) < 0.7
    batched = jax.jit(jax.vmap(lambda p, m: k_nearest(p, p, 5, m)))(points, mask)
    for i in range(4):
        np.testing.assert_array_equal(np.sort(batched[i]), np.sort(jitted(points[i], points[i], 5, mask[i])))


@pytest.mark.parametrize("k", [0, 4])
def test_impossible_k_is_refused(k: int) -> None:
    with pytest.raises(ValueError, match=f"k = {k} neighbours"):
        k_nearest(jnp.zeros((2, 3)), jnp.zeros((3, 3)), k)


@pytest.mark.parametrize("seed", SEEDS)
def test_nearest_is_the_closest_point_and_its_distance(seed: int) -> None:
    queries, points = clouds(seed, 50, 70, 3)
    indices, distances = jitted_nearest(queries, points)
    dense = np.sqrt(dense_distances(queries, points))
    np.testing.assert_allclose(
        np.take_along_axis(dense, np.asarray(indices)[:, None], 1)[:, 0], dense.min(1), atol=1e-5
    )
    np.testing.assert_allclose(distances, dense.min(1), atol=1e-5)


def test_nearest_of_a_coincident_point_is_at_distance_zero() -> None:
    points = (100 + 10 * np.random.default_rng(0).normal(size=(30, 3))).astype(np.float32)
    indices, distances = jitted_nearest(points, points)
    np.testing.assert_array_equal(indices, np.arange(30))
    np.testing.assert_array_equal(distances, 0)


def test_nearest_without_real_points_is_infinitely_far() -> None:
    points = np.full((4, 3), np.nan, np.float32)
    indices, distances = jitted_nearest(np.ones((3, 3), np.float32), points, np.zeros(4, dtype=bool))
    assert np.isposinf(distances).all()
    assert ((np.asarray(indices) >= 0) & (np.asarray(indices) < 4)).all()


def test_k_nearest_keeps_its_digits_far_from_the_origin() -> None:
    points = (np.random.default_rng(0).random((600, 3)) * 100 + [0, 0, 1000]).astype(np.float32)
    exact = ((points[:, None].astype(np.float64) - points[None]) ** 2).sum(axis=-1)
    want = np.sort(np.argsort(exact, axis=1)[:, :20])
    np.testing.assert_array_equal(np.sort(jitted(points, points, 20)), want)


def test_tight_clusters_far_apart_keep_their_own() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(60, 3)) * 1e-2 + np.where(np.arange(60)[:, None] < 30, 1000, -1000)
    points = points.astype(np.float32)
    exact = ((points[:, None].astype(np.float64) - points[None]) ** 2).sum(axis=-1)
    found = np.asarray(jitted(points, points, 5))
    np.testing.assert_array_equal(np.sort(found), np.sort(np.argsort(exact, axis=1)[:, :5]))
    assert all(row in found[row] for row in range(60))


def test_no_queries_have_no_neighbours() -> None:
    assert k_nearest(jnp.zeros((0, 3)), jnp.zeros((9, 3)), 5).shape == (0, 5)


@pytest.mark.parametrize("width", [3, 64])
@pytest.mark.parametrize("count", [9, 33, 70, 530])
def test_the_graph_is_each_points_nearest(count: int, width: int) -> None:
    _, points = clouds(count, 1, count, width)
    found = np.asarray(jitted_graph(points, 9))
    np.testing.assert_array_equal(np.sort(found), np.sort(jitted(points, points, 9)))
    assert (found == np.arange(count)[:, None]).any(axis=1).all()


@pytest.mark.parametrize("width", [3, 64])
@pytest.mark.parametrize("seed", SEEDS)
def test_in_the_graph_padding_is_never_found_whatever_it_holds(seed: int, width: int) -> None:
    _, points = clouds(seed, 1, 70, width)
    mask = np.arange(70) % 3 != 0
    padded = np.where(mask[:, None], points, np.nan).astype(np.float32)
    found = np.asarray(jitted_graph(padded, 9, mask))
    np.testing.assert_array_equal(np.sort(found[mask]), np.sort(jitted(points[mask], padded, 9, mask)))


def test_in_the_graph_of_fewer_real_points_than_k_each_repeats_itself() -> None:
    _, points = clouds(0, 1, 70, 3)
    mask = np.isin(np.arange(70), [4, 31, 60])
    found = np.asarray(jitted_graph(points, 9, mask))
    for row in (4, 31, 60):
        assert sorted(found[row].tolist()) == sorted([4, 31, 60] + [row] * 6)


def test_the_graph_without_real_points_stays_within_the_list() -> None:
    found = np.asarray(jitted_graph(np.full((70, 3), np.nan, dtype=np.float32), 9, np.zeros(70, dtype=bool)))
    assert ((found >= 0) & (found < 70)).all()


def test_the_graph_of_points_that_tie_holds_nearest_ones() -> None:
    points = np.float32(np.arange(40) >= 35)[:, None].repeat(3, axis=1)
    found = np.asarray(jitted_graph(points, 4))
    assert (found[:35] < 35).all()
    assert (found[35:] >= 35).all()
    assert all(len(set(row)) == 4 for row in found.tolist())


def test_vmap_of_the_graph_equals_a_loop() -> None:
    rng = np.random.default_rng(0)
    points, mask = rng.normal(size=(4, 40, 3)).astype(np.float32), rng.random((4, 40)) < 0.7
    batched = jax.jit(jax.vmap(lambda p, m: neighbor_graph(p, 5, m)))(points, mask)
    for i in range(4):
        np.testing.assert_array_equal(np.sort(batched[i]), np.sort(jitted_graph(points[i], 5, mask[i])))


@pytest.mark.parametrize("k", [0, 4])
def test_an_impossible_k_is_refused_of_the_graph(k: int) -> None:
    with pytest.raises(ValueError, match=f"k = {k} neighbours"):
        neighbor_graph(jnp.zeros((3, 3)), k)
