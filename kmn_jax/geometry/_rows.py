"""Which rows of a cloud are real: the one meaning of a padding mask in this package."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def real_rows(points: Float[Array, "n c"], mask: Bool[Array, " n"] | None = None) -> Bool[Array, " n"]:
    """Tell which rows can be used: those that `mask` allows and that hold no NaN or infinity."""
    finite = jnp.isfinite(points).all(axis=1)
    return finite if mask is None else finite & mask
