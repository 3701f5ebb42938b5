"""Radius crop and voxel thinning against plain NumPy, with capacities too large and too small."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.geometry import Selection, radius_crop, voxel_thin

SEEDS = range(4)
crop = jax.jit(radius_crop, static_argnums=3)
thin = jax.jit(voxel_thin, static_argnums=2)
CENTER = np.array([0.2, -0.1, 0.3], dtype=np.float32)


def cloud(seed: int, total: int = 300, width: int = 6) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(total, width)).astype(np.float32)


def inside(points: np.ndarray, radius: float = 1.0) -> np.ndarray:
    return np.flatnonzero(((points[:, :3].astype(np.float64) - CENTER) ** 2).sum(axis=1) <= radius**2)


def chosen(selection: Selection) -> np.ndarray:
    """Check the layout of a selection and return its real indices."""
    indices, mask = np.asarray(selection.indices), np.asarray(selection.mask)
    count = int(mask.sum())
    assert mask[:count].all()
    np.testing.assert_array_equal(indices[count:], 0)
    assert (np.diff(indices[:count]) > 0).all()
    return indices[:count]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("capacity", [200, 500], ids=["fits", "capacity above n"])
@pytest.mark.parametrize("with_key", [False, True])
def test_a_crop_that_fits_holds_every_point_inside(seed: int, capacity: int, with_key: bool) -> None:
    points = cloud(seed)
    selection = crop(points, CENTER, 1.0, capacity, jax.random.key(seed) if with_key else None)
    np.testing.assert_array_equal(chosen(selection), inside(points))
    assert not selection.overflow


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("with_key", [False, True])
def test_a_crop_that_overflows_is_full_of_points_inside_and_says_so(seed: int, with_key: bool) -> None:
    points = cloud(seed)
    selection = crop(points, CENTER, 1.0, 16, jax.random.key(seed) if with_key else None)
    found = chosen(selection)
    assert len(found) == 16
    assert np.isin(found, inside(points)).all()
    assert selection.overflow


def test_without_a_key_the_kept_points_are_evenly_spaced_in_the_order_of_the_rows() -> None:
    selection = radius_crop(jnp.zeros((10, 3)), jnp.zeros(3), 1.0, 4)
    np.testing.assert_array_equal(selection.indices, [0, 2, 5, 7])


def test_a_capacity_exactly_met_is_no_overflow() -> None:
    selection = radius_crop(jnp.zeros((10, 3)), jnp.zeros(3), 1.0, 10)
    np.testing.assert_array_equal(chosen(selection), np.arange(10))
    assert not selection.overflow


def test_with_a_key_every_point_inside_is_equally_likely() -> None:
    points = jnp.concatenate([jnp.zeros((12, 3)), jnp.full((5, 3), 9.0)])
    draw = jax.jit(jax.vmap(lambda key: radius_crop(points, jnp.zeros(3), 1.0, 5, key).indices))
    drawn = np.asarray(draw(jax.random.split(jax.random.key(0), 3000)))
    share = np.bincount(drawn.ravel(), minlength=17) / 3000
    expected = 5 / 12
    np.testing.assert_allclose(share[:12], expected, atol=4 * np.sqrt(expected * (1 - expected) / 3000))
    np.testing.assert_array_equal(share[12:], 0)


def test_even_spacing_survives_counts_whose_product_is_beyond_int32() -> None:
    selection = jax.jit(radius_crop, static_argnums=3)(np.zeros((1_000_000, 3), np.float32), np.zeros(3), 1.0, 4096)
    np.testing.assert_array_equal(chosen(selection), np.arange(4096) * 1_000_000 // 4096)


@pytest.mark.parametrize("padding", [0.2, np.nan, np.inf])
def test_rows_masked_out_are_never_inside(padding: float) -> None:
    points = cloud(0)
    mask = np.arange(300) % 2 == 0
    padded = np.where(mask[:, None], points, np.float32(padding))
    found = chosen(crop(padded, CENTER, 1.0, 200, None, mask))
    np.testing.assert_array_equal(found, np.intersect1d(inside(points), np.flatnonzero(mask)))


@pytest.mark.parametrize("with_key", [False, True])
def test_an_empty_crop_is_all_padding(with_key: bool) -> None:
    key = jax.random.key(0) if with_key else None
    for points in (jnp.full((5, 3), 9.0), jnp.full((5, 3), jnp.nan), jnp.zeros((0, 3))):
        selection = radius_crop(points, jnp.zeros(3), 1.0, 4, key)
        assert len(chosen(selection)) == 0
        assert not selection.overflow


def test_the_boundary_is_inside() -> None:
    assert len(chosen(radius_crop(jnp.array([[2.0, 0, 0]]), jnp.zeros(3), 2, 1))) == 1


def voxels_by_loop(points: np.ndarray, size: float) -> list[int]:
    """Return per occupied voxel the row nearest to its centre."""
    best: dict[tuple[int, ...], tuple[float, int]] = {}
    for row, point in enumerate(points / np.float32(size)):
        voxel = np.floor(point)
        candidate = (float(((point - voxel - np.float32(0.5)) ** 2).sum()), row)
        key = tuple(voxel.astype(int).tolist())
        best[key] = min(best.get(key, candidate), candidate)
    return sorted(row for _, row in best.values())


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("size", [0.3, 1.0, 50.0])
def test_thinning_takes_the_point_nearest_to_each_voxels_centre(seed: int, size: float) -> None:
    points = cloud(seed, width=3)
    selection = thin(points, size, 300)
    np.testing.assert_array_equal(chosen(selection), voxels_by_loop(points, size))
    assert not selection.overflow


@pytest.mark.parametrize("seed", SEEDS)
def test_thinning_does_not_depend_on_the_order_of_the_rows(seed: int) -> None:
    points = cloud(seed, width=3)
    order = np.random.default_rng(seed + 100).permutation(300)
    shuffled = order[chosen(thin(points[order], 0.3, 300))]
    np.testing.assert_array_equal(np.sort(shuffled), chosen(thin(points, 0.3, 300)))


def test_thinning_leaves_one_of_coincident_points_the_first() -> None:
    selection = voxel_thin(jnp.full((6, 3), 0.7), 1, 4)
    np.testing.assert_array_equal(selection.indices, [0, 0, 0, 0])
    np.testing.assert_array_equal(selection.mask, [True, False, False, False])


def test_zero_and_negative_zero_share_a_voxel_but_the_two_sides_of_zero_do_not() -> None:
    points = jnp.array([[0.0, 0, 0], [-0.0, 0, 0], [-0.1, 0, 0]])
    np.testing.assert_array_equal(chosen(voxel_thin(points, 1.0, 3)), [0, 2])


def test_thinning_that_overflows_keeps_as_many_voxels_as_fit() -> None:
    points = jnp.arange(10, dtype=jnp.float32)[:, None] * jnp.ones((1, 3))
    selection = voxel_thin(points, 1.0, 4)
    np.testing.assert_array_equal(chosen(selection), [0, 2, 5, 7])
    assert selection.overflow


def test_voxels_far_beyond_int32_are_still_told_apart() -> None:
    points = jnp.array([[1e6, 0, 0], [1e6, 0, 0], [-1e6, 0, 0], [3e6, 0, 0]])
    np.testing.assert_array_equal(chosen(voxel_thin(points, 1e-6, 4)), [0, 2, 3])


@pytest.mark.parametrize("padding", [0.0, np.nan, -np.inf])
def test_thinning_skips_rows_masked_out(padding: float) -> None:
    points = cloud(0, width=3)
    mask = np.arange(300) % 3 != 0
    padded = np.where(mask[:, None], points, np.float32(padding))
    expected = np.flatnonzero(mask)[voxels_by_loop(points[mask], 0.3)]
    np.testing.assert_array_equal(chosen(thin(padded, 0.3, 300, mask)), expected)


def test_thinning_nothing_gives_nothing() -> None:
    for points in (jnp.full((5, 3), jnp.nan), jnp.zeros((0, 3))):
        selection = voxel_thin(points, 1.0, 4)
        assert len(chosen(selection)) == 0
        assert not selection.overflow


def test_static_mistakes_raise_inside_jit_too() -> None:
    with pytest.raises(ValueError, match="capacity = 0"):
        crop(cloud(0), CENTER, 1.0, 0)
    with pytest.raises(ValueError, match="capacity = -1"):
        thin(cloud(0, width=3), 1.0, -1)
    with pytest.raises(ValueError, match="2 columns"):
        crop(cloud(0, width=2), CENTER, 1.0, 5)


@pytest.mark.parametrize("length", [0, -1.0, float("nan")])
def test_lengths_that_are_not_positive_are_refused(length: float) -> None:
    with pytest.raises(InputError, match="radius"):
        radius_crop(jnp.zeros((2, 3)), jnp.zeros(3), length, 2)
    with pytest.raises(InputError, match="voxel_size"):
        voxel_thin(jnp.zeros((2, 3)), length, 2)


def test_vmap_equals_a_loop_and_jit_equals_eager() -> None:
    points = np.stack([cloud(seed, width=3) for seed in range(3)])
    center, key = jnp.asarray(CENTER), jax.random.key(0)
    for function in (
        lambda p: radius_crop(p, center, 1.0, 32, key),
        lambda p: voxel_thin(p, 0.5, 64),
    ):
        batched, jitted = jax.jit(jax.vmap(function))(points), jax.jit(function)
        for i, alone in enumerate([*map(jitted, points), function(jnp.asarray(points[0]))]):
            for part, expected in zip(batched, alone, strict=True):
                np.testing.assert_array_equal(part[i % 3], expected)
