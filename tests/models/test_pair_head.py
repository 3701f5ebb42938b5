from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from benchmarks.reference import dense_jax
from kmn_jax.models._pair_head import (
    PairHead,
    _per_pair,
    kept_pairs,
    pairwise_absolute_blocks,
    pairwise_absolute_fused,
    pairwise_absolute_scan,
    pairwise_leaky_sum,
)
from tests.models.test_layers import largest
from tests.reference.networks import signed

# Each is compiled once for all tests whose shapes are the same.
call = jax.jit(PairHead.__call__, static_argnames=("compute", "dropout_rate", "pair_dropout"))
kept_words = jax.jit(kept_pairs, static_argnames=("rate", "shape", "count"))


def signed_head(seed: int) -> PairHead:
    return signed(lambda: PairHead(24, 16, 32, 8, rngs=nnx.Rngs(0)), seed)


def normal(seed: int, *shapes: tuple[int, ...]) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.normal(size=shape).astype("f4") for shape in shapes]


def features(seed: int, n: int = 70, k: int = 6) -> list[np.ndarray]:
    return normal(seed, (n, 24), (k, 16))


def leaky_sum(u: np.ndarray, v: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Sum over channels of w leaky(u + v), in float64."""
    z = u[:, None].astype("f8") + v[None]
    return (w[:, None].astype("f8") * np.where(z > 0, z, 0.2 * z)).sum(axis=2)


@jax.jit
def dense_match(head: PairHead, scene: jax.Array, part: jax.Array) -> tuple[jax.Array, jax.Array]:
    parameters = jax.tree.map(lambda x: x, nnx.to_pure_dict(nnx.state(head, nnx.Param)))
    with jax.numpy_rank_promotion("allow"):
        return dense_jax.match(scene, part, {"head": parameters}, groups=8)


@pytest.mark.parametrize("seed", range(3))
def test_separated_head_is_the_dense_one(seed: int) -> None:
    head, (scene, part) = signed_head(seed), features(seed)
    got, want = call(head, scene, part, "float32"), dense_match(head, scene, part)
    np.testing.assert_allclose(got[0], want[0], atol=2e-5)
    np.testing.assert_allclose(got[1], want[1], atol=2e-5)


def test_gradients_are_those_of_the_dense_head(all_optimisations: None) -> None:
    head, (scene, part) = signed_head(5), features(5)
    ws, wk = normal(6, (70, 2), (70, 6))

    def gradients(of: Callable[..., tuple[jax.Array, jax.Array]]) -> tuple[jax.Array, jax.Array]:
        def scalar(scene: jax.Array, part: jax.Array) -> jax.Array:
            segmentation, keypoint = of(head, scene, part)
            return (segmentation * ws).sum() + (keypoint * wk).sum()

        return jax.jit(jax.grad(scalar, argnums=(0, 1)))(scene, part)

    got = gradients(lambda head, scene, part: head(scene, part, "float32"))
    for a, b in zip(got, gradients(dense_match), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-4 * np.abs(b).max())


@pytest.mark.parametrize("form", [pairwise_absolute_scan, pairwise_absolute_fused])
def test_both_forms_of_the_pairwise_sum(form) -> None:
    u, v, w = normal(0, (50, 32), (7, 32), (50, 32))
    want = (w[:, None].astype("f8") * np.abs(u[:, None].astype("f8") + v[None])).sum(axis=2)
    np.testing.assert_allclose(jax.jit(form)(u, v, w), want, atol=2e-5)


def test_pairwise_leaky_sum() -> None:
    u, v, w = normal(1, (50, 32), (7, 32), (50, 32))
    np.testing.assert_allclose(jax.jit(pairwise_leaky_sum)(u, v, w), leaky_sum(u, v, w), atol=2e-5)


@pytest.mark.parametrize("count", [1, 16, 50])
def test_one_row_of_weights_is_that_of_all_points(count: int) -> None:
    u, v, w = normal(2, (count, 32), (7, 32), (1, 32))

    def of(u: jax.Array, v: jax.Array, w: jax.Array) -> jax.Array:
        return (np.cos(np.arange(count * 7, dtype="f4")).reshape(count, 7) * pairwise_leaky_sum(u, v, w)).sum()

    def of_each(u: jax.Array, v: jax.Array, w: jax.Array) -> jax.Array:
        return of(u, v, jnp.broadcast_to(w, u.shape))

    @jax.jit
    def all_forms(*x: jax.Array) -> tuple[jax.Array, ...]:
        blocks = jax.vmap(pairwise_absolute_blocks, in_axes=(0, None, None))(jnp.stack([x[0], -x[0]]), *x[1:])
        return pairwise_leaky_sum(*x), pairwise_absolute_blocks(*x), pairwise_absolute_fused(*x), blocks

    total, blocks, fused, several = all_forms(u, v, w)
    np.testing.assert_allclose(total, leaky_sum(u, v, w), atol=2e-5)
    np.testing.assert_allclose(blocks, fused, atol=2e-5)
    np.testing.assert_allclose(np.asarray(several)[0], blocks, atol=2e-5)
    gradients = (jax.jit(jax.grad(function, argnums=(0, 1, 2)))(u, v, w) for function in (of, of_each))
    for a, b in zip(*gradients, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


@pytest.mark.parametrize("kind", [None, "shared", "per_pair"])
def test_no_pair_tensor_is_stored_in_either_direction(kind) -> None:
    head, (scene, part) = signed_head(0), map(jnp.asarray, features(0, n=2048, k=64))
    drop = () if kind is None else (None, 0.4, kind, jax.random.key(0))

    def loss(s: jax.Array) -> jax.Array:
        return sum(jnp.sum(x**2) for x in head(s, part, "float32", *drop))

    memory = jax.jit(jax.grad(loss)).lower(scene).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 2048 * 64 * 32 * 4 / 2


def test_padding_changes_nothing_and_is_background() -> None:
    head, (scene, part) = signed_head(3), features(3)
    noisy = np.where(np.arange(70)[:, None] < 50, scene, np.float32(1e3))
    got = [np.asarray(x) for x in call(head, noisy, part, "float32", np.arange(70) < 50)]
    for a, b in zip(got, call(head, scene[:50], part, "float32"), strict=True):
        np.testing.assert_allclose(a[:50], b, atol=2e-5)
    assert (got[0][50:].argmax(axis=1) == 0).all()
    assert (got[1][50:] == 0).all()


@pytest.mark.parametrize("kind", ["shared", "per_pair"])
def test_dropout_is_unbiased_and_keyed(kind) -> None:
    """The keypoint logits are linear in the second dropout, so that alone leaves their mean as it is."""
    u, v, w = normal(2, (20, 32), (4, 32), (32,))

    def one(key: jax.Array, u: jax.Array, v: jax.Array, w: jax.Array) -> jax.Array:
        if kind == "per_pair":
            return _per_pair(u, v, w, 0.4, key)[1]
        kept = jnp.where(jax.random.bernoulli(key, 0.6, u.shape), 1 / 0.6, 0)
        return pairwise_leaky_sum(u, v, kept * w[None, :])

    keys = jax.random.split(jax.random.key(0), 2000)
    draws = np.asarray(jax.jit(jax.vmap(one, in_axes=(0, None, None, None)))(keys, u, v, w))
    error = (draws.mean(axis=0) - leaky_sum(u, v, w[None])) / (draws.std(axis=0) / 2000**0.5)
    assert np.abs(error).max() < 5
    head, (scene, part) = signed_head(4), features(4)
    a, b, c = (
        np.asarray(call(head, scene, part, "float32", None, 0.4, kind, jax.random.key(seed))[1]) for seed in (0, 0, 1)
    )
    assert (a == b).all()
    assert not (a == c).all()


def test_dropout_of_every_pair_hides_no_number_that_is_none() -> None:
    u, v, w = np.zeros((4, 8), "f4"), np.ones((32, 8), "f4"), np.ones(8, "f4")
    u[1] = np.nan
    pooled, logits = jax.jit(_per_pair, static_argnames="rate")(u, v, w, 0.4, jax.random.key(0))
    assert np.isnan(pooled).all(axis=1).tolist() == [False, True, False, False]
    assert np.isnan(logits).any(axis=1).tolist() == [False, True, False, False]


def bits_of(words: jax.Array, count: int) -> np.ndarray:
    return (np.asarray(words)[None] >> np.arange(count)[:, None, None]) & 1


@pytest.mark.parametrize("rate", [0.0, 0.4, 0.9])
def test_pairs_are_kept_at_the_rate_and_independently(rate: float) -> None:
    kept = bits_of(kept_words(jax.random.key(0), rate, (250, 40), 32), 32).reshape(32, -1)
    deviation = (rate * (1 - rate) / kept.shape[1]) ** 0.5
    assert np.abs(kept.mean(axis=1) - (1 - rate)).max() <= 5 * deviation
    if rate > 0:
        correlation = np.corrcoef(kept) - np.eye(32)
        assert np.abs(correlation).max() < 5 / kept.shape[1] ** 0.5


@pytest.mark.parametrize("keypoints", [5, 32, 37])
def test_dropout_of_every_pair_is_the_dense_one_with_the_same_pairs(keypoints: int) -> None:
    u, v, w = normal(3, (30, 16), (keypoints, 16), (16,))
    key = jax.random.key(7)
    words = [
        bits_of(kept_words(jax.random.fold_in(key, start), 0.4, (30, 16), min(32, keypoints - start)), 32)
        for start in range(0, keypoints, 32)
    ]
    kept = np.concatenate(words)[:keypoints].astype("f4").transpose(1, 0, 2)

    def dense(u: jax.Array, v: jax.Array, w: jax.Array) -> tuple[jax.Array, jax.Array]:
        z = u[:, None] + v[None]
        activated = kept * jnp.where(z >= 0, z, 0.2 * z) / (1 - round(0.4 * 2**16) / 2**16)
        return largest(activated, 1), (activated * w[None, None, :]).sum(axis=2)

    def values_and_gradients(of: Callable[..., tuple[jax.Array, jax.Array]]) -> tuple[tuple, tuple]:
        def scalar(*x: jax.Array) -> jax.Array:
            pooled, logits = of(*x)
            return (pooled**2).sum() + (logits**3).sum()

        return jax.jit(lambda *x: (of(*x), jax.grad(scalar, argnums=(0, 1, 2))(*x)))(u, v, w)

    got, want = values_and_gradients(lambda *x: _per_pair(*x, 0.4, key)), values_and_gradients(dense)
    for a, b in zip(got[0], want[0], strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)
    for a, b in zip(got[1], want[1], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * np.abs(b).max())
