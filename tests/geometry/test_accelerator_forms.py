"""What is computed otherwise on accelerators, beside the form for CPUs, both on a CPU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.geometry import (
    _selection,
    ask_for_fast_selection,
    dominant_eigenvector,
    k_nearest,
    largest,
    neighbor_graph,
    normals_within_radius,
    smallest_at,
)
from tests.reference.devices import accelerator_forms


@pytest.fixture
def points() -> jax.Array:
    return jax.random.normal(jax.random.key(0), (130, 3))


@pytest.mark.parametrize(
    "function",
    [
        lambda x: jnp.sort(k_nearest(x[:40], x, 17)),
        lambda x: jnp.sort(neighbor_graph(x, 17)),
        lambda x: jnp.sort(neighbor_graph(jnp.tanh(jnp.concatenate([x, 2 * x], axis=1)), 17)),
        lambda x: jnp.sort(k_nearest(jnp.tile(x[:40], 2), jnp.tile(x, 2), 17, jnp.arange(len(x)) % 3 > 0)),
        lambda x: k_nearest(jnp.tile(x[:40], 2), jnp.tile(x, 2), 17, jnp.arange(len(x)) == 5),
        lambda x: jax.vmap(lambda y: dominant_eigenvector(jnp.outer(y, y) + jnp.eye(3)))(x),
        lambda x: normals_within_radius(x, x, 1.0),
        lambda x: largest(x[:, 0], 30),
        lambda x: largest(jnp.where(x[:100, :1] > 0, jnp.tile(x.reshape(1, -1)[:, :128], (100, 1)), -jnp.inf), 3),
        lambda x: jnp.sort(neighbor_graph(x[:128], 3, jnp.arange(128) % 5 > 0)),
        lambda x: smallest_at(jnp.abs(x[:, 0]), jnp.int32(7)),
    ],
    ids=[
        "k_nearest",
        "neighbor_graph",
        "neighbors of features",
        "masked features",
        "one real",
        "eigenvectors",
        "planes",
        "selection",
        "selection from groups",
        "neighbors from groups",
        "the number at a place",
    ],
)
def test_both_forms_agree(function: Callable[[jax.Array], Any], points: jax.Array) -> None:
    of_cpu = jax.jit(lambda x: function(x))(points)
    with accelerator_forms() as asked:
        found = jax.jit(lambda x: function(x))(points)
    assert asked
    # Eigenvectors of 24 squarings agree to rounding of each.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), found, of_cpu)


def test_only_versions_of_jax_that_cannot_ask_for_fast_selection_tell_xla(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XLA_FLAGS", "--xla_some=1")
    monkeypatch.setattr(_selection, "_ANY_TIES", {})
    monkeypatch.setattr(_selection, "_GPU_PACKAGES", ("jax_for_no_gpu",))
    ask_for_fast_selection()
    monkeypatch.setattr(_selection, "_GPU_PACKAGES", ("jax_for_no_gpu", "jax"))
    monkeypatch.setattr(_selection, "_ANY_TIES", {"is_stable": False})
    ask_for_fast_selection()
    assert _selection.os.environ["XLA_FLAGS"] == "--xla_some=1"
    monkeypatch.setattr(_selection, "_ANY_TIES", {})
    for _ in range(2):
        ask_for_fast_selection()
        assert _selection.os.environ["XLA_FLAGS"] == f"--xla_some=1 --{_selection._FLAG}=true"
