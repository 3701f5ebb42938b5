"""Where the camera was in a scan's frame, and results in the robot's, on points and poses that are known."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kmn_jax.detection import PoseEstimator
from kmn_jax.detection._scan_frame import base_from_scene, in_base, scan_frame
from kmn_jax.detection._sources import arranged, unit_words
from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera
from kmn_jax.io import Scan, UnitWords
from tests.detection.box_sample import CAMERA, POSES, both_boxes, box_part, box_view
from tests.reference.meshes import pose, random_rotations

AHEAD = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 3], (200, 3)).astype(np.float32)
OPENGL = np.diag([1.0, -1, -1, 1])
TURNED = pose((3, -2, 0.5), random_rotations(1, 5)[0])


def cloud(points: np.ndarray) -> Scan:
    return Scan(points.astype(np.float32), None, None, None, "m")


def test_a_cloud_in_any_frame_is_seen_from_where_its_camera_was() -> None:
    own = scan_frame(cloud(AHEAD), None, None)
    assert (own.sensor, own.warnings, own.is_opengl) == (None, (), False)
    np.testing.assert_array_equal(own.T_scene_sensor, np.eye(4))
    turned = scan_frame(cloud(AHEAD @ TURNED[:3, :3].T + TURNED[:3, 3]), None, TURNED.tolist())
    np.testing.assert_array_equal(turned.sensor, TURNED[:3, 3])
    np.testing.assert_array_equal(turned.T_scene_sensor, TURNED)
    assert scan_frame(cloud(AHEAD), np.zeros(3), None).T_scene_sensor is None


def test_opengl_s_frame_is_noticed_and_can_be_given() -> None:
    backwards = cloud(AHEAD @ OPENGL[:3, :3])
    found = scan_frame(backwards, None, None)
    assert found.is_opengl
    (warning,) = found.warnings
    assert "all points lie at negative z" in warning
    assert "negate y and z of all points" in warning
    assert scan_frame(backwards, np.zeros(3), None).warnings == ()
    assert scan_frame(backwards, None, OPENGL).warnings == ()
    with pytest.raises(InputError, match="to which T_base_camera cannot be applied: negate y and z"):
        base_from_scene(np.eye(4), found.T_scene_sensor, found.is_opengl)


@pytest.mark.parametrize(
    ("sensor", "T_scene_camera", "message"),
    [
        (np.zeros(3), np.eye(4), "leave sensor out"),
        (None, OPENGL, "100% of the points lie behind the camera of T_scene_camera"),
        (None, 2 * np.eye(4), "T_scene_camera is not a rigid pose"),
        (None, np.eye(3), r"T_scene_camera has shape \(3, 3\)"),
    ],
)
def test_what_cannot_be_is_one_sentence(sensor: Any, T_scene_camera: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        scan_frame(cloud(AHEAD), sensor, T_scene_camera)


def test_a_depth_image_has_its_frame() -> None:
    depth = np.ones((2, 3), np.float32)
    scan = Scan(AHEAD, None, depth, Camera(1.0, 1.0, 1.0, 1.0, 3, 2), "m")
    with pytest.raises(InputError, match="leave T_scene_camera out"):
        scan_frame(scan, None, np.eye(4))


def test_a_sensor_among_the_points_is_asked_about() -> None:
    around = AHEAD * 4 - np.float32([0, 0, 9])  # as clouds that lie about an origin of their own
    (asked,) = scan_frame(cloud(around), None, None).warnings
    assert re.match(r"as seen from the origin, where .* fill an angle of 1\d\d degrees, .*--sensor, in Python", asked)
    (asked,) = scan_frame(cloud(around), np.zeros(3), None).warnings
    assert asked.startswith("as seen from the sensor's place, the points fill an angle of ")
    assert scan_frame(cloud(around), np.array([0.0, 0, -9]), None).warnings == ()


def test_a_camera_of_another_image_size_is_asked_about() -> None:
    depth = np.ones((480, 640), np.float32)
    for width, height, is_own in ((640, 480, True), (660, 470, True), (1280, 960, False), (960, 720, False)):
        camera = Camera(600.0, 600.0, width / 2, height / 2, 640, 480)
        warnings = scan_frame(Scan(AHEAD, None, depth, camera, "m"), None, None).warnings
        assert len(warnings) == (0 if is_own else 1), (width, height)
        assert all("640 x 480 pixels: are fx, fy, cx and cy those of an image of this size" in one for one in warnings)


def test_poses_in_the_robot_s_frame() -> None:
    T_base_camera = pose((0.2, 0.7, 1.4), random_rotations(1, 6)[0])
    assert base_from_scene(None, None, False) is None
    T_base_scene = base_from_scene(T_base_camera, TURNED, False)
    assert T_base_scene is not None
    np.testing.assert_allclose(T_base_scene @ TURNED, T_base_camera, atol=1e-12)
    found = in_base(both_boxes(box_part(), box_view()), T_base_scene)
    for copy, T_scene_object in zip(found.poses, POSES, strict=True):
        assert copy.T_base_object is not None
        np.testing.assert_allclose(copy.T_base_object, T_base_scene @ T_scene_object)
        assert copy.to_dict()["T_base_object"] == copy.T_base_object.tolist()
    assert in_base(found, T_base_scene, "is it so?").warnings == (*found.warnings, "is it so?")
    with pytest.raises(InputError, match="give T_scene_camera in place of the sensor's place"):
        base_from_scene(T_base_camera, None, False)


def test_arrays_are_taken_for_what_they_are() -> None:
    organised = AHEAD.reshape(10, 20, 3)
    np.testing.assert_array_equal(arranged(organised, None, None, None, None), AHEAD)
    depth = np.ones((40, 50), np.float32)
    scan = arranged(depth, (50, 50, 25, 20), "m", None, None)
    assert isinstance(scan, Scan)
    assert scan.unit == "m"
    assert arranged(scan, None, None, None, "m") is arranged(scan, None, None, None, "auto") is scan
    cases: list[tuple[tuple[Any, ...], str]] = [
        ((depth, None, None, None, None), r"shape \(40, 50\): give K with a depth image"),
        ((depth, None, "m", None, None), "depth_unit is for depth images, which need K"),
        (("scan.ply", np.eye(3), None, None, None), "K and depth_unit are for depth images as arrays"),
        ((depth, np.eye(3), None, "camera.json", None), "leave these out"),
        ((depth, np.eye(3), None, None, "mm"), "leave these out"),
        ((scan, None, None, None, "mm"), "its own camera and unit, here m: leave camera and unit out"),
        ((scan, None, None, "camera.json", None), "leave camera and unit out"),
    ]
    for arguments, message in cases:
        with pytest.raises(InputError, match=message):
            arranged(*arguments)


def test_units_are_said_as_the_call_can() -> None:
    in_python = 'unit="{}" to prepare'
    assert unit_words("scan.ply", None, "auto") == UnitWords("--units {}", "--object-units {}")
    assert unit_words("scan.ply", None, None) == UnitWords('unit="{}"', in_python)
    assert unit_words(AHEAD, None, "mm") == UnitWords('unit="{}"', in_python, None)
    assert unit_words(AHEAD, np.eye(3), None) == UnitWords(
        'depth_unit="{}"', in_python, "depth_unit in metres for one step"
    )
    assert unit_words(cloud(AHEAD), None, None) == UnitWords('unit="{}" of the Scan', in_python, None)
    estimator: Any = SimpleNamespace(warnings=())
    depth = np.rint(1000 * box_view().depth)
    with pytest.raises(InputError, match=r'probably millimetres: say depth_unit="mm"$'):
        PoseEstimator.scene(estimator, depth, box_part(), K=CAMERA.matrix)
