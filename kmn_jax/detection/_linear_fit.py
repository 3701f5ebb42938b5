"""Linear functions over the cells of a picture, by least squares."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kmn_jax.typing import Scalar

_UNTILTED = 0.01  # square cells, added to how cells spread: those in a row tell no slope across


class LinearFit(NamedTuple):
    """A linear function of columns and rows. Cells without weight give zero."""

    column: Scalar  # of the middle of the cells
    row: Scalar
    level: Scalar  # of the values there
    along_columns: Scalar  # slope
    along_rows: Scalar
    spread: tuple[Scalar, Scalar, Scalar]  # of the cells around their middle: columns, both, rows; in square cells

    def at(self, columns: Float[Array, "*c"], rows: Float[Array, "*c"]) -> Float[Array, "*c"]:
        """Return the function at places."""
        return self.level + self.along_columns * (columns - self.column) + self.along_rows * (rows - self.row)

    def away(self, columns: Float[Array, "*c"], rows: Float[Array, "*c"]) -> Float[Array, "*c"]:
        """Return how far places are from the middle of the cells, in standard deviations of these, squared."""
        across, both, down = self.spread
        x, y = columns - self.column, rows - self.row
        return (down * x * x - 2 * both * x * y + across * y * y) / (across * down - both**2)


def fit_linear(values: Float[Array, "s s"], of: Bool[Array, "s s"]) -> LinearFit:
    """Fit a linear function to the values of some cells."""
    rows, columns = (grid.astype(jnp.float32) for grid in jnp.indices(values.shape))
    total = jnp.maximum(of.sum(dtype=jnp.float32), 1)

    def mean(values: Float[Array, "s s"]) -> Scalar:
        return jnp.where(of, values, 0).sum() / total

    column, row, level = mean(columns), mean(rows), mean(values)
    x, y, rise = columns - column, rows - row, values - level
    across, both, down = mean(x * x) + _UNTILTED, mean(x * y), mean(y * y) + _UNTILTED
    along_x, along_y, spread = mean(x * rise), mean(y * rise), across * down - both**2
    slopes = (down * along_x - both * along_y) / spread, (across * along_y - both * along_x) / spread
    return LinearFit(column, row, level, *slopes, (across, both, down))
