"""Maps over rows: inside of jit, with rows that are skipped, and on the host by two threads."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import call_rows, map_real, map_rows
from tests.reference.devices import accelerator_forms


class Pair(NamedTuple):
    """Some results of an item."""

    total: jax.Array
    draw: jax.Array


@jax.jit
def one(values: jax.Array, key: jax.Array) -> Pair:
    return Pair(jnp.cumsum(values), jax.random.normal(key, (3,)))


def test_rows_are_mapped_in_their_order_and_skipped_where_not_real() -> None:
    values, keys = jnp.arange(24.0).reshape(8, 3), jax.random.split(jax.random.key(0), 8)
    whole = jax.vmap(one)(values, keys)
    mapped = jax.jit(map_rows, static_argnums=0)(one, values, keys)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), mapped, whole)
    real = jnp.arange(8) % 2 == 0
    some = jax.jit(map_real, static_argnums=0)(one, real, values, keys)
    np.testing.assert_allclose(some.total, jnp.where(real[:, None], whole.total, 0))
    np.testing.assert_allclose(some.draw, jnp.where(real[:, None], whole.draw, 0), rtol=1e-6)


def test_accelerators_are_given_no_choice_to_wait_for() -> None:
    values, key = jnp.arange(3.0)[None], jax.random.split(jax.random.key(0), 1)

    def of_a_row(real: bool) -> Pair:
        return jax.jit(map_real, static_argnums=0)(one, jnp.array([real]), values, key)

    found = {"here": [of_a_row(True), of_a_row(False)]}
    with accelerator_forms():
        program = str(jax.make_jaxpr(lambda real, *items: map_real(one, real, *items))(jnp.array([True]), values, key))
        assert "cond" not in program
        assert "select_n" in program
        jax.clear_caches()
        found["there"] = [of_a_row(True), of_a_row(False)]
    for called, zeros in found.values():
        jax.tree.map(np.testing.assert_array_equal, called, jax.vmap(one)(values, key))
        jax.tree.map(lambda leaf: np.testing.assert_array_equal(leaf, 0), zeros)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_calls_give_what_one_call_of_all_gives(count: int) -> None:
    values, keys = np.arange(3.0 * count).reshape(count, 3), jax.random.split(jax.random.key(0), count)
    found, whole = call_rows(one, jax.vmap(one), values, keys), jax.vmap(one)(values, keys)
    for a, b in zip(found, whole, strict=True):
        assert isinstance(a, np.ndarray)
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_accelerators_compile_few_numbers_of_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "cuda")
    shapes = []

    def many(values: np.ndarray) -> jax.Array:
        shapes.append(len(values))
        return jnp.asarray(2 * values)

    for count in (1, 16, 17, 40, 64):
        values = np.arange(float(count))
        np.testing.assert_array_equal(call_rows(many, many, values), 2 * values)
    assert shapes == [16, 16, 32, 64, 64]


def test_errors_come_out_of_the_threads() -> None:
    def fail(values: np.ndarray) -> jax.Array:
        return jnp.dot(values, "text")

    with pytest.raises(TypeError):
        call_rows(fail, fail, np.zeros((4, 3)))
