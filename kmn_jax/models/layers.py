"""The network's one layer: a bias-free 1x1 convolution, GroupNorm and LeakyReLU, split so that algebra can act on it.

GroupNorm after a linear map is, once its statistics are known, one scale and one shift per channel. The
statistics are taken per channel (a contiguous reduction) and combined by group with the law of total
variance, so that a layer on a grid of sums a_n + b_k needs only the moments of a and of b, and a maximum
over neighbours or keypoints can be taken before the activation, which is monotone.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

Compute = Literal["float32", "tf32", "bfloat16"]

_EPSILON = 1e-5
_LEAK = 0.2


def leaky_relu(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return max(x, 0.2 x)."""
    return jnp.maximum(x, _LEAK * x)


def product(x: Float[Array, "... i"], kernel: Float[Array, "i o"], compute: Compute) -> Float[Array, "... o"]:
    """Multiply in the configured arithmetic; every form accumulates in float32.

    "float32" asks for full precision everywhere, "tf32" for the accelerator's fast float32 mode, "bfloat16"
    rounds both operands and the result.
    """
    if compute == "bfloat16":
        return jnp.matmul(x.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16))
    precision = jax.lax.Precision.HIGHEST if compute == "float32" else jax.lax.Precision.DEFAULT
    return jnp.matmul(x.astype(jnp.float32), kernel, precision=precision)


class Moments(NamedTuple):
    """Mean and population variance of each channel, in float32."""

    mean: Float[Array, " c"]
    variance: Float[Array, " c"]

    def plus(self, other: Moments) -> Moments:
        """Return the moments of the grid of all sums a_n + b_k, given those of a and of b."""
        return Moments(self.mean + other.mean, self.variance + other.variance)


def channel_moments(x: Float[Array, "*rows c"], mask: Bool[Array, "*rows"] | None = None) -> Moments:
    """Return the moments of each channel over all rows, or over those where `mask` is true."""
    rows = x.astype(jnp.float32).reshape(-1, x.shape[-1])
    if mask is None:
        mean = rows.mean(axis=0)
        return Moments(mean, ((rows - mean[None, :]) ** 2).mean(axis=0))
    real = mask.reshape(-1)[:, None]
    count = jnp.maximum(mask.sum(), 1).astype(jnp.float32)
    mean = jnp.where(real, rows, 0).sum(axis=0) / count
    return Moments(mean, jnp.where(real, (rows - mean[None, :]) ** 2, 0).sum(axis=0) / count)


class ChannelAffine(NamedTuple):
    """What GroupNorm does to each channel: x -> scale * x + shift."""

    scale: Float[Array, " c"]
    shift: Float[Array, " c"]

    def __call__(self, x: Float[Array, "... c"]) -> Float[Array, "... c"]:
        row = (1,) * (x.ndim - 1) + (-1,)
        return x.astype(jnp.float32) * self.scale.reshape(row) + self.shift.reshape(row)


def drawn_kernel(in_features: int, out_features: int, rngs: nnx.Rngs) -> Float[Array, "i o"]:
    """Draw initial weights from U(-1/sqrt(i), 1/sqrt(i)), as the published code's layers start."""
    initializer = nnx.initializers.variance_scaling(1 / 3, "fan_in", "uniform")
    return initializer(rngs.params(), (in_features, out_features), jnp.float32)


class NormalizedLinear(nnx.Module):
    """A bias-free linear map with the parameters of the GroupNorm that follows it."""

    def __init__(self, in_features: int, out_features: int, groups: int, *, rngs: nnx.Rngs) -> None:
        self.kernel = nnx.Param(drawn_kernel(in_features, out_features, rngs))
        self.norm_scale = nnx.Param(jnp.ones(out_features))
        self.norm_bias = nnx.Param(jnp.zeros(out_features))
        self.groups = groups

    def affine(self, moments: Moments) -> ChannelAffine:
        """Return GroupNorm as one scale and shift a channel, from the channel moments of its input."""
        grouped_mean = moments.mean.reshape(self.groups, -1)
        mean = grouped_mean.mean(axis=1, keepdims=True)
        within = moments.variance.reshape(self.groups, -1).mean(axis=1, keepdims=True)
        between = ((grouped_mean - mean) ** 2).mean(axis=1, keepdims=True)
        inverse = jax.lax.rsqrt(within + between + _EPSILON)
        scale = (inverse * self.norm_scale[...].reshape(self.groups, -1)).reshape(-1)
        mean = jnp.broadcast_to(mean, grouped_mean.shape).reshape(-1)
        return ChannelAffine(scale, self.norm_bias[...] - mean * scale)

    def __call__(
        self, x: Float[Array, "*rows i"], compute: Compute, mask: Bool[Array, "*rows"] | None = None
    ) -> Float[Array, "*rows o"]:
        """Apply map, GroupNorm over the (real) rows and LeakyReLU."""
        z = product(x, self.kernel[...], compute)
        return leaky_relu(self.affine(channel_moments(z, mask))(z)).astype(z.dtype)


def dropout(x: Float[Array, "..."], rate: float, key: jax.Array | None) -> Float[Array, "..."]:
    """Zero entries at `rate` and scale the others up; no key, no dropout."""
    if key is None or rate == 0:
        return x
    keep = jax.random.bernoulli(key, 1 - rate, x.shape)
    return jnp.where(keep, x / (1 - rate), 0).astype(x.dtype)
