"""Farthest points against a plain NumPy loop."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.geometry import farthest_point_indices

SEEDS = range(4)
sample = jax.jit(farthest_point_indices, static_argnums=1)


def farthest_points_by_loop(points: np.ndarray, count: int, first: int | None = None) -> list[int]:
    """Choose as the published code does: farthest from the mean first, then the mean is dropped."""
    if first is None:
        first = int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmax())
    chosen = [first]
    while len(chosen) < count:
        distances = ((points[:, None] - points[None, chosen]) ** 2).sum(axis=2).min(axis=1)
        chosen.append(int(distances.argmax()))
    return chosen


def cloud(seed: int, total: int = 200) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(total, 3)).astype(np.float32)


@pytest.mark.parametrize("seed", SEEDS)
def test_released_start_equals_the_loop(seed: int) -> None:
    points = cloud(seed)
    np.testing.assert_array_equal(sample(points, 20), farthest_points_by_loop(points, 20))


def test_the_mean_decides_the_first_point_and_nothing_else() -> None:
    # On a line the mean is at 2.2, so 6 is first and 0 second; then 3 (3 from both) comes before 2, the
    # nearest to the mean. Were the mean kept as a chosen point, 3 would be 0.8 from it and come after 1.
    points = np.float32([[0], [1], [2], [6], [3], [1.2]]) * np.float32([1, 0, 0])
    np.testing.assert_array_equal(sample(points, 4), [3, 0, 4, 5])


@pytest.mark.parametrize("seed", SEEDS)
def test_random_start_draws_the_first_and_continues_like_the_loop(seed: int) -> None:
    points = cloud(seed)
    found = np.asarray(sample(points, 20, jax.random.key(seed)))
    np.testing.assert_array_equal(found, farthest_points_by_loop(points, 20, first=int(found[0])))
    np.testing.assert_array_equal(found, sample(points, 20, jax.random.key(seed)))


def test_random_start_is_uniform_over_the_real_points() -> None:
    mask = jnp.array([True, False, True, True, False])
    keys = jax.random.split(jax.random.key(0), 3000)
    first = jax.jit(jax.vmap(lambda key: farthest_point_indices(jnp.eye(5, 3), 1, key, mask)[0]))(keys)
    shares = np.bincount(np.asarray(first), minlength=5) / 3000
    np.testing.assert_allclose(shares, [1 / 3, 0, 1 / 3, 1 / 3, 0], atol=4 * np.sqrt(2 / 9 / 3000))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("padding", [0.0, 1e6, np.nan, np.inf])
def test_padding_changes_nothing_whatever_it_holds(seed: int, padding: float) -> None:
    points = cloud(seed)
    mask = np.random.default_rng(seed + 100).random(200) < 0.7
    padded = np.where(mask[:, None], points, np.float32(padding))
    expected = np.flatnonzero(mask)[farthest_points_by_loop(points[mask], 20)]
    np.testing.assert_array_equal(sample(padded, 20, None, mask), expected)


def test_rows_that_are_not_finite_are_left_out_without_a_mask() -> None:
    points = cloud(0)
    points[[3, 50]] = np.nan
    points[7, 1] = np.inf
    real = np.isfinite(points).all(axis=1)
    np.testing.assert_array_equal(sample(points, 20), np.flatnonzero(real)[farthest_points_by_loop(points[real], 20)])


def test_fewer_real_points_than_asked_repeat_the_first_real_one() -> None:
    mask = np.array([False, True, False, True, True, False])
    found = np.asarray(sample(cloud(0, 6), 6, None, mask))
    assert sorted(found[:3].tolist()) == [1, 3, 4]
    np.testing.assert_array_equal(found[3:], 1)


@pytest.mark.parametrize("key", [None, jax.random.key(0)], ids=["released", "random"])
def test_no_real_point_gives_zeros(key: jax.Array | None) -> None:
    found = sample(np.full((4, 3), np.nan, np.float32), 3, key, np.zeros(4, dtype=bool))
    np.testing.assert_array_equal(found, 0)


def test_coincident_points_are_still_chosen_once_each() -> None:
    np.testing.assert_array_equal(sample(np.ones((6, 3), np.float32), 6), np.arange(6))
    twice = np.repeat(np.eye(3, dtype=np.float32), 2, axis=0)
    found = np.asarray(sample(twice, 6))
    assert sorted((found[:3] // 2).tolist()) == [0, 1, 2]
    assert sorted(found.tolist()) == list(range(6))


def test_one_point() -> None:
    np.testing.assert_array_equal(sample(np.ones((1, 3), np.float32), 1), [0])


@pytest.mark.parametrize("count", [0, 5])
def test_impossible_counts_are_refused_inside_jit_too(count: int) -> None:
    with pytest.raises(ValueError, match=f"count = {count} of 4 points"):
        sample(np.zeros((4, 3), np.float32), count)


def test_vmap_equals_a_loop_and_jit_equals_eager() -> None:
    points = np.stack([cloud(seed) for seed in range(3)])
    batched = jax.jit(jax.vmap(partial(farthest_point_indices, count=20)))(points)
    for i, alone in enumerate(
        [*(sample(one, 20) for one in points), farthest_point_indices(jnp.asarray(points[0]), 20)]
    ):
        np.testing.assert_array_equal(batched[i % 3], alone)
