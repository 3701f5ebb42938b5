from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from kmn_jax.models._attention import HEADS, Attention
from tests.models.test_layers import signed_layer


def attention(pair_features: int = 0) -> Attention:
    made = Attention(24, 10, 16, 8, pair_features=pair_features, rngs=nnx.Rngs(0))
    made.out = signed_layer(16, 24, 8, seed=1)
    return made


def rows(seed: int, *shape: int) -> jnp.ndarray:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), "f4")


@pytest.mark.parametrize("pairs", [None, rows(3, 30, 7, 5)], ids=["alone", "pairs"])
def test_rows_see_all_others_as_their_queries_fit_keys(pairs: jnp.ndarray | None) -> None:
    made, x, others = attention(0 if pairs is None else 5), rows(1, 30, 24), rows(2, 7, 10)
    query, key, value = (
        np.asarray(of @ kernel[...]).reshape(len(of), HEADS, 4)
        for of, kernel in ((x, made.query), (others, made.key), (others, made.value))
    )
    seen = np.zeros((30, HEADS, 4))
    for head in range(HEADS):
        fit = query[:, head] @ key[:, head].T / np.sqrt(4)
        if pairs is not None and made.pair is not None:
            fit = fit + np.asarray(pairs @ made.pair[...])[:, :, head]
        share = np.exp(fit) / np.exp(fit).sum(axis=1, keepdims=True)
        seen[:, head] = share @ value[:, head]
    want = x + made.out(jnp.asarray(seen.reshape(30, 16), "f4"), "float32")
    np.testing.assert_allclose(made(x, others, "float32", pair_features=pairs), want, atol=2e-6)


def test_few_bits_stay_close() -> None:
    made, x, others, pairs = attention(5), rows(1, 30, 24), rows(2, 7, 10), rows(3, 30, 7, 5)
    want = made(x, others, "float32", pair_features=pairs)
    got = made(x.astype(jnp.bfloat16), others.astype(jnp.bfloat16), "bfloat16", pair_features=pairs)
    assert got.dtype == jnp.bfloat16
    assert float(jnp.sqrt(((got.astype(jnp.float32) - want) ** 2).mean())) < 0.02 * float(jnp.ptp(want))


def test_padding_is_neither_seen_nor_counted() -> None:
    made, x, others = attention(), rows(1, 30, 24), rows(2, 7, 10)
    want = made(x[:20], others[:4], "float32")
    real, others_real = jnp.arange(30) < 20, jnp.arange(7) < 4
    got = made(x.at[20:].set(99), others.at[4:].set(-99), "float32", real, others_real)
    np.testing.assert_allclose(got[:20], want, atol=2e-6)
