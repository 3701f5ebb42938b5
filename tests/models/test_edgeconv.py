from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from kmn_jax.models._edgeconv import EdgeConv
from tests.models.test_layers import layer_form
from tests.reference.networks import signed

call = jax.jit(EdgeConv.__call__, static_argnames="compute")


def signed_block(in_features: int, depth: int, pair_features: int = 0) -> EdgeConv:
    return signed(lambda: EdgeConv(in_features, 16, depth, 8, pair_features=pair_features, rngs=nnx.Rngs(0)), 1)


@jax.jit
def dense_block(block: EdgeConv, edges: jax.Array) -> jax.Array:
    x = layer_form(block.first, edges)
    return (layer_form(block.second, x) if block.second is not None else x).max(axis=1)


def edges_of(x: np.ndarray, graph: np.ndarray, centers: np.ndarray) -> np.ndarray:
    return np.concatenate([x[graph] - centers[:, None], np.broadcast_to(centers[:, None], x[graph].shape)], axis=-1)


def drawn(seed: int, points: int, shape: tuple[int, int], channels: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Return points and a graph."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(points, channels)).astype("f4"), rng.integers(0, points, shape)


@pytest.mark.parametrize("depth", [1, 2])
def test_equals_the_layer_on_concatenated_edges(depth: int) -> None:
    x, graph = drawn(depth, 60, (60, 9))
    block = signed_block(6, depth)
    np.testing.assert_allclose(call(block, x, graph, "float32"), dense_block(block, edges_of(x, graph, x)), atol=1e-5)


def test_pair_features_join_the_edges() -> None:
    x, graph = drawn(4, 50, (50, 7), 2)
    pairs = np.random.default_rng(5).normal(size=(50, 7, 4)).astype("f4")
    block = signed_block(2, 2, pair_features=4)
    want = dense_block(block, np.concatenate([edges_of(x, graph, x), pairs], axis=-1))
    np.testing.assert_allclose(call(block, x, graph, "float32", pair_features=pairs), want, atol=1e-5)


def test_centers_may_be_few() -> None:
    x, graph = drawn(5, 60, (3, 9))
    few = x[[3, 50, 7]]
    block = signed_block(6, 2)
    want = dense_block(block, edges_of(x, graph, few))
    np.testing.assert_allclose(call(block, x, graph, "float32", few), want, atol=1e-5)


def test_masked_edges_count_in_no_statistic() -> None:
    x, graph = drawn(6, 40, (40, 5))
    block = signed_block(6, 2)
    padded = np.concatenate([graph, np.broadcast_to(graph[:, :1], (40, 3))], axis=1)
    mask = np.broadcast_to(np.arange(8) < 5, (40, 8))
    want = call(block, x, graph, "float32")
    np.testing.assert_allclose(call(block, x, padded, "float32", edge_mask=mask), want, atol=1e-5)


def test_complete_graph_forms_no_edge_and_is_the_same() -> None:
    x = drawn(7, 20, (1, 1))[0]
    block = signed_block(6, 1)
    got = jax.jit(EdgeConv.complete_graph, static_argnames="compute")(block, x, "float32")
    everyone = np.broadcast_to(np.arange(20), (20, 20))
    np.testing.assert_allclose(got, call(block, x, everyone, "float32"), atol=1e-5)


def test_unusable_depths_are_refused() -> None:
    with pytest.raises(ValueError, match="1 or 2 layers"):
        EdgeConv(6, 16, 3, 8, rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="one-layer"):
        signed_block(6, 2).complete_graph(jnp.ones((4, 6)), "float32")
