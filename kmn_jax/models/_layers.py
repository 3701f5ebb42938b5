"""The network's one layer: a bias-free 1x1 convolution, GroupNorm and LeakyReLU, split so that algebra can act on it.

GroupNorm after a linear map is, once its statistics are known, one scale and one shift per channel. The
statistics are taken per channel (a contiguous reduction) and combined by group with the law of total
variance, so that a layer on a grid of sums a_n + b_k needs only the moments of a and of b, and a maximum
over neighbours or keypoints can be taken before the activation, which is monotone.

Backward passes are written out where XLA's derivative costs several times the forward: it sums what is zero (moments),
counts ties (maxima), and reduces the same array once for each parameter (scale and shift).
"""

from __future__ import annotations

from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

Compute = Literal["float32", "tf32", "bfloat16"]

_EPSILON = 1e-5
LEAK = 0.2


def leaky_relu(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return x, or 0.2 x where that is negative."""
    return jnp.where(x >= 0, x, LEAK * x)


def product(x: Float[Array, "... i"], kernel: Float[Array, "i o"], compute: Compute) -> Float[Array, "... o"]:
    """Multiply in the configured arithmetic; every form accumulates in float32.

    "float32" asks for full precision everywhere, "tf32" for the accelerator's fast float32 mode, "bfloat16"
    rounds both operands and the result.
    """
    if compute == "bfloat16":
        return jnp.matmul(x.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16))
    return jnp.matmul(x.astype(jnp.float32), kernel, precision=precision_of(compute))


def precision_of(compute: Compute) -> jax.lax.Precision:
    """Return how exactly products are computed whose operands are as they are to be."""
    return jax.lax.Precision.HIGHEST if compute == "float32" else jax.lax.Precision.DEFAULT


class Moments(NamedTuple):
    """Mean and population variance of each channel, in float32."""

    mean: Float[Array, " c"]
    variance: Float[Array, " c"]

    def plus(self, other: Moments) -> Moments:
        """Return the moments of the grid of all sums a_n + b_k, given those of a and of b."""
        return Moments(self.mean + other.mean, self.variance + other.variance)


@jax.custom_vjp
def channel_moments(x: Float[Array, "*rows c"], mask: Bool[Array, "*rows"] | None = None) -> Moments:
    """Return the moments of each channel over all rows, or over those where `mask` is true."""
    rows = x.astype(jnp.float32).reshape(-1, x.shape[-1])
    if mask is None:
        mean = rows.mean(axis=0)
        return Moments(mean, ((rows - mean[None, :]) ** 2).mean(axis=0))
    real = mask.reshape(-1)[:, None]
    count = _count(mask)
    mean = jnp.where(real, rows, 0).sum(axis=0) / count
    return Moments(mean, jnp.where(real, (rows - mean[None, :]) ** 2, 0).sum(axis=0) / count)


def _moments_forward(x: Array, mask: Array | None) -> tuple[Moments, Any]:
    moments = channel_moments(x, mask)
    return moments, (x, mask, moments.mean)


def _moments_backward(saved: Any, cotangent: Moments) -> tuple[Array, None]:
    x, mask, mean = saved
    count = jnp.float32(x.size // x.shape[-1]) if mask is None else _count(mask)
    slope = 2 * cotangent.variance / count
    offset = cotangent.mean / count - slope * mean
    change = _by_channel(x, slope) + offset.reshape(_row(x))
    return (change if mask is None else jnp.where(mask[..., None], change, 0)).astype(x.dtype), None


def _count(mask: Bool[Array, "*rows"]) -> Float[Array, ""]:
    return jnp.maximum(mask.sum(), 1).astype(jnp.float32)


channel_moments.defvjp(_moments_forward, _moments_backward)


class ChannelAffine(NamedTuple):
    """What GroupNorm does to each channel: x -> scale * x + shift."""

    scale: Float[Array, " c"]
    shift: Float[Array, " c"]

    def __call__(self, x: Float[Array, "... c"]) -> Float[Array, "... c"]:
        return _image(x, self.scale, self.shift, False)

    def activated(self, x: Float[Array, "... c"]) -> Float[Array, "... c"]:
        """Return LeakyReLU of the image, in float32."""
        return _image(x, self.scale, self.shift, True)

    def activated_largest(
        self, x: Float[Array, "... c"], axis: int, mask: Bool[Array, "..."] | None = None
    ) -> Float[Array, "... c"]:
        """Return LeakyReLU of the largest image along an axis, of entries where `mask` is true: all is monotone.

        Its gradient goes to the first of the entries that are largest.
        """
        signs = jnp.where(self.scale < 0, -1, 1).astype(x.dtype).reshape(_row(x))
        signed = x * signs if mask is None else jnp.where(mask[..., None], x * signs, -jnp.inf)
        return self.activated(_largest(signed, axis) * signs.reshape((1,) * (x.ndim - 2) + (-1,)))


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _image(
    x: Float[Array, "... c"], scale: Float[Array, " c"], shift: Float[Array, " c"], leaky: bool
) -> Float[Array, "... c"]:
    y = _by_channel(x, scale) + shift.reshape(_row(x))
    return leaky_relu(y) if leaky else y


def _image_forward(x: Array, scale: Array, shift: Array, leaky: bool) -> tuple[Array, Any]:
    return _image(x, scale, shift, leaky), (x, scale, shift)


def _image_backward(leaky: bool, saved: Any, cotangent: Array) -> tuple[Array, Array, Array]:
    x, scale, shift = saved
    if leaky:
        cotangent = jnp.where(_image(x, scale, shift, False) >= 0, cotangent, LEAK * cotangent)
    # As rows: over several axes XLA's CPU compiler does not vectorise the sum.
    rows, of_rows = x.astype(jnp.float32).reshape(-1, x.shape[-1]), cotangent.reshape(-1, x.shape[-1])
    zeros = jnp.float32(0), jnp.float32(0)
    of_scale, of_shift = jax.lax.reduce((of_rows * rows, of_rows), zeros, _add_both, (0,))
    return _by_channel(cotangent, scale).astype(x.dtype), of_scale, of_shift


def _add_both(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array]:
    return a[0] + b[0], a[1] + b[1]


_image.defvjp(_image_forward, _image_backward)


def _by_channel(x: Float[Array, "... c"], factor: Float[Array, " c"]) -> Float[Array, "... c"]:
    return x.astype(jnp.float32) * factor.reshape(_row(x))


def _row(x: Float[Array, "... c"]) -> tuple[int, ...]:
    return (1,) * (x.ndim - 1) + (-1,)


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def _largest(x: Float[Array, "..."], axis: int) -> Float[Array, "..."]:
    return x.max(axis=axis)


def _largest_forward(x: Array, axis: int) -> tuple[Array, Any]:
    rows = jax.lax.broadcasted_iota(jnp.int32, x.shape, axis)

    def larger(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array]:
        # Of equals the first, in whatever order they come; what is not a number wins.
        stays = jnp.where(a[0] == b[0], a[1] < b[1], (a[0] > b[0]) | (a[0] != a[0]))
        return jnp.where(stays, a[0], b[0]), jnp.where(stays, a[1], b[1])

    start = jnp.array(-jnp.inf, dtype=x.dtype), jnp.int32(x.shape[axis])
    best, row = jax.lax.reduce((x, rows), start, larger, (axis,))
    return best, (row, x.shape[axis])


def _largest_backward(axis: int, saved: tuple[Array, int], cotangent: Array) -> tuple[Array]:
    row, size = saved
    shape = (*row.shape[:axis], size, *row.shape[axis:])
    chosen = jax.lax.broadcasted_iota(jnp.int32, shape, axis) == jnp.expand_dims(row, axis)
    return (jnp.where(chosen, jnp.expand_dims(cotangent, axis), 0),)


_largest.defvjp(_largest_forward, _largest_backward)


def drawn_kernel(in_features: int, out_features: int, rngs: nnx.Rngs) -> Float[Array, "i o"]:
    """Draw initial weights from U(-1/sqrt(i), 1/sqrt(i)), as the published code's layers start."""
    initializer = nnx.initializers.variance_scaling(1 / 3, "fan_in", "uniform")
    return initializer(rngs.params(), (in_features, out_features), jnp.float32)


class NormalizedLinear(nnx.Module):
    """A bias-free linear map with the parameters of the GroupNorm that follows it."""

    def __init__(self, in_features: int, out_features: int, groups: int, *, rngs: nnx.Rngs) -> None:
        self.kernel = nnx.Param(drawn_kernel(in_features, out_features, rngs))
        self.norm_scale = nnx.Param(jnp.ones(out_features, jnp.float32))
        self.norm_bias = nnx.Param(jnp.zeros(out_features, jnp.float32))
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
        return self.affine(channel_moments(z, mask)).activated(z).astype(z.dtype)


def dropout(x: Float[Array, "..."], rate: float, key: jax.Array | None) -> Float[Array, "..."]:
    """Zero entries at `rate` and scale the others up; no key, no dropout."""
    if key is None or rate == 0:
        return x
    keep = jax.random.bernoulli(key, 1 - rate, x.shape)
    return jnp.where(keep, x / (1 - rate), 0).astype(x.dtype)
