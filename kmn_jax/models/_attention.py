"""Attention of several heads (Vaswani et al., NeurIPS 2017), added to the features of what attends."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

from kmn_jax.models._layers import Compute, NormalizedLinear, drawn_kernel, precision_of, product

HEADS = 4


class Attention(nnx.Module):
    """What each row sees of all others, weighted by how well its query fits their keys, through one layer."""

    def __init__(
        self, features: int, others: int, width: int, groups: int, *, pair_features: int = 0, rngs: nnx.Rngs
    ) -> None:
        """Let rows of so many `features` attend to rows of `others`; `width` is that of all heads together.

        With `pair_features` above zero, so many given features of each pair also decide how much it counts.
        """
        self.query, self.key, self.value = (
            nnx.Param(drawn_kernel(own, width, rngs)) for own in (features, others, others)
        )
        self.pair = nnx.Param(drawn_kernel(pair_features, HEADS, rngs)) if pair_features else None
        self.out = NormalizedLinear(width, features, groups, rngs=rngs)

    def __call__(
        self,
        x: Float[Array, "n c"],
        others: Float[Array, "m o"],
        compute: Compute,
        mask: Bool[Array, " n"] | None = None,
        others_mask: Bool[Array, " m"] | None = None,
        pair_features: Float[Array, "n m p"] | None = None,
    ) -> Float[Array, "n c"]:
        """Return the features with what was seen.

        Rows where `mask` is false count in no statistic, others where `others_mask` is false are not seen.
        """
        query, key, value = (
            product(rows, kernel[...], compute).reshape(len(rows), HEADS, -1)
            for rows, kernel in ((x, self.query), (others, self.key), (others, self.value))
        )
        fit = jnp.einsum("nhd,mhd->hnm", query, key, precision=precision_of(compute)).astype(jnp.float32)
        fit = fit / jnp.sqrt(jnp.float32(query.shape[2]))
        if self.pair is not None and pair_features is not None:
            fit = fit + jnp.moveaxis(product(pair_features, self.pair[...], compute), 2, 0).astype(jnp.float32)
        if others_mask is not None:
            fit = jnp.where(others_mask[None, None, :], fit, -jnp.inf)
        share = jax.nn.softmax(fit, axis=2).astype(value.dtype)
        seen = jnp.einsum("hnm,mhd->nhd", share, value, precision=precision_of(compute))
        return (x + self.out(seen.reshape(len(x), -1), compute, mask)).astype(x.dtype)
