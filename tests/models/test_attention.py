from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from kmn_jax.models._attention import HEADS, Attention
from tests.models.test_layers import layer_form
from tests.reference.networks import signed

call = jax.jit(Attention.__call__, static_argnames="compute")


def attention(pair_features: int = 0) -> Attention:
    return signed(lambda: Attention(24, 10, 16, 8, pair_features=pair_features, rngs=nnx.Rngs(0)), 0)


def rows(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype("f4")


@pytest.mark.parametrize("pairs", [None, rows(3, 30, 7, 5)], ids=["alone", "pairs"])
def test_rows_see_all_others_as_their_queries_fit_keys(pairs: np.ndarray | None) -> None:
    made, x, others = attention(0 if pairs is None else 5), rows(1, 30, 24), rows(2, 7, 10)
    query, key, value = (
        (of @ np.asarray(kernel[...])).reshape(len(of), HEADS, 4)
        for of, kernel in ((x, made.query), (others, made.key), (others, made.value))
    )
    seen = np.zeros((30, HEADS, 4), "f4")
    for head in range(HEADS):
        fit = query[:, head] @ key[:, head].T / np.sqrt(4)
        if pairs is not None and made.pair is not None:
            fit = fit + (pairs @ np.asarray(made.pair[...]))[:, :, head]
        share = np.exp(fit) / np.exp(fit).sum(axis=1, keepdims=True)
        seen[:, head] = share @ value[:, head]
    want = x + np.asarray(jax.jit(layer_form)(made.out, seen.reshape(30, 16)))
    np.testing.assert_allclose(call(made, x, others, "float32", pair_features=pairs), want, atol=2e-6)


def test_few_bits_stay_close() -> None:
    made, x, others, pairs = attention(5), rows(1, 30, 24), rows(2, 7, 10), rows(3, 30, 7, 5)
    want = np.asarray(call(made, x, others, "float32", pair_features=pairs))
    got = call(made, x.astype(jnp.bfloat16), others.astype(jnp.bfloat16), "bfloat16", pair_features=pairs)
    assert got.dtype == jnp.bfloat16
    assert np.sqrt(((np.asarray(got, "f4") - want) ** 2).mean()) < 0.02 * np.ptp(want)


def test_padding_is_neither_seen_nor_counted() -> None:
    made, x, others = attention(), rows(1, 30, 24), rows(2, 7, 10)
    want = call(made, x[:20], others[:4], "float32")
    x[20:], others[4:] = 99, -99
    got = call(made, x, others, "float32", np.arange(30) < 20, np.arange(7) < 4)
    np.testing.assert_allclose(np.asarray(got)[:20], want, atol=2e-6)
