"""Maps over leading axes: one item after the other on CPUs, where side by side they leave the cache."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from kmn_jax.platforms import by_platform
from kmn_jax.programs import compiled_size

_Result = TypeVar("_Result")
_FEWEST = 16  # items that accelerators are given at once


def map_rows(function: Callable[..., _Result], *items: Any) -> _Result:
    """Map a function over leading axes, inside of jit."""
    return by_platform(
        *items,
        cpu=lambda *items: jax.lax.map(lambda item: function(*item), items),
        default=jax.vmap(function),
    )


def map_real(function: Callable[..., _Result], real: Bool[Array, " s"], *items: Any) -> _Result:
    """Map a function over leading axes, inside of jit, to zeros where `real` is false: on CPUs these are skipped.

    Accelerators call it anyway: their host would have to wait to know whether.
    """
    first = jax.tree.map(lambda leaf: leaf[0], items)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(function, *first))

    def one(real: Bool[Array, ""], *item: Any) -> _Result:
        return jax.lax.cond(real, function, lambda *item: zeros, *item)

    return map_rows(one, real, *items)


def call_rows(one: Callable[..., _Result], many: Callable[..., _Result], *items: Any) -> _Result:
    """Return on the host what a compiled function makes of each item, stacked.

    On CPUs `one` is called item by item, on two threads, as XLA keeps little more than one core busy with what comes
    one after the other; elsewhere `many` gets all at once, filled up to a power of two, so that few numbers are ever
    compiled. Contexts of JAX that hold for one thread only, such as `jax.default_device`, do not reach the threads.
    """
    count = len(jax.tree.leaves(items)[0])
    if jax.default_backend() != "cpu":
        padded = np.minimum(np.arange(max(_FEWEST, compiled_size(count))), count - 1)
        found: Any = jax.device_get(many(*jax.tree.map(lambda leaf: leaf[padded], items)))
        return cast(_Result, jax.tree.map(lambda leaf: leaf[:count], found))
    rows = [jax.tree.map(lambda leaf, row=row: leaf[row], items) for row in range(count)]
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda item: jax.device_get(one(*jax.device_put(item))), rows))
    stacked: _Result = jax.tree.map(lambda *leaves: np.stack(leaves), *found)
    return stacked
