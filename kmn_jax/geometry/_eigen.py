"""Dominant eigenvector of a small symmetric matrix from plain elementwise arithmetic."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from kmn_jax.platforms import by_platform
from kmn_jax.typing import Scalar

_SQUARINGS = 24  # 2**24 power iterations: eigenvalues closer than float32 can tell apart no longer matter
_AT_ONCE = _SQUARINGS  # on accelerators, where every round of a loop is several kernels to start


def dominant_eigenvector(matrix: Float[Array, "d d"]) -> Float[Array, " d"]:
    """Return a unit eigenvector to the largest eigenvalue of a symmetric positive semi-definite matrix.

    The matrix is squared repeatedly, M <- M^2 / trace, which turns it into the projector onto its dominant
    eigenspace; the column with the largest diagonal entry then lies in that space, also when the largest
    eigenvalue is repeated (any vector of the space is then as good). `eigh` is a serial loop under vmap on
    CPUs, and roots of the characteristic polynomial lose half the digits of float32; this does neither.
    A zero matrix gives the first unit vector. The sign is arbitrary; not meant to be differentiated.
    """
    size = matrix.shape[-1]
    upper = [(i, j) for i in range(size) for j in range(i, size)]
    # Every entry is an array of its own: under vmap each is one long row of contiguous numbers, where sums over
    # axes of 3 or 4 are 8 to 20 times slower on CPUs.
    entry = {(i, j): upper.index((min(i, j), max(i, j))) for i in range(size) for j in range(size)}
    scale = jnp.trace(matrix)
    inverse_scale = jnp.where(scale > 0, 1 / jnp.where(scale > 0, scale, 1), 0)
    normalised = tuple(jnp.where(scale > 0, matrix[i, j] * inverse_scale, (i == j) / size) for i, j in upper)

    def square(_: Any, m: tuple[Any, ...]) -> tuple[Any, ...]:
        squared = [sum((m[entry[i, k]] * m[entry[k, j]] for k in range(size)), jnp.zeros_like(m[0])) for i, j in upper]
        inverse_trace = 1 / sum((squared[entry[i, i]] for i in range(size)), jnp.zeros_like(m[0]))
        return tuple(value * inverse_trace for value in squared)

    def in_few_kernels(*m: Scalar) -> tuple[Scalar, ...]:
        # Rows of one, since XLA starts a kernel for each scalar, but one for all arrays of a shape.
        rows = tuple(value[None] for value in m)
        rows = jax.lax.fori_loop(0, _SQUARINGS, square, rows, unroll=_AT_ONCE)
        return tuple(row[0] for row in rows)

    projector = by_platform(
        *normalised, cpu=lambda *m: jax.lax.fori_loop(0, _SQUARINGS, square, m), default=in_few_kernels
    )
    largest, column = projector[0], [projector[entry[0, j]] for j in range(size)]
    for i in range(1, size):
        larger = projector[entry[i, i]] > largest
        largest = jnp.where(larger, projector[entry[i, i]], largest)
        column = [jnp.where(larger, projector[entry[i, j]], old) for j, old in enumerate(column)]
    length = jnp.sqrt(sum((value**2 for value in column), jnp.zeros_like(largest)))
    return jnp.stack(column) / length
