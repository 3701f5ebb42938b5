"""Coordinates far from the origin keep their digits, those near to it their bits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.io import far_origin, held, object_origin, read_scan
from kmn_jax.units import place_text

UTM = np.array([5e5, 5.4e6, 300.0])
CLOUD = np.random.default_rng(0).uniform(-1, 1, (500, 3))


@pytest.mark.parametrize("offset", [np.zeros(3), np.array([0, 0, 90.0])])
def test_what_lies_near_is_not_moved(offset: np.ndarray) -> None:
    points = CLOUD + offset
    np.testing.assert_array_equal(far_origin(points.min(axis=0), points.max(axis=0)), 0)
    np.testing.assert_array_equal(object_origin(points), 0)
    assert held(points).dtype == np.float32


@pytest.mark.parametrize("offset", [UTM, np.array([0, -1e9, 0])])
def test_what_lies_far_keeps_its_digits(offset: np.ndarray) -> None:
    points = CLOUD + offset
    np.testing.assert_allclose(object_origin(points), offset, atol=0.1)
    strays = np.concatenate([points, [[1e-3, 0, 0]]])
    np.testing.assert_array_equal(held(strays), strays)


def test_what_has_lost_its_shape_is_refused() -> None:
    for points in (CLOUD + 1e11, (CLOUD + 1e6).astype(np.float32).astype(np.float64)):
        with pytest.raises(InputError, match="not enough digits"):
            object_origin(points)


def test_a_cloud_of_a_map_is_read_whole(tmp_path: Path) -> None:
    np.save(tmp_path / "utm.npy", CLOUD + UTM)
    np.savetxt(tmp_path / "utm.xyz", CLOUD + UTM, fmt="%.6f")
    for name in ("utm.npy", "utm.xyz"):
        scan = read_scan(tmp_path / name, "m")
        np.testing.assert_allclose(scan.points - UTM, CLOUD, atol=1e-6)
        np.testing.assert_allclose(scan.in_unit("mm").points / 1000 - UTM, CLOUD, atol=1e-6)
    np.save(tmp_path / "near.npy", CLOUD)
    near = read_scan(tmp_path / "near.npy", "m")
    np.testing.assert_array_equal(near.points, CLOUD.astype(np.float32))
    np.testing.assert_array_equal(near.in_unit("mm").points, CLOUD.astype(np.float32) * np.float32(1000))


def test_no_number_is_too_large_for_a_sentence(tmp_path: Path) -> None:
    np.save(tmp_path / "huge.npy", CLOUD + 1e300)
    with pytest.raises(InputError, match="none of its 500 points was measured"):
        read_scan(tmp_path / "huge.npy", "m")


def test_long_coordinates_are_shown_to_a_tenth_of_a_millimetre() -> None:
    assert place_text(np.array([0.123456, 12.3456, 0]), "m") == ["0.1235", "12.35", "0"]
    assert place_text(np.array([12.34567, 5.4e6 + 0.1234, 0]), "m") == ["12.3457", "5400000.1234", "0.0000"]
    assert place_text(np.array([-123456.78, 0, 0]), "mm")[0] == "-123456.8"


def test_scans_that_have_lost_their_shape_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "far.npy", (CLOUD + 1e6).astype(np.float32))
    with pytest.raises(InputError, match=r"far\.npy cannot be used: its points .* have not enough digits for both"):
        read_scan(tmp_path / "far.npy", "m")
    same = np.full((5, 3), 1e6)  # one place has all its digits
    np.testing.assert_array_equal(held(same), same)
