from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from benchmarks.reference import dense_jax
from kmn_jax.models._pair_head import (
    PairHead,
    kept_pairs,
    pairwise_absolute_blocks,
    pairwise_absolute_fused,
    pairwise_absolute_scan,
    pairwise_leaky_sum,
)
from tests.models.test_layers import signed_layer


def signed_head(seed: int) -> PairHead:
    head = PairHead(24, 16, 32, 8, rngs=nnx.Rngs(seed))
    head.scene_pair = signed_layer(40, 32, 8, seed + 1)
    head.context_pair = signed_layer(48, 32, 8, seed + 2)
    return head


def features(seed: int, n: int = 70, k: int = 6) -> tuple[jax.Array, jax.Array]:
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.normal(size=(n, 24)), "f4"), jnp.asarray(rng.normal(size=(k, 16)), "f4")


def dense_match(head: PairHead, scene: jax.Array, part: jax.Array) -> tuple[jax.Array, jax.Array]:
    parameters = jax.tree.map(lambda x: x, nnx.to_pure_dict(nnx.state(head, nnx.Param)))
    with jax.numpy_rank_promotion("allow"):
        return dense_jax.match(scene, part, {"head": parameters}, groups=8)


@pytest.mark.parametrize("seed", range(3))
def test_separated_head_is_the_dense_one(seed: int) -> None:
    head, (scene, part) = signed_head(seed), features(seed)
    got, want = head(scene, part, "float32"), dense_match(head, scene, part)
    np.testing.assert_allclose(got[0], want[0], atol=2e-5)
    np.testing.assert_allclose(got[1], want[1], atol=2e-5)


def test_gradients_are_those_of_the_dense_head() -> None:
    head, (scene, part) = signed_head(5), features(5)
    rng = np.random.default_rng(5)
    ws, wk = jnp.asarray(rng.normal(size=(70, 2)), "f4"), jnp.asarray(rng.normal(size=(70, 6)), "f4")

    def scalar(outputs: tuple[jax.Array, jax.Array]) -> jax.Array:
        return (outputs[0] * ws).sum() + (outputs[1] * wk).sum()

    got = jax.grad(lambda s, p: scalar(head(s, p, "float32")), argnums=(0, 1))(scene, part)
    want = jax.grad(lambda s, p: scalar(dense_match(head, s, p)), argnums=(0, 1))(scene, part)
    for a, b in zip(got, want, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-4 * float(jnp.abs(b).max()))


@pytest.mark.parametrize("form", [pairwise_absolute_scan, pairwise_absolute_fused])
def test_both_forms_of_the_pairwise_sum(form) -> None:
    rng = np.random.default_rng(0)
    u, v, w = (rng.normal(size=shape).astype("f4") for shape in [(50, 32), (7, 32), (50, 32)])
    want = (w[:, None].astype("f8") * np.abs(u[:, None].astype("f8") + v[None])).sum(axis=2)
    np.testing.assert_allclose(form(jnp.asarray(u), jnp.asarray(v), jnp.asarray(w)), want, atol=2e-5)


def test_pairwise_leaky_sum() -> None:
    rng = np.random.default_rng(1)
    u, v, w = (rng.normal(size=shape).astype("f4") for shape in [(50, 32), (7, 32), (50, 32)])
    z = u[:, None] + v[None]
    want = (w[:, None] * np.where(z > 0, z, 0.2 * z)).sum(axis=2)
    np.testing.assert_allclose(pairwise_leaky_sum(jnp.asarray(u), jnp.asarray(v), jnp.asarray(w)), want, atol=2e-5)


@pytest.mark.parametrize("count", [1, 16, 50])
def test_one_row_of_weights_is_that_of_all_points(count: int) -> None:
    rng = np.random.default_rng(2)
    u, v, w = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in [(count, 32), (7, 32), (1, 32)])

    def of(u: jax.Array, v: jax.Array, w: jax.Array) -> jax.Array:
        return (jnp.cos(jnp.arange(count * 7.0)).reshape(count, 7) * pairwise_leaky_sum(u, v, w)).sum()

    def of_each(u: jax.Array, v: jax.Array, w: jax.Array) -> jax.Array:
        return of(u, v, jnp.broadcast_to(w, u.shape))

    z = np.asarray(u, "f8")[:, None] + np.asarray(v, "f8")[None]
    want = (np.asarray(w, "f8")[:, None] * np.where(z > 0, z, 0.2 * z)).sum(axis=2)
    np.testing.assert_allclose(pairwise_leaky_sum(u, v, w), want, atol=2e-5)
    blocks = pairwise_absolute_blocks(u, v, w)
    np.testing.assert_allclose(blocks, pairwise_absolute_fused(u, v, w), atol=2e-5)
    several = jax.vmap(pairwise_absolute_blocks, in_axes=(0, None, None))(jnp.stack([u, -u]), v, w)
    np.testing.assert_allclose(several[0], blocks, atol=2e-5)
    gradients = (jax.grad(function, argnums=(0, 1, 2))(u, v, w) for function in (of, of_each))
    for a, b in zip(*gradients, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


@pytest.mark.parametrize("kind", [None, "shared", "per_pair"])
def test_no_pair_tensor_is_stored_in_either_direction(kind) -> None:
    head, (scene, part) = signed_head(0), features(0, n=2048, k=64)
    drop = () if kind is None else (None, 0.4, kind, jax.random.key(0))

    def loss(s: jax.Array) -> jax.Array:
        return sum(jnp.sum(x**2) for x in head(s, part, "float32", *drop))

    memory = jax.jit(jax.grad(loss)).lower(scene).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 2048 * 64 * 32 * 4 / 2


def test_padding_changes_nothing_and_is_background() -> None:
    head, (scene, part) = signed_head(3), features(3)
    mask = jnp.arange(70) < 50
    noisy = jnp.where(mask[:, None], scene, 1e3)
    got, want = head(noisy, part, "float32", mask), head(scene[:50], part, "float32")
    for a, b in zip(got, want, strict=True):
        np.testing.assert_allclose(a[:50], b, atol=2e-5)
    assert bool((got[0][50:].argmax(axis=1) == 0).all())
    assert bool((got[1][50:] == 0).all())


@pytest.mark.parametrize("kind", ["shared", "per_pair"])
def test_dropout_is_unbiased_and_keyed(kind) -> None:
    """The keypoint logits are linear in the second dropout, so that alone leaves their mean as it is."""
    from kmn_jax.models._pair_head import _per_pair

    rng = np.random.default_rng(2)
    u, v = jnp.asarray(rng.normal(size=(20, 32)), "f4"), jnp.asarray(rng.normal(size=(4, 32)), "f4")
    w = jnp.asarray(rng.normal(size=32), "f4")
    exact = pairwise_leaky_sum(u, v, jnp.broadcast_to(w[None, :], u.shape))

    def one(key: jax.Array) -> jax.Array:
        if kind == "per_pair":
            return _per_pair(u, v, w, 0.4, key)[1]
        kept = jnp.where(jax.random.bernoulli(key, 0.6, u.shape), 1 / 0.6, 0)
        return pairwise_leaky_sum(u, v, kept * w[None, :])

    draws = jax.vmap(one)(jax.random.split(jax.random.key(0), 2000))
    error = (draws.mean(axis=0) - exact) / (draws.std(axis=0) / 2000**0.5)
    assert float(jnp.abs(error).max()) < 5
    head, (scene, part) = signed_head(4), features(4)
    a, b, c = (head(scene, part, "float32", None, 0.4, kind, jax.random.key(seed))[1] for seed in (0, 0, 1))
    assert bool((a == b).all())
    assert not bool((a == c).all())


def test_dropout_of_every_pair_hides_no_number_that_is_none() -> None:
    from kmn_jax.models._pair_head import _per_pair

    u = jnp.zeros((4, 8)).at[1].set(jnp.nan)
    pooled, logits = _per_pair(u, jnp.ones((32, 8)), jnp.ones(8), 0.4, jax.random.key(0))
    assert np.isnan(pooled).all(axis=1).tolist() == [False, True, False, False]
    assert np.isnan(logits).any(axis=1).tolist() == [False, True, False, False]


def bits_of(words: jax.Array, count: int) -> np.ndarray:
    return (np.asarray(words)[None] >> np.arange(count)[:, None, None]) & 1


@pytest.mark.parametrize("rate", [0.0, 0.4, 0.9])
def test_pairs_are_kept_at_the_rate_and_independently(rate: float) -> None:
    kept = bits_of(kept_pairs(jax.random.key(0), rate, (250, 40), 32), 32).reshape(32, -1)
    deviation = (rate * (1 - rate) / kept.shape[1]) ** 0.5
    assert np.abs(kept.mean(axis=1) - (1 - rate)).max() <= 5 * deviation
    if rate > 0:
        correlation = np.corrcoef(kept) - np.eye(32)
        assert np.abs(correlation).max() < 5 / kept.shape[1] ** 0.5


@pytest.mark.parametrize("keypoints", [5, 32, 37])
def test_dropout_of_every_pair_is_the_dense_one_with_the_same_pairs(keypoints: int) -> None:
    from kmn_jax.models._pair_head import _per_pair

    rng = np.random.default_rng(3)
    u, v, w = (jnp.asarray(rng.normal(size=shape), "f4") for shape in [(30, 16), (keypoints, 16), (16,)])
    key = jax.random.key(7)
    words = [
        bits_of(kept_pairs(jax.random.fold_in(key, start), 0.4, (30, 16), min(32, keypoints - start)), 32)
        for start in range(0, keypoints, 32)
    ]
    kept = jnp.asarray(np.concatenate(words)[:keypoints], "f4").transpose(1, 0, 2)

    def dense(u: jax.Array, v: jax.Array, w: jax.Array) -> tuple[jax.Array, jax.Array]:
        z = u[:, None] + v[None]
        activated = kept * jnp.where(z >= 0, z, 0.2 * z) / (1 - round(0.4 * 2**16) / 2**16)
        return activated.max(axis=1), (activated * w[None, None, :]).sum(axis=2)

    def scalar(outputs: tuple[jax.Array, jax.Array]) -> jax.Array:
        return (outputs[0] ** 2).sum() + (outputs[1] ** 3).sum()

    for got, want in zip(_per_pair(u, v, w, 0.4, key), dense(u, v, w), strict=True):
        np.testing.assert_allclose(got, want, atol=2e-5)
    got = jax.grad(lambda *x: scalar(_per_pair(*x, 0.4, key)), argnums=(0, 1, 2))(u, v, w)
    for a, b in zip(got, jax.grad(lambda *x: scalar(dense(*x)), argnums=(0, 1, 2))(u, v, w), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * float(jnp.abs(b).max()))
