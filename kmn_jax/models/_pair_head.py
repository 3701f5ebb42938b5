"""The scene-keypoint pair head, separated: no N x K x C tensor is formed.

A layer on the pair [s_n ; o_k] is a_n + b_k. After GroupNorm (statistics from the moments of a and b) the
pre-activation is u_n + v_k, and max over k of leaky(u_n + v_k) = leaky(u_n + max_k v_k). Only the keypoint
logits, sum_c w_c leaky(u_nc + v_kc), are truly pairwise; as leaky(z) = 0.6 z + 0.4 |z|, their linear part
separates too and the rest is reduced over c without being stored.
"""

from __future__ import annotations

from functools import partial, reduce
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, UInt

from kmn_jax.models._layers import (
    LEAK,
    Compute,
    NormalizedLinear,
    channel_moments,
    drawn_kernel,
    dropout,
    leaky_relu,
    product,
)
from kmn_jax.platforms import by_platform

PairDropout = Literal["shared", "per_pair"]

_BLOCK = 16  # points that a CPU compares with all keypoints at once
_WORD = 32  # keypoints whose dropout is in one word
_RATES = 2**16

# What padded rows get: certain background, and no preference among keypoints.
_PADDED_SEGMENTATION = (0.0, -1e4)


class PairHead(nnx.Module):
    """[scene ; object] -> 256, max over keypoints, [that ; object] -> 256 -> segmentation and keypoint logits."""

    def __init__(self, scene_width: int, object_width: int, width: int, groups: int, *, rngs: nnx.Rngs) -> None:
        self.scene_pair = NormalizedLinear(scene_width + object_width, width, groups, rngs=rngs)
        self.context_pair = NormalizedLinear(width + object_width, width, groups, rngs=rngs)
        self.segmentation = nnx.Param(drawn_kernel(width, 2, rngs))
        self.keypoint = nnx.Param(drawn_kernel(width, 1, rngs))

    def __call__(
        self,
        scene: Float[Array, "n s"],
        keypoints: Float[Array, "k o"],
        compute: Compute,
        mask: Bool[Array, " n"] | None = None,
        dropout_rate: float = 0.0,
        pair_dropout: PairDropout = "shared",
        key: jax.Array | None = None,
    ) -> tuple[Float[Array, "n 2"], Float[Array, "n k"]]:
        """Return segmentation logits (class 1 = object) and keypoint logits, in float32.

        With a key, dropout acts after each of the two pair layers; after the second it is one mask per point
        and channel for all keypoints ("shared"), or one per pair as published ("per_pair").
        """
        context_key, pair_key = (None, None) if key is None else jax.random.split(key)
        u, v = _pair_terms(self.scene_pair, scene, keypoints, compute, mask)
        context = dropout(leaky_relu(u + v.max(axis=0)[None, :]), dropout_rate, context_key).astype(scene.dtype)
        u, v = _pair_terms(self.context_pair, context, keypoints, compute, mask)
        weights = self.keypoint[...][:, 0]
        if pair_key is not None and pair_dropout == "per_pair" and dropout_rate > 0:
            pooled, keypoint_logits = _per_pair(u, v, weights, dropout_rate, pair_key)
        else:
            kept = jnp.ones_like(u[:1]) if pair_key is None else dropout(jnp.ones_like(u), dropout_rate, pair_key)
            pooled = kept * leaky_relu(u + v.max(axis=0)[None, :])
            keypoint_logits = pairwise_leaky_sum(u, v, kept * weights[None, :])
        segmentation_logits = product(pooled, self.segmentation[...], compute).astype(jnp.float32)
        if mask is not None:
            segmentation_logits = jnp.where(
                mask[:, None], segmentation_logits, jnp.array(_PADDED_SEGMENTATION, dtype=jnp.float32)[None, :]
            )
            keypoint_logits = jnp.where(mask[:, None], keypoint_logits, 0)
        return segmentation_logits, keypoint_logits


def _pair_terms(
    layer: NormalizedLinear,
    scene: Float[Array, "n s"],
    keypoints: Float[Array, "k o"],
    compute: Compute,
    mask: Bool[Array, " n"] | None,
) -> tuple[Float[Array, "n c"], Float[Array, "k c"]]:
    """Return u and v, in float32, such that the normalised pair layer is u_n + v_k before its activation."""
    kernel = layer.kernel[...]
    a = product(scene, kernel[: scene.shape[1]], compute)
    b = product(keypoints, kernel[scene.shape[1] :], compute)
    affine = layer.affine(channel_moments(a, mask).plus(channel_moments(b)))
    return affine(a), b.astype(jnp.float32) * affine.scale[None, :]


def pairwise_leaky_sum(
    u: Float[Array, "n c"], v: Float[Array, "k c"], weights: Float[Array, "w c"]
) -> Float[Array, "n k"]:
    """Return sum over c of weights_nc leaky(u_nc + v_kc), for leak 0.2; one row of weights is that of all points."""
    # XLA's CPU compiler has slow kernels for sums of products, but not for these.
    ones = jnp.ones((u.shape[1], 1), u.dtype)
    own = jnp.matmul(weights * u, ones, precision=jax.lax.Precision.HIGHEST)
    linear = own + jnp.matmul(weights, v.T, precision=jax.lax.Precision.HIGHEST)
    on_cpu = pairwise_absolute_blocks if weights.shape[0] == 1 else pairwise_absolute_scan
    absolute = by_platform(u, v, weights, cpu=on_cpu, default=pairwise_absolute_fused)
    return 0.6 * linear + 0.4 * absolute


def pairwise_absolute_blocks(
    u: Float[Array, "n c"], v: Float[Array, "k c"], weights: Float[Array, "1 c"]
) -> Float[Array, "n k"]:
    """Return sum over c of weights_c |u_nc + v_kc|, some points after others: they stay in a CPU's nearest cache."""
    blocks = jnp.pad(u, ((0, -u.shape[0] % _BLOCK), (0, 0))).reshape(-1, _BLOCK, u.shape[1])

    def one(block: Float[Array, "b c"]) -> Float[Array, "k b"]:
        @jax.checkpoint  # as below
        def of_keypoint(v_k: Float[Array, " c"]) -> Float[Array, " b"]:
            return jnp.matmul(jnp.abs(block + v_k[None, :]), weights[0], precision=jax.lax.Precision.HIGHEST)

        return jax.lax.map(of_keypoint, v)

    return jnp.swapaxes(jax.lax.map(one, blocks), 1, 2).reshape(-1, v.shape[0])[: u.shape[0]]


def pairwise_absolute_scan(
    u: Float[Array, "n c"], v: Float[Array, "k c"], weights: Float[Array, "n c"]
) -> Float[Array, "n k"]:
    """Return sum over c of weights_nc |u_nc + v_kc|, one keypoint after the other: what CPUs vectorise best."""

    @jax.checkpoint  # the backward pass recomputes the signs rather than storing n x k x c of them
    def one(v_k: Float[Array, " c"]) -> Float[Array, " n"]:
        # As a product, since XLA's CPU compiler loses the vectorised form of the plain sum under a vmap.
        return jnp.einsum("nc,nc->n", weights, jnp.abs(u + v_k[None, :]), precision=jax.lax.Precision.HIGHEST)

    return jax.lax.map(one, v).T


def pairwise_absolute_fused(
    u: Float[Array, "n c"], v: Float[Array, "k c"], weights: Float[Array, "w c"]
) -> Float[Array, "n k"]:
    """Return the same as one reduction, whose operand XLA's accelerator compilers never store."""

    @jax.checkpoint
    def all_pairs(u: Float[Array, "n c"], v: Float[Array, "k c"], weights: Float[Array, "w c"]) -> Float[Array, "n k"]:
        return (weights[:, None, :] * jnp.abs(u[:, None, :] + v[None, :, :])).sum(axis=2)

    return all_pairs(u, v, weights)


def _per_pair(
    u: Float[Array, "n c"], v: Float[Array, "k c"], weights: Float[Array, " c"], rate: float, key: jax.Array
) -> tuple[Float[Array, "n c"], Float[Array, "n k"]]:
    """Return pooled features and keypoint logits under the published dropout of every pair on its own."""
    rate, found = _rounded(rate), []
    for start in range(0, v.shape[0], _WORD):
        some = v[start : start + _WORD]
        kept = kept_pairs(jax.random.fold_in(key, start), rate, u.shape, some.shape[0])
        found.append(_of_kept_pairs(u, some, weights, kept, rate))
    pooled, logits = zip(*found, strict=True)
    return reduce(jnp.maximum, pooled), jnp.concatenate(logits, axis=1)


@partial(jax.custom_vjp, nondiff_argnums=(4,))
def _of_kept_pairs(
    u: Float[Array, "n c"], v: Float[Array, "k c"], weights: Float[Array, " c"], kept: UInt[Array, "n c"], rate: float
) -> tuple[Float[Array, "n c"], Float[Array, "n k"]]:
    """Return the maximum over keypoints and the weighted sums over channels of what is kept of leaky(u_n + v_k)."""
    return _of_kept_pairs_forward(u, v, weights, kept, rate)[0]


def _of_kept_pairs_forward(u: Array, v: Array, weights: Array, kept: Array, rate: float) -> tuple[Any, Any]:
    def one(best: tuple[Array, Array], inputs: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
        v_k, k = inputs
        activated = _if_kept(kept, k, leaky_relu(u + v_k[None, :]), rate)
        larger = ~(best[0] >= activated) & ~jnp.isnan(best[0])  # what is not a number stays in the maximum
        best = jnp.where(larger, activated, best[0]), jnp.where(larger, k, best[1])
        return best, jnp.matmul(activated, weights, precision=jax.lax.Precision.HIGHEST)

    none = jnp.full_like(u, -jnp.inf), jnp.zeros_like(kept)
    (pooled, first_best), logits = jax.lax.scan(one, none, (v, jnp.arange(v.shape[0], dtype=jnp.uint32)))
    return (pooled, logits.T), (u, v, weights, kept, first_best)


def _of_kept_pairs_backward(rate: float, saved: Any, cotangent: tuple[Array, Array]) -> tuple[Any, ...]:
    """Go through the keypoints once more, which stores no maximum of each."""
    u, v, weights, kept, first_best = saved
    of_pooled, of_logits = cotangent

    def one(total: tuple[Array, Array], inputs: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], Array]:
        v_k, of_logits_k, k = inputs
        z = u + v_k[None, :]
        activated = _if_kept(kept, k, leaky_relu(z), rate)
        change = of_logits_k[:, None] * weights[None, :] + jnp.where(first_best == k, of_pooled, 0)
        change = _if_kept(kept, k, jnp.where(z >= 0, change, LEAK * change), rate)
        of_weights = jnp.matmul(of_logits_k, activated, precision=jax.lax.Precision.HIGHEST)
        return (total[0] + change, total[1] + of_weights), change.sum(axis=0)

    places = jnp.arange(v.shape[0], dtype=jnp.uint32)
    zeros = jnp.zeros_like(u), jnp.zeros_like(weights)
    (of_u, of_weights), of_v = jax.lax.scan(one, zeros, (v, of_logits.T, places))
    return of_u, of_v, of_weights, None


def _if_kept(kept: UInt[Array, "n c"], k: UInt[Array, ""], x: Float[Array, "n c"], rate: float) -> Float[Array, "n c"]:
    return jnp.where((kept >> k) & 1 == 1, x / (1 - rate), 0)


_of_kept_pairs.defvjp(_of_kept_pairs_forward, _of_kept_pairs_backward)


def _rounded(rate: float) -> float:
    """Return the nearest rate below 1 that 16 random bits can have."""
    return min(round(rate * _RATES), _RATES - 1) / _RATES


def kept_pairs(key: jax.Array, rate: float, shape: tuple[int, ...], count: int) -> UInt[Array, "n c"]:
    """Return for each point and channel a word of which bit k is set where dropout at `rate` keeps keypoint k.

    Up to 32 keypoints, two from each 32 random bits, so that the rate is one of 65,536. In this form they can be kept
    for the backward pass, which need not draw them again.
    """
    dropped = jnp.uint32(_rounded(rate) * _RATES)

    def two(word: UInt[Array, "n c"], inputs: tuple) -> tuple[UInt[Array, "n c"], None]:
        key_i, place = inputs
        bits = jax.random.bits(key_i, shape, jnp.uint32)
        low, high = ((half >= dropped).astype(jnp.uint32) for half in (bits & 0xFFFF, bits >> 16))
        return word | (low << place) | (high << (place + 1)), None

    pairs = -(-count // 2)
    places = 2 * jnp.arange(pairs, dtype=jnp.uint32)
    return jax.lax.scan(two, jnp.zeros(shape, dtype=jnp.uint32), (jax.random.split(key, pairs), places))[0]
