"""Cameras placed at random: the bin is in the picture, and the config's bounds hold."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.simulate import Bin, CameraConfig, place_camera

EDGE = CameraConfig(
    width=640, height=640, distance=(0.01, 40.0), clearance=1.1, aim=0.25, tilt=45.0, roll=180.0, fill=(0.999, 1.0)
)


@pytest.mark.parametrize("config", [CameraConfig(), EDGE], ids=["default", "widest"])
def test_the_bin_is_in_a_thousand_pictures(config: CameraConfig) -> None:
    rng = np.random.default_rng(0)
    reached, heights = [], []
    for _ in range(1000):
        diagonal = rng.uniform(0.01, 100)
        length, width, height = rng.uniform(0.5, 4, 3) * diagonal
        bin = Bin(length, width, height, rng.uniform(0.01, 0.3) * diagonal)
        camera, T = place_camera(bin, diagonal, config, rng)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) > 0
        x, y = length / 2 + bin.thickness, width / 2 + bin.thickness
        corners = np.array([[a, b, z] for a in (-x, x) for b in (-y, y) for z in (-bin.thickness, height)])
        seen = (corners @ T[:3, :3].T + T[:3, 3]) @ camera.matrix.T
        assert (seen[:, 2] > 0).all()
        pixels = seen[:, :2] / seen[:, 2:]
        assert (pixels >= -1e-9).all()
        assert (pixels <= np.array([config.width - 1, config.height - 1]) + 1e-9).all()
        middle = np.array([config.width - 1, config.height - 1]) / 2
        reached.append(np.abs(pixels / middle - 1).max())
        position = -T[:3, :3].T @ T[:3, 3]
        heights.append((position[2] - height) / diagonal)
        assert position[2] > height
        assert np.degrees(np.arccos(-T[2, 2])) <= config.tilt + 1e-9
    # The farthest corner is as far out as `fill` says, over its whole range.
    assert config.fill[0] - 1e-9 <= min(reached) < max(reached) <= config.fill[1] + 1e-9
    assert max(reached) - min(reached) > 0.9 * (config.fill[1] - config.fill[0])


def test_distance_tilt_and_roll_follow_the_config() -> None:
    bin, config = Bin(3.4, 2.4, 1.2, 0.05), CameraConfig(aim=0.0, distance=(7.0, 10.0), tilt=20.0, roll=15.0)
    rng = np.random.default_rng(1)
    views = [place_camera(bin, 1.0, config, rng)[1] for _ in range(500)]
    positions = np.array([-T[:3, :3].T @ T[:3, 3] for T in views])
    distances = np.linalg.norm(positions - [0, 0, 0.6], axis=1)
    assert 7 <= distances.min() < 7.1
    assert 9.9 < distances.max() <= 10
    # With no aim, the bin's middle is on the optical axis.
    middles = np.array([T[:3, :3] @ [0, 0, 0.6] + T[:3, 3] for T in views])
    np.testing.assert_allclose(middles[:, :2], 0, atol=1e-12)
    np.testing.assert_allclose(middles[:, 2], distances, rtol=1e-12)
    tilts = np.degrees([np.arccos(-T[2, 2]) for T in views])
    assert tilts.min() < 1
    assert 19 < tilts.max() <= 20
    lengthways = np.array([T[:3, 0] for T in views])
    rolls = np.degrees(np.arctan2(lengthways[:, 1], lengthways[:, 0]))
    assert -15 <= rolls.min() < -14
    assert 14 < rolls.max() <= 15
    oblique = replace(config, tilt=45.0, least_tilt=30.0)
    steep = np.degrees([np.arccos(-place_camera(bin, 1.0, oblique, rng)[1][2, 2]) for _ in range(200)])
    assert 30 <= steep.min() < 31 < 44 < steep.max() <= 45
    # Cameras stand on all sides of the bin.
    np.testing.assert_array_less(np.abs(positions[:, :2].mean(axis=0)), 0.3)
    assert (np.ptp(positions[:, :2], axis=0) > 4).all()


def test_a_large_bin_is_seen_from_farther_off() -> None:
    bin, config = Bin(40.0, 30.0, 10.0, 0.5), CameraConfig(aim=0.0)
    _, T = place_camera(bin, 1.0, config, np.random.default_rng(0))
    distance = np.linalg.norm(-T[:3, :3].T @ T[:3, 3] - [0, 0, 5])
    assert distance == pytest.approx(1.2 * np.linalg.norm([41, 31, 10.5]))


def test_the_unit_does_not_matter_and_generators_decide() -> None:
    small = place_camera(Bin(3.4, 2.4, 1.2, 0.05), 1.0, CameraConfig(), np.random.default_rng(7))
    large = place_camera(Bin(3400.0, 2400.0, 1200.0, 50.0), 1000.0, CameraConfig(), np.random.default_rng(7))
    assert small[0].fx == pytest.approx(large[0].fx)
    np.testing.assert_allclose(small[1][:3, 3] * 1000, large[1][:3, 3])
    again = place_camera(Bin(3.4, 2.4, 1.2, 0.05), 1.0, CameraConfig(), np.random.default_rng(7))
    assert again[0] == small[0]
    np.testing.assert_array_equal(again[1], small[1])
    other = place_camera(Bin(3.4, 2.4, 1.2, 0.05), 1.0, CameraConfig(), np.random.default_rng(8))
    assert not np.allclose(other[1], small[1])


@pytest.mark.parametrize(
    "wrong",
    [
        {"width": 1},
        {"distance": (0.0, 3.0)},
        {"distance": (5.0, 3.0)},
        {"fill": (0.5, 1.1)},
        {"clearance": 1.0},
        {"aim": 0.3},
        {"tilt": 60.0},
        {"tilt": 46.0},
        {"least_tilt": 21.0},
        {"least_tilt": -1.0},
        {"roll": float("nan")},
    ],
    ids=lambda wrong: next(iter(wrong)),
)
def test_a_config_that_may_lose_the_bin_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        replace(CameraConfig(), **wrong)


def test_a_bad_diagonal_is_refused() -> None:
    with pytest.raises(InputError, match="diagonal is nan"):
        place_camera(Bin(3.0, 2.0, 1.0, 0.1), float("nan"), CameraConfig(), np.random.default_rng(0))
