"""Order points so that those close in the list are close in space."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt

_BITS = 10  # a cell for each axis in one 32-bit code


def space_filling_order(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"] | None = None
) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """Return the order of the points along a Z-order curve (Morton, 1966) through their bounding cube, and its inverse.

    `points[order]` are in order, masked points last; `points[order][places]` are the points again. All but masked
    points must be finite. Points of one of the cube's 1024^3 cells keep their order.
    """
    order = jnp.argsort(_codes(points, mask)).astype(jnp.int32)
    return order, jnp.zeros_like(order).at[order].set(jnp.arange(order.shape[0], dtype=order.dtype))


def _codes(points: Float[Array, "n 3"], mask: Bool[Array, " n"] | None) -> UInt[Array, " n"]:
    real = jnp.ones(points.shape[0], dtype=bool) if mask is None else mask
    kept = real[:, None]
    lowest = jnp.where(kept, points, jnp.inf).min(axis=0, keepdims=True, initial=jnp.inf)
    highest = jnp.where(kept, points, -jnp.inf).max(axis=0, keepdims=True, initial=-jnp.inf)
    side = (highest - lowest).max()
    share = jnp.where(kept, points - lowest, 0) / jnp.where(side > 0, side, 1)
    cells = jnp.minimum(share * 2**_BITS, 2**_BITS - 1).astype(jnp.uint32)
    spread = _two_zeros_after_each_bit(cells)
    code = spread[:, 0] | (spread[:, 1] << 1) | (spread[:, 2] << 2)
    return jnp.where(real, code, jnp.uint32(2 ** (3 * _BITS)))


def _two_zeros_after_each_bit(cells: UInt[Array, "n 3"]) -> UInt[Array, "n 3"]:
    """Spread the bits of a cell's coordinate, so that those of three fit between each other (Morton's code)."""
    spread = jnp.zeros_like(cells)
    for bit in range(_BITS):
        spread |= (cells & (1 << bit)) << (2 * bit)
    return spread
