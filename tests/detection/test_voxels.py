"""Cells of a grid have numbers of their own."""

from __future__ import annotations

import numpy as np

from kmn_jax.detection._voxels import cell_numbers


def test_points_share_a_number_where_they_share_a_cell() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(size=(500, 3)), rng.normal(size=(500, 3)) * 40, [[9e4, -9e4, 9e4]]])
    for side in (0.1, 3.0):
        cells = np.floor(points.astype(np.float32) / side)
        same_cell = (cells[:, None] == cells[None]).all(axis=2)
        numbers = cell_numbers(points.astype(np.float32), side)
        np.testing.assert_array_equal(numbers[:, None] == numbers[None], same_cell)
        assert 10 < len(np.unique(numbers)) < len(points)
    assert cell_numbers(points[:0], 1.0).shape == (0,)
