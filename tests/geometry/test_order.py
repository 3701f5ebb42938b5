"""The Z-order curve against codes put together bit by bit."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.geometry import space_filling_order

jitted = jax.jit(space_filling_order)


def morton_code(cell: np.ndarray) -> int:
    bits = (f"{cell[2]:010b}", f"{cell[1]:010b}", f"{cell[0]:010b}")
    return int("".join(z + y + x for z, y, x in zip(*bits, strict=True)), 2)


@pytest.mark.parametrize("shift", [0.0, -700.0])
def test_points_of_a_lattice_follow_their_codes(shift: float) -> None:
    cells = np.random.default_rng(0).integers(0, 1024, (300, 3))
    cells[0], cells[1] = 0, 1023
    points = (cells + 0.5 + shift).astype(np.float32)
    points[0], points[1] = shift, shift + 1024  # the cube's corners
    order, _ = jitted(points)
    codes = np.array([morton_code(cell) for cell in cells])
    assert (np.diff(codes[np.asarray(order)]) >= 0).all()


def test_places_undo_the_order_and_masked_points_are_last() -> None:
    points = np.random.default_rng(1).normal(size=(90, 3)).astype(np.float32)
    mask = np.arange(90) % 4 != 0
    order, places = (np.asarray(x) for x in jitted(np.where(mask[:, None], points, np.nan).astype(np.float32), mask))
    np.testing.assert_array_equal(points[order][places], points)
    assert mask[order][: mask.sum()].all()
    assert not mask[order][mask.sum() :].any()


def test_masked_points_do_not_change_the_order_of_others() -> None:
    points = np.random.default_rng(2).normal(size=(90, 3)).astype(np.float32)
    mask = np.arange(90) < 60
    far = np.where(mask[:, None], points, 1e6).astype(np.float32)
    np.testing.assert_array_equal(jitted(far, mask)[0][:60], jitted(points[:60])[0])


@pytest.mark.parametrize("count", [1, 7])
def test_points_that_coincide_keep_their_order(count: int) -> None:
    np.testing.assert_array_equal(jitted(np.full((count, 3), 5, dtype=np.float32))[0], np.arange(count))


@pytest.mark.parametrize("size", [1e-44, 1e-30, 1e30, 1e38])
def test_clouds_of_any_size_have_an_order(size: float) -> None:
    points = (np.random.default_rng(3).uniform(-1, 1, (50, 3)) * size).astype(np.float32)
    order, _ = jitted(points)
    np.testing.assert_array_equal(np.sort(order), np.arange(50))


def test_vmap_equals_a_loop() -> None:
    points = jax.random.normal(jax.random.key(4), (3, 40, 3))
    masks = jnp.arange(40)[None, :] < jnp.array([40, 25, 0])[:, None]
    for together, points_i, mask in zip(jax.vmap(jitted)(points, masks)[0], points, masks, strict=True):
        np.testing.assert_array_equal(together, jitted(points_i, mask)[0])


def test_without_real_points_there_is_still_an_order() -> None:
    order, places = jitted(np.full((5, 3), np.nan, dtype=np.float32), np.zeros(5, dtype=bool))
    np.testing.assert_array_equal(order, np.arange(5))
    np.testing.assert_array_equal(places, np.arange(5))


def test_neighbours_along_the_curve_are_near() -> None:
    points = jax.random.normal(jax.random.key(0), (2048, 3))
    ordered = points[jitted(points)[0]]

    def mean_step(x: jax.Array) -> float:
        return float(jnp.linalg.norm(x[1:] - x[:-1], axis=1).mean())

    assert mean_step(ordered) < 0.25 * mean_step(points)
