"""What the network's entry points ask of clouds that come from outside."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from kmn_jax.errors import InputError, float_array, is_traced
from kmn_jax.typing import ArrayInput

_LARGEST = 1e18  # a length whose square, summed over three axes, still fits float32


def check_extent(extent: Float[Array, ""], name: str) -> None:
    """Raise InputError where a cloud has no extent, or one beyond float32; under a trace nothing is known."""
    if is_traced(extent):
        return
    if float(extent) == 0:
        raise InputError(f"{name} has no extent: all of its points coincide")
    if not float(extent) < _LARGEST:
        raise InputError(f"{name} is too large for float32: use a larger unit of length")


def cloud_array(value: ArrayInput, name: str, mask: jax.Array | None = None) -> Float[Array, "n 6"]:
    """Return a cloud (n, 6) as float32. Raises InputError for another shape or dtype, or without any point."""
    cloud = float_array(value, name, (None, 6), mask=mask)
    if cloud.shape[0] == 0:
        raise InputError(f"{name} is empty: at least one point is needed")
    return cloud.astype(jnp.float32)
