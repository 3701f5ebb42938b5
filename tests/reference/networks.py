"""A network of the smallest widths, for what is not about accuracy; and modules whose weights are drawn quickly."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from kmn_jax.models import KeyMatchNetConfig

M = TypeVar("M", bound=nnx.Module)

TINY = KeyMatchNetConfig(
    num_scene_points=64,
    num_object_points=64,
    num_keypoints=4,
    num_neighbors=4,
    edge_width=8,
    embedding_width=16,
    scene_width=16,
    object_width=8,
    pair_width=8,
    groups=4,
    inputs="invariant",
    graph="static",
)


def signed(make: Callable[[], M], seed: int, bias: float = 1.0) -> M:
    """Return a module with kernels as they start, and GroupNorm weights of both signs and biases of this deviation.

    NumPy draws them: JAX compiles each initialiser of each shape.
    """
    rng = np.random.default_rng(seed)

    def drawn(path: tuple[Any, ...], shape: jax.ShapeDtypeStruct) -> jax.Array:
        values = rng.uniform(-1, 1, shape.shape) / shape.shape[0] ** 0.5
        if path[-2].name == "norm_scale":
            values = rng.uniform(0.5, 1.5, shape.shape) * rng.choice([-1, 1], shape.shape)
        if path[-2].name == "norm_bias":
            values = rng.normal(size=shape.shape) * bias
        return jnp.asarray(values.astype(np.float32))

    module: M = jax.tree_util.tree_map_with_path(drawn, nnx.eval_shape(make))
    return module
