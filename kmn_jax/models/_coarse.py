"""A coarse level of the scene encoder: a few of the points look farther, and all points are told what they see."""

from __future__ import annotations

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

from kmn_jax.geometry import farthest_point_indices, k_nearest, neighbor_graph
from kmn_jax.models._attention import Attention
from kmn_jax.models._config import KeyMatchNetConfig
from kmn_jax.models._edgeconv import EdgeConv
from kmn_jax.models._invariants import LATER_PAIR_CHANNELS, EncoderInputs
from kmn_jax.models._layers import Compute

_TOLD_BY = 3  # coarse points, of which a point takes its features
_TOUCHING = 1e-4  # of the crop's radius, squared: added to squared distances, by whose inverse they count


class CoarseLevel(nnx.Module):
    """Two blocks on the farthest of the points: EdgeConv among near ones of them, then that again, or attention to all.

    Features go back as the mean of those of the three nearest coarse points, by inverse squared distances (Qi et al.,
    PointNet++, NIPS 2017).
    """

    def __init__(self, config: KeyMatchNetConfig, features: int, *, rngs: nnx.Rngs) -> None:
        """Take points of so many features; twice the config's edge width go back."""
        width, groups, pairs = config.edge_width, config.groups, LATER_PAIR_CHANNELS[config.inputs]
        self.near = EdgeConv(features, width, 2, groups, pair_features=pairs, rngs=rngs)
        self.far = (
            EdgeConv(width, width, 1, groups, rngs=rngs)
            if config.attention == "none"
            else Attention(width, width, width, groups, pair_features=pairs, rngs=rngs)
        )
        self.num_points, self.num_neighbors = config.num_coarse_points, config.num_neighbors
        self.chiral = config.inputs == "chiral"

    def __call__(
        self,
        features: Float[Array, "n c"],
        inputs: EncoderInputs,
        compute: Compute,
        mask: Bool[Array, " n"] | None = None,
    ) -> Float[Array, "n w"]:
        """Return what the coarse level knows at each point."""
        rows = farthest_point_indices(inputs.xyz, min(self.num_points, len(features)), mask=mask)
        total = len(features) if mask is None else jnp.maximum(mask.sum(dtype=jnp.int32), 1)
        there = jnp.arange(len(rows)) < total
        few = inputs.rows(rows)

        def first(count: int) -> Bool[Array, " c"]:  # of so many neighbours, all others being repeats
            return jnp.arange(count) < total

        graph = neighbor_graph(few.xyz, min(self.num_neighbors, len(rows)), there)
        edges = there[:, None] & first(graph.shape[1])[None, :]
        near = self.near(features[rows], graph, compute, None, edges, few.later_pair_features(graph, self.chiral))
        if isinstance(self.far, EdgeConv):
            far = self.far(near, graph, compute, None, edges)
        else:
            everyone = jnp.broadcast_to(jnp.arange(len(rows), dtype=jnp.int32), (len(rows), len(rows)))
            far = self.far(near, near, compute, there, there, few.later_pair_features(everyone, self.chiral))
        told_by = k_nearest(inputs.xyz, few.xyz, min(_TOLD_BY, len(rows)), there)
        squared = ((inputs.xyz[:, None, :] - few.xyz[told_by]) ** 2).sum(axis=2)
        share = jnp.where(first(told_by.shape[1])[None, :], 1 / (squared + _TOUCHING), 0)
        share = (share / share.sum(axis=1, keepdims=True)).astype(far.dtype)
        return (share[:, :, None] * jnp.concatenate([near, far], axis=1)[told_by]).sum(axis=1)
