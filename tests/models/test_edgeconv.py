from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from benchmarks.reference import dense_jax
from kmn_jax.models._edgeconv import EdgeConv
from kmn_jax.models._layers import NormalizedLinear
from tests.models.test_layers import signed_layer


def signed_block(in_features: int, depth: int, pair_features: int = 0) -> EdgeConv:
    block = EdgeConv(in_features, 16, depth, 8, pair_features=pair_features, rngs=nnx.Rngs(0))
    block.first = signed_layer(2 * in_features + pair_features, 16, 8, seed=1)
    if depth == 2:
        block.second = signed_layer(16, 16, 8, seed=2)
    return block


def dense_layer(x: jnp.ndarray, layer: NormalizedLinear) -> jnp.ndarray:
    parameters = {"kernel": layer.kernel[...]}
    parameters |= {
        name: getattr(layer, name)[...].reshape((1,) * (x.ndim - 1) + (-1,)) for name in ("norm_scale", "norm_bias")
    }
    z = dense_jax.group_norm(x @ parameters["kernel"], parameters["norm_scale"], parameters["norm_bias"], layer.groups)
    return jnp.where(z >= 0, z, 0.2 * z)


def dense_block(block: EdgeConv, edges: jnp.ndarray) -> jnp.ndarray:
    x = dense_layer(edges, block.first)
    return (dense_layer(x, block.second) if block.second is not None else x).max(axis=1)


@pytest.mark.parametrize("depth", [1, 2])
def test_equals_the_layer_on_concatenated_edges(depth: int) -> None:
    rng = np.random.default_rng(depth)
    x = jnp.asarray(rng.normal(size=(60, 6)), "f4")
    graph = jnp.asarray(rng.integers(0, 60, (60, 9)))
    block = signed_block(6, depth)
    np.testing.assert_allclose(block(x, graph, "float32"), dense_block(block, dense_jax.edges(x, graph)), atol=1e-5)


def test_pair_features_join_the_edges() -> None:
    rng = np.random.default_rng(4)
    x, pairs = jnp.asarray(rng.normal(size=(50, 2)), "f4"), jnp.asarray(rng.normal(size=(50, 7, 4)), "f4")
    graph = jnp.asarray(rng.integers(0, 50, (50, 7)))
    block = signed_block(2, 2, pair_features=4)
    want = dense_block(block, jnp.concatenate([dense_jax.edges(x, graph), pairs], axis=-1))
    np.testing.assert_allclose(block(x, graph, "float32", pair_features=pairs), want, atol=1e-5)


def test_centers_may_be_few() -> None:
    rng = np.random.default_rng(5)
    x = jnp.asarray(rng.normal(size=(60, 6)), "f4")
    rows = jnp.array([3, 50, 7])
    graph = jnp.asarray(rng.integers(0, 60, (3, 9)))
    block = signed_block(6, 2)
    edges = jnp.concatenate([x[graph] - x[rows][:, None, :], jnp.broadcast_to(x[rows][:, None, :], (3, 9, 6))], axis=-1)
    np.testing.assert_allclose(block(x, graph, "float32", x[rows]), dense_block(block, edges), atol=1e-5)


def test_masked_edges_count_in_no_statistic() -> None:
    rng = np.random.default_rng(6)
    x = jnp.asarray(rng.normal(size=(40, 6)), "f4")
    graph = jnp.asarray(rng.integers(0, 40, (40, 5)))
    block = signed_block(6, 2)
    padded = jnp.concatenate([graph, jnp.broadcast_to(graph[:, :1], (40, 3))], axis=1)
    mask = jnp.broadcast_to(jnp.arange(8)[None, :] < 5, (40, 8))
    np.testing.assert_allclose(block(x, padded, "float32", edge_mask=mask), block(x, graph, "float32"), atol=1e-5)


def test_complete_graph_forms_no_edge_and_is_the_same() -> None:
    x = jnp.asarray(np.random.default_rng(7).normal(size=(20, 6)), "f4")
    block = signed_block(6, 1)
    everyone = jnp.broadcast_to(jnp.arange(20)[None, :], (20, 20))
    np.testing.assert_allclose(block.complete_graph(x, "float32"), block(x, everyone, "float32"), atol=1e-5)


def test_unusable_depths_are_refused() -> None:
    with pytest.raises(ValueError, match="1 or 2 layers"):
        EdgeConv(6, 16, 3, 8, rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="one-layer"):
        signed_block(6, 2).complete_graph(jnp.ones((4, 6)), "float32")
