"""Maps over leading axes: one item after the other on CPUs, where side by side they leave the cache."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

_Result = TypeVar("_Result")
_STEP = 16  # items


def map_rows(function: Callable[..., _Result], *items: Any) -> _Result:
    """Map a function over leading axes, inside of jit."""
    return jax.lax.platform_dependent(
        *items,
        cpu=lambda *items: jax.lax.map(lambda item: function(*item), items),
        default=jax.vmap(function),
    )


def map_real(function: Callable[..., _Result], real: Bool[Array, " s"], *items: Any) -> _Result:
    """Map a function over leading axes, inside of jit, to zeros where `real` is false: on CPUs these take no time.

    Accelerators call it anyway: their host would have to wait to know whether.
    """
    first = jax.tree.map(lambda leaf: leaf[0], items)
    shapes = jax.eval_shape(function, *first)

    def in_turn(real: Bool[Array, " s"], *items: Any) -> _Result:
        def step(state: tuple[Bool[Array, " s"], _Result]) -> tuple[Bool[Array, " s"], _Result]:
            left, results = state
            row = jnp.argmax(left)
            new = function(*jax.tree.map(lambda leaf: leaf[row], items))
            return left.at[row].set(False), jax.tree.map(lambda leaf, one: leaf.at[row].set(one), results, new)

        none = jax.tree.map(lambda leaf: jnp.zeros((len(real), *leaf.shape), leaf.dtype), shapes)
        return jax.lax.while_loop(lambda state: state[0].any(), step, (real, none))[1]

    def at_once(real: Bool[Array, " s"], *items: Any) -> _Result:
        def one(real: Bool[Array, ""], *item: Any) -> _Result:
            zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
            return jax.tree.map(partial(jnp.where, real), function(*item), zeros)

        return jax.vmap(one)(real, *items)

    return jax.lax.platform_dependent(real, *items, cpu=in_turn, default=at_once)


def call_rows(one: Callable[..., _Result], many: Callable[..., _Result], *items: Any) -> _Result:
    """Return on the host what a compiled function makes of each item, stacked.

    On CPUs `one` is called item by item, on two threads, as XLA keeps little more than one core busy with what comes
    one after the other; elsewhere `many` gets all at once. Contexts of JAX that hold for one thread only, such as
    `jax.default_device`, do not reach the threads.
    """
    count = len(jax.tree.leaves(items)[0])
    if jax.default_backend() != "cpu":
        padded = np.minimum(np.arange(count + -count % _STEP), count - 1)  # few numbers are ever compiled
        found: Any = jax.device_get(many(*jax.tree.map(lambda leaf: leaf[padded], items)))
        return cast(_Result, jax.tree.map(lambda leaf: leaf[:count], found))
    rows = [jax.tree.map(lambda leaf, row=row: leaf[row], items) for row in range(count)]
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda item: jax.device_get(one(*jax.device_put(item))), rows))
    stacked: _Result = jax.tree.map(lambda *leaves: np.stack(leaves), *found)
    return stacked
