"""Normals from all points within a radius, against NumPy's eigh; degenerate neighbourhoods, blocks, padding."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.geometry import normals_within_radius
from kmn_jax.geometry._ball_normals import planes_within_radius

estimate = jax.jit(normals_within_radius)


def shell(seed: int, total: int = 600) -> np.ndarray:
    """Return points near a sphere of radius 1."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(total, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return (directions * rng.uniform(0.98, 1.02, size=(total, 1))).astype(np.float32)


def by_eigh(queries: np.ndarray, points: np.ndarray, radius: float) -> np.ndarray:
    points = points.astype(np.float64)
    near = [points[np.linalg.norm(points - query, axis=1) <= radius] for query in queries.astype(np.float64)]
    return np.stack([np.linalg.eigh(np.cov(group.T))[1][:, 0] for group in near])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("count", [5, 128, 300])
@pytest.mark.parametrize("offset", [0.0, 20.0])
def test_normals_are_the_eigenvectors_of_the_least_spread(seed: int, count: int, offset: float) -> None:
    points = shell(seed) + np.float32(offset)
    found, valid = estimate(points[:count], points, 0.4)
    assert np.asarray(valid).all()
    cosine = np.abs((np.asarray(found) * by_eigh(points[:count], points, 0.4)).sum(axis=1))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    # A point at the very boundary may count or not; all other normals agree to rounding.
    assert np.quantile(cosine, 0.02) > np.cos(np.radians(0.1))
    assert cosine.min() > np.cos(np.radians(5))


def test_a_small_radius_far_from_the_mean_keeps_its_digits() -> None:
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    patches = [rng.uniform(-1, 1, size=(50, 3)) * [0.01, 0.01, 0] @ basis.T + [side, 0, 0] for side in (-1, 1)]
    points = np.concatenate(patches).astype(np.float32)
    found, valid = estimate(points, points, 0.02)
    assert np.asarray(valid).all()
    across = np.linalg.norm(np.asarray(found) - (np.asarray(found) @ basis[:, 2:]) * basis[:, 2], axis=1)
    assert np.degrees(np.arcsin(across.max())) < 1


def test_queries_need_not_be_among_the_points() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, size=(400, 3)).astype(np.float32) * np.float32([1, 1, 0])
    found, valid = estimate(np.array([[0.0, 0, 0.1], [0, 0, 5]], dtype=np.float32), points, 0.5)
    np.testing.assert_array_equal(valid, [True, False])
    np.testing.assert_allclose(np.abs(found), [[0, 0, 1], [0, 0, 0]], atol=1e-5)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((1, 3)),
        np.array([[0.0, 0, 0], [0.1, 0, 0]]),
        np.zeros((9, 3)),
        np.linspace(0, 1, 9)[:, None] * np.array([[1.0, 2, -1]]) / 9,
    ],
    ids=["one", "two", "coincident", "on a line"],
)
def test_no_plane_no_normal(points: np.ndarray) -> None:
    found, valid = estimate(points.astype(np.float32), points.astype(np.float32), 1.0)
    assert not np.asarray(valid).any()
    assert not np.asarray(found).any()


@pytest.mark.parametrize("padding", [0.0, np.nan, np.inf])
def test_rows_masked_out_count_nowhere(padding: float) -> None:
    points, mask = shell(0), np.arange(600) % 3 != 0
    padded = np.where(mask[:, None], points, np.float32(padding))
    expected = estimate(points[:50], points[mask], 0.4)
    for part, reference in zip(estimate(points[:50], padded, 0.4, mask), expected, strict=True):
        np.testing.assert_allclose(part, reference, atol=2e-4)


def test_nothing_gives_nothing() -> None:
    points = shell(0)
    for queries, cloud in ((points[:0], points), (points[:4], points[:0])):
        found, valid = estimate(queries, cloud, 0.4)
        assert found.shape == queries.shape
        assert not np.asarray(valid).any()
    found, valid = estimate(points[:4], points, 0.4, np.zeros(600, dtype=bool))
    assert not np.asarray(valid).any()
    assert not np.asarray(found).any()


@pytest.mark.parametrize("radius", [0, -1.0, float("nan")])
def test_radii_that_are_not_positive_are_refused(radius: float) -> None:
    with pytest.raises(InputError, match="radius"):
        normals_within_radius(jnp.zeros((2, 3)), jnp.zeros((2, 3)), radius)


def test_vmap_equals_a_loop() -> None:
    points = np.stack([shell(seed) for seed in range(3)])
    batched = jax.device_get(jax.jit(jax.vmap(lambda p: normals_within_radius(p[:130], p, 0.4)))(points))
    for i in range(3):
        normals, valid = estimate(points[i, :130], points[i], 0.4)
        cosine = np.abs((batched[0][i] * np.asarray(normals)).sum(axis=1))
        assert cosine.min() > 1 - 1e-5
        np.testing.assert_array_equal(batched[1][i], valid)


def test_heights_and_residuals_are_those_of_the_points_about_the_plane() -> None:
    points = shell(3).astype(np.float64) + np.array([3.0, -2, 5])
    queries = points[:40] + np.random.default_rng(1).normal(0, 0.05, (40, 3))
    found = jax.jit(planes_within_radius)(queries.astype(np.float32), points.astype(np.float32), 0.4)
    assert np.asarray(found.valid).all()
    for query, normal, height, residual in zip(queries, *(np.asarray(field) for field in found[:3]), strict=True):
        near = points[np.linalg.norm(points - query, axis=1) <= 0.4]
        assert height == pytest.approx((query - near.mean(axis=0)) @ normal, abs=5e-3)
        assert residual == pytest.approx(((near - near.mean(axis=0)) @ normal).std(), abs=3e-3)
