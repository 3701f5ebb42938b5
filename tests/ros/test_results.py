"""Poses become messages that say the same after they have gone through bytes; one search is a real one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kmn_jax.bop import bop_scan
from kmn_jax.errors import InputError
from kmn_ros.results import detection_array, likely, transforms
from kmn_ros.scans import scan_of_image
from kmn_ros.search import PartSearch, Settings
from tests.detection.box_sample import POSES, SIZES, both_boxes, box_part, box_view
from tests.reference.meshes import pose, random_rotations
from tests.ros.messages import find, header, image, info, parts_of, sent

ASSETS = Path(__file__).parents[2] / "experiments" / "assets"
PART = box_part()
FOUND = both_boxes(PART, box_view())
T_BASE_SCENE = pose((0.4, -0.2, 0.9), random_rotations(1, 5)[0])


def matrix(position: object, orientation: object) -> np.ndarray:
    """Return the pose of a message."""
    T = np.eye(4)
    T[:3, 3] = [getattr(position, axis) for axis in "xyz"]
    T[:3, :3] = Rotation.from_quat([getattr(orientation, axis) for axis in "xyzw"]).as_matrix()
    return T


def test_detections_survive_being_sent() -> None:
    turned = [replace(one, T_scene_object=T_BASE_SCENE @ one.T_scene_object) for one in FOUND.poses]
    message = detection_array(find, header(), PART, "m", turned)
    read = sent(message)
    assert parts_of(read) == parts_of(message)
    assert (read.header.frame_id, read.header.stamp.sec) == ("camera_optical", 7)
    for rank, (row, one) in enumerate(zip(read.detections, turned, strict=True), start=1):
        assert row.id == str(rank)
        assert row.header == read.header
        (result,) = row.results
        assert (result.hypothesis.class_id, result.hypothesis.score) == ("box", one.probability)
        told = result.pose.pose
        np.testing.assert_allclose(matrix(told.position, told.orientation), one.T_scene_object, atol=1e-12)
        assert not result.pose.covariance.any()
        np.testing.assert_allclose([row.bbox.size.x, row.bbox.size.y, row.bbox.size.z], SIZES)


def test_the_box_is_around_a_part_whose_frame_is_elsewhere() -> None:
    aside = np.array([0.3, 0, 0])
    part = replace(PART, minimum=PART.minimum + aside, maximum=PART.maximum + aside)
    T = T_BASE_SCENE @ POSES[0]
    (row,) = detection_array(find, header(), part, "m", [replace(FOUND.poses[0], T_scene_object=T)]).detections
    center = row.bbox.center
    np.testing.assert_allclose(matrix(center.position, center.orientation), T @ pose(aside), atol=1e-12)


def test_lengths_are_metres_and_poses_those_of_the_robot_if_asked_for() -> None:
    one = FOUND.poses[0]
    far = one.T_scene_object.copy()
    far[:3, 3] *= 1000
    millimetres = replace(one, T_scene_object=far, T_base_object=T_BASE_SCENE @ far)
    (row,) = detection_array(find, header(), PART.in_unit("mm"), "mm", [millimetres]).detections
    position = row.results[0].pose.pose.position
    np.testing.assert_allclose([position.x, position.y, position.z], one.T_scene_object[:3, 3])
    assert row.bbox.size.x == pytest.approx(SIZES[0])
    robots = T_BASE_SCENE @ far
    robots[:3, 3] /= 1000
    (moved,) = transforms(find, header("base"), "box", "mm", [millimetres], in_base=True)
    moved = sent(moved)
    assert (moved.header.frame_id, moved.child_frame_id) == ("base", "box_1")
    np.testing.assert_allclose(matrix(moved.transform.translation, moved.transform.rotation), robots, atol=1e-12)


def test_unlikely_poses_and_none_at_all() -> None:
    assert likely(FOUND, 0.5) == FOUND.poses[:1]
    assert likely(FOUND, 0.0) == FOUND.poses
    empty = detection_array(find, header(), PART, "m", ())
    assert parts_of(sent(empty)) == parts_of(empty)
    assert empty.detections == []
    assert transforms(find, header(), "box", "m", ()) == []


def test_an_image_that_was_sent_is_searched() -> None:
    scan, truth = bop_scan(ASSETS / "small_test_set" / "test" / "000002" / "depth" / "000000.png", "m")
    assert scan.depth is not None
    assert scan.camera is not None
    search = PartSearch(Settings(part=str(ASSETS / "industrial" / "gear_motor.stl")))
    depth = sent(image(np.asarray(scan.depth), "32FC1"))
    found = search(scan_of_image(depth, sent(info(scan.camera.matrix, *scan.depth.shape))))
    read = sent(detection_array(find, depth.header, search.part, found.unit, likely(found, 0.7)))
    assert read.detections
    places = [one.T_camera_object[:3, 3] for one in truth or ()]
    for row in read.detections:
        (result,) = row.results
        assert result.hypothesis.class_id == "gear_motor"
        where = result.pose.pose.position
        away = np.linalg.norm(np.array(places) - [where.x, where.y, where.z], axis=1).min()
        assert away < 0.1 * search.part.in_unit("m").diameter


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"part": ""}, "no part is given"),
        ({"input": "colour"}, "input is 'colour'"),
        ({"depth_unit": 1000.0}, "depth_unit is 1000.0"),
        ({"min_probability": 70.0}, "between 0 and 1"),
        ({"wait": 0.0}, "wait is 0.0"),
        ({"base_frame": "base"}, "go together"),
    ],
)
def test_parameters_that_cannot_be_used_are_refused(given: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Settings(**{"part": "part.stl"} | given)
