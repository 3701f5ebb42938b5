"""Views of scans: depth images are their own, clouds are seen from where their sensor was."""

from __future__ import annotations

import numpy as np
import pytest

from kmn_jax.detection import View, view_of
from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera
from kmn_jax.io import Scan
from tests.reference.meshes import pose, random_rotations


def wall(count: int = 4000, seed: int = 0) -> np.ndarray:
    """Return points of a wavy wall in front of a sensor at the origin."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) * [1, 0.6, 0]
    points[:, 2] = 4 + 0.2 * np.sin(3 * points[:, 0])
    return points.astype(np.float32)


def cloud(points: np.ndarray) -> Scan:
    return Scan(points.astype(np.float32), None, None, None, "m")


def reached(view: View) -> float:
    """Return the share of points that the depth image shows within a hundredth."""
    x, y, z = view.points.T
    column = np.round(view.camera.fx * x / z + view.camera.cx).astype(int)
    row = np.round(view.camera.fy * y / z + view.camera.cy).astype(int)
    inside = (column >= 0) & (column < view.camera.width) & (row >= 0) & (row < view.camera.height)
    shown = np.zeros(len(z))
    shown[inside] = view.depth[row[inside], column[inside]]
    return float((np.abs(shown - z) < 0.01 * z).mean())


def test_a_depth_image_is_its_own_view() -> None:
    depth = np.full((4, 5), 2.0, dtype=np.float32)
    camera = Camera(10.0, 10.0, 2.0, 2.0, 5, 4)
    view = view_of(Scan(np.ones((20, 3), np.float32), None, depth, camera, "m"))
    assert view.depth is depth
    assert view.camera == camera
    np.testing.assert_array_equal(view.T_scene_view, np.eye(4))


def test_a_cloud_is_seen_from_the_origin() -> None:
    view = view_of(cloud(wall()))
    np.testing.assert_array_equal(view.T_scene_view, np.eye(4))
    assert len(view.points) == 4000
    assert reached(view) > 0.97
    rows, columns = np.nonzero(view.depth)
    filled = len(rows) / (np.ptp(rows) + 1) / (np.ptp(columns) + 1)
    assert 0.2 < filled <= 1
    np.testing.assert_array_equal(view.rows, np.arange(4000))


@pytest.mark.parametrize("row", range(3))
def test_frame_and_sensor_may_be_any(row: int) -> None:
    T = pose((5.0, -3.0, 2.0), random_rotations(3, 7)[row])
    points = wall() @ T[:3, :3].T + T[:3, 3]
    view = view_of(cloud(points), T[:3, 3])
    assert reached(view) > 0.97
    back = view.points @ view.T_scene_view[:3, :3].T + view.T_scene_view[:3, 3]
    np.testing.assert_allclose(back, points, atol=1e-4)
    assert (view.points[:, 2] > 3).all()


def test_a_sensor_among_the_points_is_refused() -> None:
    with pytest.raises(InputError, match="cannot have been at the origin, among the points: say where it was"):
        view_of(cloud(wall() - [0, 0, 4]))
    with pytest.raises(InputError, match="among the points"):
        view_of(cloud(wall()), np.array([0.0, 0.0, 4.0]))


def test_a_million_points_and_a_single_one() -> None:
    assert reached(view_of(cloud(wall(1_000_000)))) > 0.95
    assert reached(view_of(cloud(wall(1)))) == 1
