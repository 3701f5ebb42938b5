"""Averages of noisy depth images: noise falls, holes stay, images with little noise are left alone."""

from __future__ import annotations

import numpy as np
import pytest

from kmn_jax.detection import make_scene
from kmn_jax.detection._averaging import averaged, noise_of, onto
from kmn_jax.geometry import Camera, measured_points
from kmn_jax.io import Scan

SHAPE = (240, 320)
CAMERA = Camera(400.0, 400.0, 159.5, 119.5, 320, 240)
DIAMETER = 50.0
FAR, NEAR = 200.0, 160.0


def plates(noise: float, seed: int = 0) -> np.ndarray:
    """Return a slanted plate, half of which a nearer one covers, with a hole, as a noisy sensor sees it."""
    exact = np.full(SHAPE, FAR) + 0.1 * np.arange(SHAPE[0])[:, None]
    exact[:, 160:] = NEAR
    depth = exact + noise * np.random.default_rng(seed).standard_normal(SHAPE)
    depth[100:110, 60:70] = 0
    return depth.astype(np.float32)


@pytest.mark.parametrize("noise", [0.05, 0.5, 1.5])
def test_noise_is_measured_whatever_the_steps(noise: float) -> None:
    assert noise_of(plates(noise)) == pytest.approx(noise, rel=0.1)


@pytest.mark.parametrize("depth", [np.zeros((4, 4)), np.full((1, 2), 3.0), np.full((9, 9), 3.0)])
def test_without_errors_there_is_no_noise(depth: np.ndarray) -> None:
    assert noise_of(depth) == 0
    given = depth.astype(np.float32)
    assert averaged(given, CAMERA, DIAMETER) is given


def test_little_noise_is_left_alone() -> None:
    depth = plates(0.004 * DIAMETER)
    assert averaged(depth, CAMERA, DIAMETER) is depth
    far = plates(0.02 * DIAMETER)
    assert averaged(far, CAMERA, 0.1 * DIAMETER) is far, "a part of few pixels would drown in its surroundings"


def test_noise_falls_and_holes_stay() -> None:
    noise = 0.01 * DIAMETER
    depth, exact = plates(noise), plates(0)
    found = averaged(depth, CAMERA, DIAMETER)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found > 0, depth > 0)
    inside = np.zeros(SHAPE, dtype=bool)
    inside[5:-5, 5:150] = inside[5:-5, 170:-5] = True
    inside &= depth > 0
    assert (found - exact)[inside].std() < noise / 2.5
    assert abs((found - exact)[inside].mean()) < 0.02 * noise
    beside = found[:, 150:170]
    assert (beside > NEAR - 6 * noise).all()
    assert (beside < FAR + 0.1 * SHAPE[0] + 6 * noise).all(), "between the plates, or on one of them"


def test_a_scene_has_points_on_its_averages() -> None:
    depth = plates(0.01 * DIAMETER)
    points = np.asarray(measured_points(depth, CAMERA))
    scene = make_scene(Scan(points, None, depth, CAMERA, "mm"), DIAMETER, inside=np.ones(len(points), dtype=bool))
    np.testing.assert_array_equal(scene.depth, averaged(depth, CAMERA, DIAMETER))
    np.testing.assert_allclose(scene.points, measured_points(scene.depth, CAMERA), rtol=1e-5)
    np.testing.assert_array_equal(np.asarray(scene.image.depth)[: SHAPE[0], : SHAPE[1]], scene.depth)


def test_points_in_no_pixel_stay_where_they_are() -> None:
    depth, twice = np.full(SHAPE, FAR, dtype=np.float32), np.full(SHAPE, 2 * FAR, dtype=np.float32)
    depth[0, 0] = 0
    shown, beyond, nowhere = [0.2, 0.2, FAR], [500, 0, FAR], [-79.75, -59.75, FAR]
    points = np.array([shown, beyond, nowhere], dtype=np.float32)
    np.testing.assert_allclose(onto(points, CAMERA, depth, twice), points * [[2], [1], [1]])


def test_clouds_are_left_alone() -> None:
    points = np.asarray(measured_points(plates(0.01 * DIAMETER), CAMERA))
    scene = make_scene(Scan(points, None, None, None, "mm"), DIAMETER, inside=np.ones(len(points), dtype=bool))
    np.testing.assert_array_equal(scene.points, points)
