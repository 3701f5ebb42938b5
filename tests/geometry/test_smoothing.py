"""Smoothing of noisy crops: the noise that is measured, where points go, and that clean ones stay."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.geometry import SmoothConfig, smoothed, with_normals

smooth = jax.jit(smoothed, static_argnames="config")


def tilted_plane(count: int, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return points on a square of side 2 with noise on all coordinates, and its normal."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = rng.uniform(-1, 1, (count, 3)) * [1, 1, 0]
    return (flat @ basis.T + noise * rng.normal(size=(count, 3))).astype(np.float32), basis[:, 2]


@pytest.mark.parametrize("noise", [0.0, 0.005, 0.01])
def test_the_noise_of_a_plane_is_measured(noise: float) -> None:
    points, _ = tilted_plane(3000, noise)
    there = np.ones(3000, dtype=bool)
    *_, measured = smooth(points[:500], there[:500], points, there, 1.0)
    assert float(measured) == pytest.approx(noise, rel=0.25, abs=5e-4)


def test_very_noisy_points_are_moved_onto_the_surface() -> None:
    points, normal = tilted_plane(4000, 0.04)
    inside = np.abs(points).max(axis=1) < 0.6  # balls at the rim are halves
    there = np.ones(4000, dtype=bool)
    moved, normals, known, _ = smooth(points, there, points, there, 1.0)
    assert np.asarray(known).all()
    before, after = ((np.asarray(cloud)[inside] @ normal).std() for cloud in (points, moved))
    assert after < 0.3 * before
    cosine = np.abs(np.asarray(normals)[inside] @ normal)
    assert np.median(cosine) > np.cos(np.radians(10))


def test_clean_points_stay_on_both_sides_of_an_edge() -> None:
    rng = np.random.default_rng(0)
    sides = [rng.uniform(0, 1, (2000, 3)) * [1, 1, 0], rng.uniform(0, 1, (2000, 3)) * [0, 1, 1]]
    points = np.concatenate(sides).astype(np.float32)
    there = np.ones(len(points), dtype=bool)
    moved, *_ = smooth(points, there, points, there, 1.0)
    assert np.linalg.norm(np.asarray(moved) - points, axis=1).max() < 1e-3


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_no_unit_is_preferred(scale: float) -> None:
    points, _ = tilted_plane(2000, 0.02)
    there = np.ones(2000, dtype=bool)
    plain, scaled = (
        smooth(points[:100] * f, there[:100], points * f, there, np.float32(f)) for f in np.float32([1, scale])
    )
    np.testing.assert_allclose(np.asarray(scaled[0]) / scale, plain[0], atol=2e-4)
    assert float(scaled[3]) / scale == pytest.approx(float(plain[3]), rel=1e-3)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_points_far_from_each_other_stay_and_have_no_normal(count: int) -> None:
    points = np.eye(3, dtype=np.float32)[np.arange(count) % 3] * np.arange(1, count + 1, dtype=np.float32)[:, None]
    there = np.ones(count, dtype=bool)
    moved, normals, known, noise = smooth(points, there, points, there, 1.0)
    np.testing.assert_array_equal(moved, points)
    assert not np.asarray(known).any()
    assert not np.asarray(normals).any()
    assert float(noise) == 0


def test_noise_is_measured_all_over_not_where_the_rows_begin() -> None:
    """The first rows, as an image's, lie along an edge: noise is that of the faces beyond."""
    points, normal = tilted_plane(3000, 0.002)
    rng = np.random.default_rng(1)
    rough = rng.normal(0, 0.05, (200, 3)).astype(np.float32) + np.float32(5) * normal.astype(np.float32)
    rows = np.concatenate([rough, points])
    there = np.ones(len(rows), dtype=bool)
    *_, measured = smooth(rows, there, rows, there, 1.0)
    assert float(measured) == pytest.approx(0.002, rel=0.3)


def test_padding_counts_nowhere() -> None:
    points, _ = tilted_plane(1500, 0.02)
    there = np.ones(1500, dtype=bool)
    plain = smooth(points[:200], there[:200], points, there, 1.0)
    padded = np.pad(points, ((0, 548), (0, 0)), constant_values=7)
    found = smooth(padded[:200], there[:200], padded, np.pad(there, (0, 548)), 1.0)
    np.testing.assert_allclose(found[0], plain[0], atol=1e-4)
    assert float(found[3]) == pytest.approx(float(plain[3]), rel=1e-3)


def test_points_with_normals_are_smoothed_and_face_the_camera() -> None:
    points, normal = tilted_plane(4000, 0.04)
    shown = points + np.float32([0, 0, 6])
    there = np.ones(4000, dtype=bool)
    camera, mask = np.zeros(3, dtype=np.float32), np.arange(256) < 250
    given = (shown[:256], mask, shown, there, camera, np.float32(1), 0.06)
    moved, normals = jax.jit(with_normals, static_argnums=(6, 7))(*given, SmoothConfig())
    spread = ((np.asarray(moved)[mask] - [0, 0, 6]) @ normal).std()
    assert spread < 0.025  # of 0.04
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), mask, atol=1e-5)
    assert ((np.asarray(normals) * np.asarray(moved)).sum(axis=1)[mask] < 0).all()
    plain, rough = jax.jit(with_normals, static_argnums=(6, 7))(*given, None)
    np.testing.assert_array_equal(plain, shown[:256])
    np.testing.assert_allclose(np.linalg.norm(rough, axis=1), mask, atol=1e-5)


@pytest.mark.parametrize(
    "values",
    [
        {"least_radius": 0.0},
        {"least_radius": 0.3},
        {"radius_per_noise": -1.0},
        {"probe_radius": 0.0},
        {"moved_noise": 0.0},
        {"probes": 0},
        {"quantile": 1.5},
    ],
)
def test_settings_without_meaning_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(values))):
        SmoothConfig(**values)  # type: ignore[arg-type]
