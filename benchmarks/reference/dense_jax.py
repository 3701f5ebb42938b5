"""The published network as a plain dense JAX function: every edge and every pair is formed.

Takes the parameters of `kmn_jax.models.KeyMatchNet` (raw inputs), normalised clouds and, if given, the
neighbour graphs. The reference that the separated form is held against, and its rival in the benchmarks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

Parameters: TypeAlias = Mapping[str, Any]
HIGHEST = jax.lax.Precision.HIGHEST


def group_norm(z: jax.Array, scale: jax.Array, bias: jax.Array, groups: int = 32) -> jax.Array:
    """Two-pass GroupNorm over all leading axes, in the plain (rows, groups, width) form."""
    rows = z.reshape(-1, groups, z.shape[-1] // groups)
    mean = rows.mean(axis=(0, 2), keepdims=True)
    variance = ((rows - mean) ** 2).mean(axis=(0, 2), keepdims=True)
    return ((rows - mean) / jnp.sqrt(variance + 1e-5)).reshape(z.shape) * scale + bias


def layer(x: jax.Array, parameters: Parameters, groups: int = 32) -> jax.Array:
    z = jnp.matmul(x, parameters["kernel"], precision=HIGHEST)
    z = group_norm(z, parameters["norm_scale"], parameters["norm_bias"], groups)
    return jnp.where(z >= 0, z, 0.2 * z)


def neighbours(features: jax.Array, k: int) -> jax.Array:
    squares = (features**2).sum(-1)
    product = jnp.matmul(features, features.T, precision=HIGHEST)
    return jax.lax.top_k(2 * product - squares[:, None] - squares[None, :], k)[1]


def edges(features: jax.Array, graph: jax.Array) -> jax.Array:
    neighbour = features[graph]
    centre = jnp.broadcast_to(features[: graph.shape[0], None], neighbour.shape)
    return jnp.concatenate([neighbour - centre, centre], axis=-1)


def encode(
    cloud: jax.Array,
    parameters: Parameters,
    k: int,
    keypoints: jax.Array | None = None,
    graphs: Sequence[jax.Array] | None = None,
) -> jax.Array:
    graph = neighbours(cloud[:, :3], k) if graphs is None else graphs[0]
    x1 = layer(layer(edges(cloud, graph), parameters["edge1"]["first"]), parameters["edge1"]["second"]).max(1)
    graph = neighbours(x1, k) if graphs is None else graphs[1]
    features = edges(x1, graph)
    if keypoints is not None:
        x1, features = x1[keypoints], features[keypoints]
    x2 = layer(layer(features, parameters["edge2"]["first"]), parameters["edge2"]["second"]).max(1)
    if keypoints is not None:
        graph = jnp.broadcast_to(jnp.arange(len(x2)), (len(x2), len(x2)))
    else:
        graph = neighbours(x2, k) if graphs is None else graphs[2]
    x3 = layer(edges(x2, graph), parameters["edge3"]["first"]).max(1)
    local = jnp.concatenate([x1, x2, x3], axis=1)
    overall = layer(local, parameters["embedding"]).max(0)
    overall = jnp.broadcast_to(overall, (len(local), len(overall)))
    return layer(jnp.concatenate([overall, local], axis=1), parameters["out"])


def encode_object(
    cloud: jax.Array,
    keypoints: jax.Array,
    parameters: Parameters,
    k: int = 20,
    graphs: Sequence[jax.Array] | None = None,
) -> jax.Array:
    return layer(encode(cloud, parameters["object"], k, keypoints, graphs), parameters["object_out"])


def encode_scene(
    cloud: jax.Array, parameters: Parameters, k: int = 20, graphs: Sequence[jax.Array] | None = None
) -> jax.Array:
    return encode(cloud, parameters["scene"], k, None, graphs)


def match(scene: jax.Array, part: jax.Array, parameters: Parameters, groups: int = 32) -> tuple[jax.Array, jax.Array]:
    shape = (len(scene), len(part))
    part = jnp.broadcast_to(part[None], (*shape, part.shape[-1]))
    scene = jnp.broadcast_to(scene[:, None], (*shape, scene.shape[-1]))
    head = parameters["head"]
    x = layer(jnp.concatenate([scene, part], axis=-1), head["scene_pair"], groups).max(1, keepdims=True)
    x = jnp.broadcast_to(x, (*shape, x.shape[-1]))
    x = layer(jnp.concatenate([x, part], axis=-1), head["context_pair"], groups)
    segmentation = jnp.matmul(x.max(1), head["segmentation"], precision=HIGHEST)
    return segmentation, jnp.matmul(x, head["keypoint"], precision=HIGHEST)[..., 0]
