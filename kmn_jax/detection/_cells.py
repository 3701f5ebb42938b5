"""Functions of the cells of a picture: sums around each, and planes by least squares."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Shaped

from kmn_jax.typing import Scalar

_UNTILTED = 0.01  # square cells, added to how cells spread: those in a row tell no slope across
_FLATTEST = 1e-3  # of the nearest point's closeness: a plane is no farther than its inverse tells


class LinearFit(NamedTuple):
    """A linear function of columns and rows; zero if it is fitted to none."""

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
    columns, rows = places_of(values)
    total = jnp.maximum(of.sum(dtype=jnp.float32), 1)

    def mean(values: Float[Array, "s s"]) -> Scalar:
        return jnp.where(of, values, 0).sum() / total

    column, row, level = mean(columns), mean(rows), mean(values)
    x, y, rise = columns - column, rows - row, values - level
    across, both, down = mean(x * x) + _UNTILTED, mean(x * y), mean(y * y) + _UNTILTED
    along_x, along_y, spread = mean(x * rise), mean(y * rise), across * down - both**2
    slopes = (down * along_x - both * along_y) / spread, (across * along_y - both * along_x) / spread
    return LinearFit(column, row, level, *slopes, (across, both, down))


class PlaneFit(NamedTuple):
    """A plane: over directions (u, v, 1), so over columns and rows of equal steps, its inverse depths are linear."""

    closeness: LinearFit
    nearest: Scalar  # the depth whose closeness is 1

    def depth(self, columns: Float[Array, "*c"], rows: Float[Array, "*c"]) -> Float[Array, "*c"]:
        """Return the depth of the plane in places; where it is seen edge on, or from behind, it is far away."""
        return self.nearest / jnp.maximum(self.closeness.at(columns, rows), _FLATTEST)


def fit_plane(depth: Float[Array, "s s"], of: Bool[Array, "s s"], nearest: Scalar) -> PlaneFit:
    """Fit a plane to the depths of some cells, of which `nearest` is about the size."""
    return PlaneFit(fit_linear(nearest / jnp.where(of, depth, nearest), of), nearest)


def places_of(depth: Float[Array, "s s"]) -> tuple[Float[Array, "s s"], Float[Array, "s s"]]:
    """Return the column and the row of each cell."""
    rows, columns = (grid.astype(jnp.float32) for grid in jnp.indices(depth.shape))
    return columns, rows


def around(values: Shaped[Array, "s s ..."], reach: int, fill: float | bool) -> list[Shaped[Array, "s s ..."]]:
    """Return an image shifted by up to so many cells along its first axis."""
    rest = [(0, 0)] * (values.ndim - 1)
    padded = jnp.pad(values, [(reach, reach), *rest], constant_values=fill)
    return [padded[step : step + values.shape[0]] for step in range(2 * reach + 1)]


def _along_both(
    values: Shaped[Array, "s s ..."],
    reach: int,
    fill: float | bool,
    join: Callable[[Shaped[Array, "k s s ..."]], Shaped[Array, "s s ..."]],
) -> Shaped[Array, "s s ..."]:
    for _ in range(2):
        values = jnp.swapaxes(join(jnp.stack(around(values, reach, fill))), 0, 1)
    return values


def grown(mask: Bool[Array, "s s"]) -> Bool[Array, "s s"]:
    """Return cells, and those next to them."""
    return _along_both(mask, 1, False, lambda shifted: shifted.any(axis=0))


def most(values: Float[Array, "s s"]) -> Float[Array, "s s"]:
    """Return the largest value of each cell and those next to it."""
    return _along_both(values, 1, -jnp.inf, lambda shifted: shifted.max(axis=0))


def summed(values: Float[Array, "s s c"], reach: int) -> Float[Array, "s s c"]:
    """Return the sums over the cells up to `reach` away along both axes."""
    return _along_both(values, reach, 0.0, lambda shifted: shifted.sum(axis=0))
