"""Vector lengths that can be differentiated where they vanish."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the square root, with gradient zero (rather than infinite) at zero."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def safe_norm(vectors: Float[Array, "... d"]) -> Float[Array, "..."]:
    """Return the length of each vector, with gradient zero (rather than NaN) for the zero vector."""
    return safe_sqrt((vectors**2).sum(axis=-1))
