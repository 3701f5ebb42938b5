from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from benchmarks.reference.dense_jax import group_norm
from kmn_jax.models._layers import ChannelAffine, NormalizedLinear, channel_moments, dropout, leaky_relu, product
from tests.reference.networks import signed

moments_of = jax.jit(channel_moments)


def signed_layer(in_features: int, out_features: int, groups: int, seed: int = 0) -> NormalizedLinear:
    return signed(lambda: NormalizedLinear(in_features, out_features, groups, rngs=nnx.Rngs(0)), seed)


def layer_form(layer: NormalizedLinear, x: jax.Array) -> jax.Array:
    """Return what a layer gives, in the plain form."""
    row = (1,) * (x.ndim - 1) + (-1,)
    z = jnp.matmul(x, layer.kernel[...], precision=jax.lax.Precision.HIGHEST)
    z = group_norm(z, layer.norm_scale[...].reshape(row), layer.norm_bias[...].reshape(row), layer.groups)
    return jnp.where(z >= 0, z, 0.2 * z)


@pytest.mark.parametrize("shape", [(50, 12), (30, 7, 12)])
def test_moments_are_those_of_numpy(shape: tuple[int, ...]) -> None:
    x = np.random.default_rng(0).normal(loc=20, size=shape).astype(np.float32)
    moments = moments_of(x)
    rows = x.reshape(-1, shape[-1]).astype(np.float64)
    np.testing.assert_allclose(moments.mean, rows.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(moments.variance, rows.var(axis=0), rtol=1e-4)


def test_masked_moments_ignore_padding() -> None:
    x = np.random.default_rng(1).normal(size=(40, 5)).astype(np.float32)
    mask = np.arange(40) < 23
    x[23:] = 1e6
    got, want = moments_of(x, mask), moments_of(x[:23])
    np.testing.assert_allclose(got.mean, want.mean, atol=1e-6)
    np.testing.assert_allclose(got.variance, want.variance, rtol=1e-5)


def test_moments_of_a_grid_of_sums() -> None:
    rng = np.random.default_rng(2)
    a, b = (rng.normal(size=(n, 6)).astype("f4") for n in (31, 7))
    got = jax.jit(lambda a, b: channel_moments(a).plus(channel_moments(b)))(a, b)
    want = moments_of(a[:, None, :] + b[None, :, :])
    np.testing.assert_allclose(got.mean, want.mean, atol=1e-6)
    np.testing.assert_allclose(got.variance, want.variance, rtol=1e-5)


@pytest.mark.parametrize("groups", [1, 4, 16])
def test_layer_is_linear_groupnorm_leaky(groups: int) -> None:
    layer = signed_layer(9, 16, groups)
    x = np.random.default_rng(3).normal(size=(100, 9)).astype("f4")
    got, want = jax.jit(lambda layer, x: (layer(x, "float32"), layer_form(layer, x)))(layer, x)
    np.testing.assert_allclose(got, want, atol=2e-5)


def test_constant_input_stays_finite() -> None:
    layer = signed_layer(9, 16, 16)
    assert np.isfinite(jax.jit(lambda x: layer(x, "float32"))(np.ones((20, 9), "f4"))).all()


def test_compute_dtypes() -> None:
    x, kernel = jnp.ones((4, 8)), jnp.ones((8, 2))
    for compute, dtype in (("bfloat16", jnp.bfloat16), ("tf32", jnp.float32), ("float32", jnp.float32)):
        assert jax.eval_shape(partial(product, compute=compute), x, kernel).dtype == dtype


def test_leaky_relu() -> None:
    np.testing.assert_allclose(leaky_relu(jnp.array([-2.0, 0.0, 3.0])), [-0.4, 0.0, 3.0])


def test_dropout_keeps_the_mean_and_zeroes_the_share() -> None:
    x = jnp.ones((400, 100))
    dropped = np.asarray(jax.jit(lambda key: dropout(x, 0.4, key))(jax.random.key(0)))
    assert abs((dropped == 0).mean() - 0.4) < 0.01
    assert abs(dropped.mean() - 1) < 0.02
    assert dropout(x, 0.4, None) is x


def largest(x: jax.Array, axis: int) -> jax.Array:
    """Return x.max(axis); its own derivative compares values, which two uses of them may have rounded otherwise."""
    return jnp.take_along_axis(x, x.argmax(axis=axis, keepdims=True), axis=axis).squeeze(axis)


def plain_normalized(z: jax.Array, weight: jax.Array, bias: jax.Array, mask: jax.Array | None) -> jax.Array:
    """GroupNorm of one channel a group over the real rows, by XLA's own derivative."""
    axes = tuple(range(z.ndim - 1))
    real = jnp.ones(z.shape[:-1], dtype=bool) if mask is None else mask
    mean = z.mean(axis=axes, where=real[..., None])
    variance = z.var(axis=axes, where=real[..., None])
    row = (1,) * (z.ndim - 1) + (-1,)
    return (z - mean.reshape(row)) / jnp.sqrt(variance.reshape(row) + 1e-5) * weight.reshape(row) + bias.reshape(row)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", [(40, 6), (15, 4, 6)])
def test_gradients_are_those_of_the_plain_form(shape: tuple[int, ...], masked: bool) -> None:
    layer = signed_layer(6, 6, 6)
    rng = np.random.default_rng(4)
    z = (rng.normal(size=shape) * 3 + 1).astype("f4")
    mask = np.arange(shape[0]) < shape[0] - 3 if masked else None
    if mask is not None and len(shape) == 3:  # every row has an entry
        mask = mask[:, None] | (np.arange(shape[1]) < 2)
    towards = rng.normal(size=shape).astype("f4")
    if mask is not None:
        towards, mask = np.where(mask[..., None], towards, 0), jnp.asarray(mask)
    weight, bias = layer.norm_scale[...], layer.norm_bias[...]

    def split(z: jax.Array, weight: jax.Array, bias: jax.Array) -> jax.Array:
        traced = NormalizedLinear(6, 6, 6, rngs=nnx.Rngs(0))
        traced.norm_scale[...], traced.norm_bias[...] = weight, bias
        affine = traced.affine(channel_moments(z, mask))
        linear = (affine(z) * towards).sum()
        largest = affine.activated_largest(z, z.ndim - 2, mask)
        return linear + (affine.activated(z) * towards).sum() + (largest**2).sum()

    def plain(z: jax.Array, weight: jax.Array, bias: jax.Array) -> jax.Array:
        y = plain_normalized(z, weight, bias, mask)
        activated = jnp.where(y >= 0, y, 0.2 * y)
        kept = activated if mask is None else jnp.where(mask[..., None], activated, -jnp.inf)
        return ((y + activated) * towards).sum() + (largest(kept, -2) ** 2).sum()

    for found, wanted in zip(
        *(jax.jit(jax.grad(form, (0, 1, 2)))(z, weight, bias) for form in (split, plain)), strict=True
    ):
        np.testing.assert_allclose(found, wanted, atol=2e-4, rtol=2e-4)


def test_the_gradient_of_a_maximum_goes_to_the_first_of_equals() -> None:
    affine = ChannelAffine(jnp.array([2.0, -1.0, 1.0]), jnp.zeros(3))
    x = jnp.array([[1.0, 3.0, 5.0], [4.0, 2.0, 5.0], [4.0, 2.0, 0.0]])
    gradient_of = jax.jit(jax.grad(lambda x, mask=None: affine.activated_largest(x, 0, mask).sum()))
    np.testing.assert_allclose(gradient_of(x), [[0, 0, 1], [2, -0.2, 0], [0, 0, 0]])
    masked = gradient_of(x, jnp.array([True, False, True]))
    np.testing.assert_allclose(masked, [[0, 0, 1], [0, 0, 0], [2, -0.2, 0]])


def test_a_maximum_keeps_what_is_not_a_number() -> None:
    affine = ChannelAffine(jnp.ones(1), jnp.zeros(1))
    forward = jax.jit(jax.value_and_grad(lambda x: affine.activated_largest(x, 0).sum()))
    for rows in ([1.0, np.nan, 2.0], [np.nan, 1.0, 2.0], [1.0, 2.0, np.nan]):
        assert np.isnan(forward(np.float32(rows)[:, None])[0])
