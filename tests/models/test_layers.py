from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from benchmarks.reference.dense_jax import group_norm
from kmn_jax.models._layers import ChannelAffine, NormalizedLinear, channel_moments, dropout, leaky_relu, product


def signed_layer(in_features: int, out_features: int, groups: int, seed: int = 0) -> NormalizedLinear:
    """Draw a layer with GroupNorm weights of both signs."""
    layer = NormalizedLinear(in_features, out_features, groups, rngs=nnx.Rngs(seed))
    rng = np.random.default_rng(seed)
    layer.norm_scale[...] = jnp.asarray(rng.uniform(0.5, 1.5, out_features) * rng.choice([-1, 1], out_features), "f4")
    layer.norm_bias[...] = jnp.asarray(rng.normal(size=out_features), "f4")
    return layer


@pytest.mark.parametrize("shape", [(50, 12), (30, 7, 12)])
def test_moments_are_those_of_numpy(shape: tuple[int, ...]) -> None:
    x = np.random.default_rng(0).normal(loc=20, size=shape).astype(np.float32)
    moments = channel_moments(jnp.asarray(x))
    rows = x.reshape(-1, shape[-1]).astype(np.float64)
    np.testing.assert_allclose(moments.mean, rows.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(moments.variance, rows.var(axis=0), rtol=1e-4)


def test_masked_moments_ignore_padding() -> None:
    x = np.random.default_rng(1).normal(size=(40, 5)).astype(np.float32)
    mask = np.arange(40) < 23
    x[23:] = 1e6
    got = channel_moments(jnp.asarray(x), jnp.asarray(mask))
    want = channel_moments(jnp.asarray(x[:23]))
    np.testing.assert_allclose(got.mean, want.mean, atol=1e-6)
    np.testing.assert_allclose(got.variance, want.variance, rtol=1e-5)


def test_moments_of_a_grid_of_sums() -> None:
    rng = np.random.default_rng(2)
    a, b = (jnp.asarray(rng.normal(size=(n, 6)), "f4") for n in (31, 7))
    got = channel_moments(a).plus(channel_moments(b))
    want = channel_moments(a[:, None, :] + b[None, :, :])
    np.testing.assert_allclose(got.mean, want.mean, atol=1e-6)
    np.testing.assert_allclose(got.variance, want.variance, rtol=1e-5)


@pytest.mark.parametrize("groups", [1, 4, 16])
def test_layer_is_linear_groupnorm_leaky(groups: int) -> None:
    layer = signed_layer(9, 16, groups)
    x = jnp.asarray(np.random.default_rng(3).normal(size=(100, 9)), "f4")
    z = group_norm(x @ layer.kernel[...], layer.norm_scale[...][None, :], layer.norm_bias[...][None, :], groups)
    np.testing.assert_allclose(layer(x, "float32"), jnp.where(z >= 0, z, 0.2 * z), atol=2e-5)


def test_constant_input_stays_finite() -> None:
    out = signed_layer(9, 16, 16)(jnp.ones((20, 9)), "float32")
    assert bool(jnp.isfinite(out).all())


def test_compute_dtypes() -> None:
    x, kernel = jnp.ones((4, 8)), jnp.ones((8, 2))
    assert product(x, kernel, "bfloat16").dtype == jnp.bfloat16
    assert product(x, kernel, "tf32").dtype == product(x, kernel, "float32").dtype == jnp.float32


def test_leaky_relu() -> None:
    np.testing.assert_allclose(leaky_relu(jnp.array([-2.0, 0.0, 3.0])), [-0.4, 0.0, 3.0])


def test_dropout_keeps_the_mean_and_zeroes_the_share() -> None:
    x = jnp.ones((400, 100))
    dropped = dropout(x, 0.4, jax.random.key(0))
    assert abs(float((dropped == 0).mean()) - 0.4) < 0.01
    assert abs(float(dropped.mean()) - 1) < 0.02
    assert dropout(x, 0.4, None) is x


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
    z = jnp.asarray(rng.normal(size=shape) * 3 + 1, "f4")
    mask = jnp.asarray(np.arange(shape[0]) < shape[0] - 3) if masked else None
    if mask is not None and len(shape) == 3:  # every row has an entry
        mask = mask[:, None] | (jnp.arange(shape[1]) < 2)[None, :]
    towards = jnp.asarray(rng.normal(size=shape), "f4")
    towards = towards if mask is None else jnp.where(mask[..., None], towards, 0)
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
        return ((y + activated) * towards).sum() + (kept.max(axis=-2) ** 2).sum()

    for found, wanted in zip(
        jax.grad(split, (0, 1, 2))(z, weight, bias), jax.grad(plain, (0, 1, 2))(z, weight, bias), strict=True
    ):
        np.testing.assert_allclose(found, wanted, atol=2e-4, rtol=2e-4)


def test_the_gradient_of_a_maximum_goes_to_the_first_of_equals() -> None:
    affine = ChannelAffine(jnp.array([2.0, -1.0, 1.0]), jnp.zeros(3))
    x = jnp.array([[1.0, 3.0, 5.0], [4.0, 2.0, 5.0], [4.0, 2.0, 0.0]])
    gradient = jax.grad(lambda x: affine.activated_largest(x, 0).sum())(x)
    np.testing.assert_allclose(gradient, [[0, 0, 1], [2, -0.2, 0], [0, 0, 0]])
    masked = jax.grad(lambda x: affine.activated_largest(x, 0, jnp.array([True, False, True])).sum())(x)
    np.testing.assert_allclose(masked, [[0, 0, 1], [0, 0, 0], [2, -0.2, 0]])


def test_a_maximum_keeps_what_is_not_a_number() -> None:
    affine = ChannelAffine(jnp.ones(1), jnp.zeros(1))
    for rows in ([1.0, jnp.nan, 2.0], [jnp.nan, 1.0, 2.0], [1.0, 2.0, jnp.nan]):
        value, _ = jax.value_and_grad(lambda x: affine.activated_largest(x, 0).sum())(jnp.array(rows)[:, None])
        assert bool(jnp.isnan(value))
