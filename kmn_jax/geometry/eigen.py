"""Dominant eigenvector of a small symmetric matrix from plain elementwise arithmetic."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_SQUARINGS = 24  # 2**24 power iterations: eigenvalues closer than float32 can tell apart no longer matter


def dominant_eigenvector(matrix: Float[Array, "d d"]) -> Float[Array, " d"]:
    """Return a unit eigenvector to the largest eigenvalue of a symmetric positive semi-definite matrix.

    The matrix is squared repeatedly, M <- M^2 / trace, which turns it into the projector onto its dominant
    eigenspace; the column with the largest diagonal entry then lies in that space, also when the largest
    eigenvalue is repeated (any vector of the space is then as good). `eigh` is a serial loop under vmap on
    CPUs, and roots of the characteristic polynomial lose half the digits of float32; this does neither.
    A zero matrix gives the first unit vector. The sign is arbitrary; not meant to be differentiated.
    """
    size = matrix.shape[-1]
    identity = jnp.eye(size, dtype=matrix.dtype)
    scale = jnp.trace(matrix)
    normalised = jnp.where(scale > 0, matrix / jnp.where(scale > 0, scale, 1), identity / size)

    def square(_: int, m: Float[Array, "d d"]) -> Float[Array, "d d"]:
        squared = (m[:, :, None] * m[None, :, :]).sum(axis=1)  # elementwise: a batched 4x4 dot is slower on CPUs
        return squared / jnp.trace(squared)

    projector = jax.lax.fori_loop(0, _SQUARINGS, square, normalised)
    column = projector[:, jnp.argmax(jnp.diagonal(projector))]
    return column / jnp.sqrt(jnp.sum(column**2))
