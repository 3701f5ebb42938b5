"""Batches in two threads are the batches themselves."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection._halves import in_halves


class Pair(NamedTuple):
    """Some results of a batch."""

    total: jax.Array
    draw: jax.Array


@jax.jit
def function(values: jax.Array, keys: jax.Array) -> Pair:
    return Pair(jnp.cumsum(values, axis=1), jax.vmap(lambda key: jax.random.normal(key, (3,)))(keys))


def test_results_are_those_of_the_whole_batch_in_its_order() -> None:
    values, keys = jnp.arange(24.0).reshape(8, 3), jax.random.split(jax.random.key(0), 8)
    whole, halves = function(values, keys), in_halves(function, values, keys)
    for one, other in zip(whole, halves, strict=True):
        np.testing.assert_array_equal(one, other)


def test_each_thread_gets_as_many_of_the_first_items() -> None:
    seen = []

    def count(real: jax.Array) -> jax.Array:
        seen.append(int(real.sum()))
        return real

    found = in_halves(count, jnp.arange(32) < 16)
    assert sorted(seen) == ([8, 8] if jax.default_backend() == "cpu" else [16])
    np.testing.assert_array_equal(found, np.arange(32) < 16)


def test_errors_come_out_of_the_threads() -> None:
    with pytest.raises(TypeError):
        in_halves(lambda values: jnp.dot(values, "text"), jnp.zeros((4, 3)))
