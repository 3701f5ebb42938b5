from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from kmn_jax.models.layers import NormalizedLinear, channel_moments, dropout, leaky_relu, product
from tests.reference.dense_jax import group_norm


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
