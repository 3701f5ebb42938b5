"""EdgeConv without its edges: the layer on [x_j - x_i ; x_i] is one product per point, then gather and add."""

from __future__ import annotations

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.models._layers import Compute, NormalizedLinear, channel_moments, leaky_relu, product


class EdgeConv(nnx.Module):
    """One EdgeConv block (arXiv 2303.16102, section III): edges -> one or two layers -> max over neighbours.

    W [x_j - x_i ; x_i] = A x_j + (B - A) x_i with W = [A ; B], so the edge tensor appears only after the
    first product. `pair_features` > 0 adds that many given features of each edge itself.
    """

    def __init__(
        self, in_features: int, width: int, depth: int, groups: int, *, pair_features: int = 0, rngs: nnx.Rngs
    ) -> None:
        if depth not in (1, 2):
            raise ValueError(f"depth is {depth}, but an EdgeConv block has 1 or 2 layers")
        self.first = NormalizedLinear(2 * in_features + pair_features, width, groups, rngs=rngs)
        self.second = NormalizedLinear(width, width, groups, rngs=rngs) if depth == 2 else None
        self.in_features = in_features

    def __call__(
        self,
        features: Float[Array, "m c"],
        graph: Int[Array, "n k"],
        compute: Compute,
        centers: Float[Array, "n c"] | None = None,
        edge_mask: Bool[Array, "n k"] | None = None,
        pair_features: Float[Array, "n k p"] | None = None,
    ) -> Float[Array, "n width"]:
        """Return the pooled edge features of each centre; `centers` defaults to all of `features`.

        Where `edge_mask` is false an edge counts in no statistic; it may only repeat a real edge of its centre.
        """
        neighbor_term, center_term = self._terms(features, features if centers is None else centers, compute)
        z = neighbor_term[graph] + center_term[:, None, :]
        if pair_features is not None:
            z = z + product(pair_features, self.first.kernel[...][2 * self.in_features :], compute)
        affine = self.first.affine(channel_moments(z, edge_mask))
        if self.second is not None:
            h = affine.activated(z).astype(z.dtype)
            z = product(h, self.second.kernel[...], compute)
            affine = self.second.affine(channel_moments(z, edge_mask))
        return affine.activated_largest(z, axis=1).astype(z.dtype)

    def complete_graph(self, features: Float[Array, "n c"], compute: Compute) -> Float[Array, "n width"]:
        """Return the same for a one-layer block in which every point is a neighbour of every other.

        All pairs form a grid of sums, so its statistics and its maximum separate and no edge is formed.
        """
        if self.second is not None:
            raise ValueError("only a one-layer block separates over the complete graph")
        neighbor_term, center_term = self._terms(features, features, compute)
        affine = self.first.affine(channel_moments(neighbor_term).plus(channel_moments(center_term)))
        best = (neighbor_term.astype(jnp.float32) * affine.scale[None, :]).max(axis=0)
        return leaky_relu(affine(center_term) + best[None, :]).astype(center_term.dtype)

    def _terms(
        self, features: Float[Array, "m c"], centers: Float[Array, "n c"], compute: Compute
    ) -> tuple[Float[Array, "m width"], Float[Array, "n width"]]:
        kernel = self.first.kernel[...]
        difference, own = kernel[: self.in_features], kernel[self.in_features : 2 * self.in_features]
        return product(features, difference, compute), product(centers, own - difference, compute)
