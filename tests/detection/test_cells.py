"""Functions of the cells of a picture."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection._cells import fit_linear, fit_plane, grown, places_of


def test_a_linear_function_is_found_from_any_cells_that_are_not_in_a_row() -> None:
    columns, rows = places_of(jnp.zeros((20, 20)))
    values = 3 + 0.5 * columns - 0.25 * rows
    some = jnp.asarray(np.random.default_rng(0).random((20, 20)) < 0.2)
    fit = fit_linear(jnp.where(some, values, 99.0), some)
    np.testing.assert_allclose(fit.at(columns, rows), values, rtol=2e-3, atol=2e-2)
    away = fit.away(columns, rows)
    assert away[some].mean() == pytest.approx(2, abs=0.01)  # of two dimensions
    row = fit_linear(values, rows == 4)
    np.testing.assert_allclose(row.at(columns[4], rows[4]), values[4], rtol=2e-3)
    np.testing.assert_allclose(row.at(columns, rows + 5), row.at(columns, rows), atol=1e-3)  # no slope across
    none = fit_linear(values, jnp.zeros((20, 20), dtype=bool))
    np.testing.assert_array_equal(none.at(columns, rows), 0)


def test_a_plane_is_one_in_space_not_in_depth() -> None:
    columns, rows = places_of(jnp.zeros((16, 16)))
    x, y = columns / 16 - 0.5, rows / 16 - 0.5
    depth = 5 / (1 - 0.8 * x + 0.3 * y)
    fit = fit_plane(depth, x < 0.2, jnp.float32(4))
    np.testing.assert_allclose(fit.depth(columns, rows), depth, rtol=1e-2)
    assert np.isfinite(fit.depth(columns + 1e6, rows)).all()


def test_cells_grow_to_those_next_to_them() -> None:
    mask = jnp.zeros((5, 5), dtype=bool).at[0, 2].set(True)
    wanted = np.zeros((5, 5), dtype=bool)
    wanted[:2, 1:4] = True
    np.testing.assert_array_equal(grown(mask), wanted)
