"""Scene and object encoder: one class, two instances (arXiv 2303.16102, section III)."""

from __future__ import annotations

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.geometry import k_nearest, neighbor_graph, space_filling_order
from kmn_jax.models._coarse import CoarseLevel
from kmn_jax.models._config import KeyMatchNetConfig
from kmn_jax.models._edgeconv import EdgeConv
from kmn_jax.models._invariants import LATER_PAIR_CHANNELS, PAIR_CHANNELS, EncoderInputs
from kmn_jax.models._layers import Compute, NormalizedLinear, channel_moments, product


class Encoder(nnx.Module):
    """Three EdgeConv blocks, a global feature from all their outputs, and one layer on [global ; local].

    The scene encoder keeps every point. The object encoder, given keypoint indices, looks at all points in
    its first block and for the neighbours in its second, but only the keypoints' rows go on; in its third
    block every keypoint is a neighbour of every other. A coarse level is of scenes alone.
    """

    def __init__(self, config: KeyMatchNetConfig, channels: int, *, coarse: bool = False, rngs: nnx.Rngs) -> None:
        """Take points of so many `channels`, and features of their pairs as the config says."""
        width, groups = config.edge_width, config.groups
        pairs, later_pairs = PAIR_CHANNELS[config.inputs], LATER_PAIR_CHANNELS[config.inputs]
        self.edge1 = EdgeConv(channels, width, 2, groups, pair_features=pairs, rngs=rngs)
        self.edge2 = EdgeConv(width, width, 2, groups, pair_features=later_pairs, rngs=rngs)
        self.edge3 = EdgeConv(width, width, 1, groups, rngs=rngs)
        local = 3 * width
        self.coarse = CoarseLevel(config, local, rngs=rngs) if coarse else None
        local += 2 * width if coarse else 0
        self.embedding = NormalizedLinear(local, config.embedding_width, groups, rngs=rngs)
        self.out = NormalizedLinear(config.embedding_width + local, config.scene_width, groups, rngs=rngs)
        self.num_neighbors = config.num_neighbors
        self.graph = config.graph
        self.chiral = config.inputs == "chiral"

    def __call__(
        self,
        inputs: EncoderInputs,
        compute: Compute,
        mask: Bool[Array, " n"] | None = None,
        keypoint_indices: Int[Array, " k"] | None = None,
    ) -> Float[Array, "rows out"]:
        """Return one feature per point, or per keypoint when `keypoint_indices` are given.

        Rows where `mask` is false are padding: they are nobody's neighbour and count in no statistic; their
        own features mean nothing. Inside, points are in an order in which near ones are close in memory.
        """
        order, places = space_filling_order(inputs.xyz, mask)
        inputs, mask = inputs.rows(order), None if mask is None else mask[order]
        if keypoint_indices is not None:
            keypoint_indices = places[keypoint_indices]
        k = min(self.num_neighbors, inputs.xyz.shape[0])
        edge_mask = None if mask is None else mask[:, None] & (jnp.arange(k)[None, :] < mask.sum())
        graph = neighbor_graph(inputs.xyz, k, mask)
        x1 = self.edge1(
            inputs.point_features, graph, compute, None, edge_mask, inputs.pair_features(graph, self.chiral)
        )
        if keypoint_indices is None:
            graph = graph if self.graph == "static" else neighbor_graph(x1, k, mask)
            x2 = self.edge2(x1, graph, compute, None, edge_mask, inputs.later_pair_features(graph, self.chiral))
            graph = graph if self.graph == "static" else neighbor_graph(x2, k, mask)
            x3 = self.edge3(x2, graph, compute, None, edge_mask)
        else:
            centers = x1[keypoint_indices]
            graph = graph[keypoint_indices] if self.graph == "static" else k_nearest(centers, x1, k, mask)
            edge_mask = None if edge_mask is None else edge_mask[keypoint_indices]
            x2 = self.edge2(
                x1, graph, compute, centers, edge_mask, inputs.later_pair_features(graph, self.chiral, keypoint_indices)
            )
            x1, x3, mask = centers, self.edge3.complete_graph(x2, compute), None
        local = jnp.concatenate([x1, x2, x3], axis=1)
        if self.coarse is not None:
            local = jnp.concatenate([local, self.coarse(local, inputs, compute, mask)], axis=1)
        features = self._with_global(local, compute, mask)
        return features[places] if keypoint_indices is None else features

    def _with_global(
        self, local: Float[Array, "n l"], compute: Compute, mask: Bool[Array, " n"] | None
    ) -> Float[Array, "n out"]:
        """Return the layer on [global ; local]: the global part is one vector, so it is multiplied once."""
        z = product(local, self.embedding.kernel[...], compute)
        affine = self.embedding.affine(channel_moments(z, mask))
        overall = affine.activated_largest(z, 0, mask).astype(z.dtype)
        kernel = self.out.kernel[...]
        width = overall.shape[0]
        z = product(local, kernel[width:], compute) + product(overall[None, :], kernel[:width], compute)
        return self.out.affine(channel_moments(z, mask)).activated(z).astype(z.dtype)
