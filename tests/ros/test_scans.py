"""Depth images and clouds of messages become scans, whatever their byte order and padding; others are refused."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from kmn_jax.bop import bop_scan
from kmn_jax.errors import InputError
from kmn_ros.scans import depth_of, intrinsics_of, scan_of_cloud, scan_of_image
from tests.ros.messages import STORE, cloud, image, info, same_but, sent

ROOT = Path(__file__).parents[2]
K = np.array([[600.0, 0, 31.5], [0, 610.0, 23.5], [0, 0, 1]])
MILLIMETRES = np.random.default_rng(0).integers(400, 900, (48, 64)).astype(np.uint16)
MILLIMETRES[:5] = 0
POINTS = np.random.default_rng(1).uniform(0.5, 1.5, (6, 8, 3))
POINTS[0, 0], POINTS[0, 1] = 0, np.nan


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 6])
def test_a_depth_image_is_the_same_in_both_encodings(big: bool, padding: int) -> None:
    camera = sent(info(K, 48, 64))
    whole = sent(image(MILLIMETRES, "16UC1", big, padding))
    metres = sent(image((MILLIMETRES / 1000).astype(np.float32), "32FC1", big, 2 * padding))
    np.testing.assert_array_equal(depth_of(whole), MILLIMETRES)
    one, other = scan_of_image(whole, camera), scan_of_image(metres, camera)
    assert one.unit == other.unit == "m"
    np.testing.assert_allclose(one.depth, MILLIMETRES / 1000, rtol=1e-6)
    np.testing.assert_allclose(other.depth, one.depth, rtol=1e-6)
    assert len(one.points) == (MILLIMETRES > 0).sum()
    assert one.camera is not None
    assert (one.camera.fx, one.camera.fy, one.camera.cx, one.camera.cy) == (600, 610, 31.5, 23.5)
    np.testing.assert_allclose(scan_of_image(whole, camera, 0.00025).depth, MILLIMETRES / 4000, rtol=1e-6)


def test_intrinsics_are_those_of_the_rectified_image() -> None:
    raw = K.copy()
    raw[0, 0] = 500
    np.testing.assert_array_equal(intrinsics_of(info(K, 48, 64, k=raw.reshape(-1)), 48, 64), K)
    np.testing.assert_array_equal(intrinsics_of(info(raw, 48, 64, p=np.zeros(12)), 48, 64), raw)
    part = info(K, 96, 128, binning_x=2, binning_y=2, roi={"x_offset": 10, "y_offset": 4, "width": 64, "height": 48})
    binned = intrinsics_of(part, 24, 32)
    np.testing.assert_allclose(binned, [[300, 0, (31.5 - 10) / 2], [0, 305, (23.5 - 4) / 2], [0, 0, 1]])


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("big", [False, True])
def test_a_cloud_gives_its_measured_points(kind: type, big: bool) -> None:
    scan = scan_of_cloud(sent(cloud(POINTS.astype(kind), big=big, padding=5)))
    assert scan.unit == "m"
    np.testing.assert_allclose(scan.points, POINTS.reshape(-1, 3)[2:], rtol=1e-6)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"encoding": "rgb8"}, "encoding is 'rgb8', but must be one of 16UC1"),
        ({"step": 100}, "which do not belong together"),
        ({"height": 47}, "which do not belong together"),
        ({"height": 0, "data": np.zeros(0, np.uint8)}, "which do not belong together"),
    ],
)
def test_images_that_are_none_are_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        scan_of_image(same_but(image(MILLIMETRES, "16UC1"), **changed), info(K, 48, 64))


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (info(K, 480, 640), "64 x 48 pixels, but its camera info is of 640 x 480"),
        (info(np.zeros((3, 3)), 48, 64), "holds no intrinsics"),
    ],
)
def test_cameras_of_other_images_are_refused(camera: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        scan_of_image(image(MILLIMETRES, "16UC1"), camera)


def test_clouds_without_points_are_refused() -> None:
    for names in ("xyw", "abc"):
        with pytest.raises(InputError, match="no x, y and z"):
            scan_of_cloud(cloud(POINTS, names))
    with pytest.raises(InputError, match="none of the cloud's points was measured"):
        scan_of_cloud(cloud(np.full((2, 2, 3), np.nan)))
    good = cloud(POINTS)
    for changed in ({"point_step": 8}, {"row_step": 3}, {"height": 7}, {"width": 0}, {"height": 0}):
        with pytest.raises(InputError, match="do not belong together"):
            scan_of_cloud(same_but(good, **changed))


def test_the_example_bag_holds_the_images_of_the_small_test_set(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("write_example_bag", ROOT / "ros2" / "write_example_bag.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    paths = sorted(script.IMAGES.glob("*.png"))[1:3]
    script.write_bag(tmp_path / "bag", paths)
    with Reader(tmp_path / "bag") as reader:
        messages = [STORE.deserialize_cdr(raw, topic.msgtype) for topic, _, raw in reader.messages()]
        assert set(reader.topics) == {"/camera/depth/camera_info", "/camera/depth/image_rect_raw"}
    assert len(messages) == 4
    for path, camera, depth in zip(paths, messages[::2], messages[1::2], strict=True):
        assert camera.header == depth.header
        read, there = scan_of_image(depth, camera), bop_scan(path, "m")[0]
        np.testing.assert_allclose(read.points, there.points, atol=1e-6)
