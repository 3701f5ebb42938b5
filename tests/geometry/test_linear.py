"""The unrolled solution against LAPACK in float64."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from kmn_jax.geometry import solve_symmetric

solve = jax.jit(jax.vmap(solve_symmetric))


@pytest.mark.parametrize("size", [3, 6])
def test_it_solves_what_lapack_does(size: int) -> None:
    rng = np.random.default_rng(size)
    factors = rng.normal(size=(50, 2 * size, size)).astype(np.float32)
    systems, right = factors.swapaxes(1, 2) @ factors, rng.normal(size=(50, size)).astype(np.float32)
    exact = np.linalg.solve(systems.astype(np.float64), right[..., None].astype(np.float64))[..., 0]
    # Of float32: its rounding times the condition of the system.
    bound = 1e-6 * np.linalg.cond(systems) * np.linalg.norm(exact, axis=1)
    assert (np.linalg.norm(solve(systems, right) - exact, axis=1) < bound).all()


def test_directions_without_an_equation_stay_where_they_are() -> None:
    system = np.diag(np.float32([2, 0, 1, 4, 0, 1]))
    system[2, 5] = system[5, 2] = 1  # two rows that say the same
    found = solve(system[None], np.float32([[2, 0, 3, 4, 0, 3]]))[0]
    assert np.isfinite(found).all()
    np.testing.assert_allclose(np.asarray(found)[[0, 1, 3, 4]], [1, 0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(found[2] + found[5], 3, rtol=1e-5)
    np.testing.assert_array_equal(solve(np.zeros((1, 6, 6), np.float32), np.zeros((1, 6), np.float32)), 0)
