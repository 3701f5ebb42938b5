"""Which grasps of two boxes in front of a wall are free: beside the neighbour, before the wall, out of its shadow."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import Copy, Detections, Timing, grasp_conflict, table, with_grasps
from kmn_jax.detection._sources import grasps_of
from kmn_jax.errors import InputError
from kmn_jax.geometry import pad_cloud
from kmn_jax.objects import Grasp, Grasps, Gripper, Symmetries
from tests.detection.box_sample import POSES, SIZES, WALL, box_part, box_view, detection
from tests.reference.meshes import pose, random_rotations

PART, VIEW = box_part(), box_view()
conflict = jax.jit(grasp_conflict)
ACROSS = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # fingers close along the part's y
BEHIND = np.diag([1.0, -1, -1, 1])  # from the back
FOUND = Detections("box", "m", tuple(detection(PART, VIEW, T, 0.9) for T in POSES), Timing({"search": 0.5}, 0.0))


def grasps(*ways: tuple[np.ndarray, float], thickness: float = 0.1, reach: float = 0.1) -> Grasps:
    gripper = Gripper(np.array([[0, 0, -0.6]]), np.array([[1.0, 0.2, 0.2]]), np.array([thickness, 0.1, 0.6]), reach)
    return Grasps("m", gripper, tuple(Grasp(f"way {n}", T, width) for n, (T, width) in enumerate(ways, start=1)))


def names(found: Detections) -> list[list[str]]:
    return [[pick.name for pick in copy.grasps or ()] for copy in found.poses]


def test_free_grasps_are_kept_and_placed() -> None:
    base = pose((0.3, 0.2, 1.0), random_rotations(1, 2)[0])
    found = with_grasps(FOUND, grasps((np.eye(4), SIZES[0]), (ACROSS, SIZES[1])), PART, VIEW, base)
    assert names(found) == [["way 1", "way 2"]] * 2
    for copy in found.poses:
        assert copy.grasps is not None
        across = copy.grasps[1]
        np.testing.assert_allclose(across.T_scene_grasp, copy.T_scene_object @ ACROSS)
        np.testing.assert_allclose(across.T_base_grasp, base @ copy.T_scene_object @ ACROSS)
        values = copy.to_dict()["grasps"]
        assert values[1]["T_scene_grasp"] == across.T_scene_grasp.tolist()
        assert (values[1]["name"], values[1]["width"]) == ("way 2", SIZES[1])
    assert table(found, 0.5).splitlines()[1].split()[-1] == "grasps"
    assert repr(found).splitlines()[1].endswith("grasps 2)")


def test_what_was_measured_is_in_the_way() -> None:
    ways = ((np.eye(4), SIZES[0]), (ACROSS, SIZES[1]))
    # Fingers thicker than the gap to the neighbour, where they close along x.
    assert names(with_grasps(FOUND, grasps(*ways, thickness=0.6), PART, VIEW, None)) == [["way 2"]] * 2
    # Tips that reach behind the wall.
    assert names(with_grasps(FOUND, grasps(*ways, reach=WALL - 3 + 0.1), PART, VIEW, None)) == [[], []]
    # The rim of an empty bin beside the left box, which this scan does not show.
    rim = np.random.default_rng(0).uniform([-1.3, -0.05, 2.8], [-1.28, 0.05, 3.0], (50, 3)).astype(np.float32)
    assert names(with_grasps(FOUND, grasps(*ways), PART, replace(VIEW, empty=rim), None)) == [
        ["way 2"],
        ["way 1", "way 2"],
    ]


def test_of_poses_that_look_the_same_a_free_one_is_taken() -> None:
    from_behind = grasps((BEHIND, SIZES[0]))
    assert names(with_grasps(FOUND, from_behind, PART, VIEW, None)) == [[], []]
    both = Symmetries(np.stack([np.eye(3), BEHIND[:3, :3]]), np.zeros((0, 3)), np.zeros(3), 0.02)
    found = with_grasps(FOUND, from_behind, replace(PART, symmetries=both), VIEW, None)
    assert names(found) == [["way 1"]] * 2
    for copy in found.poses:
        assert copy.grasps is not None
        np.testing.assert_allclose(copy.grasps[0].T_scene_grasp[:3, 2], [0, 0, 1], atol=1e-6)


def test_grasps_of_a_symmetric_part_far_from_its_frame_s_origin_are_those_of_a_near_one() -> None:
    offset = np.array([1e9, 0.0, -1e9])
    both = Symmetries(np.stack([np.eye(3), BEHIND[:3, :3]]), np.zeros((0, 3)), np.zeros(3), 0.02)
    moved = {name: getattr(PART, name).astype(np.float64) + offset for name in ("points", "minimum", "maximum")}
    far = replace(PART, **moved, symmetries=replace(both, center=offset))
    away, back = np.eye(4), np.eye(4)
    away[:3, 3], back[:3, 3] = -offset, offset
    poses = tuple(replace(one, T_scene_object=one.T_scene_object.astype(float) @ away) for one in FOUND.poses)
    near_found = with_grasps(FOUND, grasps((BEHIND, SIZES[0])), replace(PART, symmetries=both), VIEW, None)
    far_found = with_grasps(replace(FOUND, poses=poses), grasps((back @ BEHIND, SIZES[0])), far, VIEW, None)
    assert names(far_found) == names(near_found) == [["way 1"]] * 2
    for one, other in zip(far_found.poses, near_found.poses, strict=True):
        assert one.grasps is not None
        assert other.grasps is not None
        np.testing.assert_allclose(one.grasps[0].T_scene_grasp, other.grasps[0].T_scene_grasp, atol=1e-5)


@pytest.mark.parametrize("unit", ["mm", "cm", "in"])
def test_grasps_in_a_unit_that_is_too_large_are_refused(unit: str) -> None:
    with pytest.raises(InputError, match=r"the gripper would be \d+\.\d diameters away from box: .* and unit"):
        with_grasps(FOUND, replace(grasps((BEHIND, SIZES[0])).in_unit(unit), unit="m"), PART, VIEW, None)


def test_a_gripper_inside_of_its_own_part_is_refused() -> None:
    with pytest.raises(InputError, match=r"at the grasp 'way 2', \d+% of the gripper would be inside of box"):
        with_grasps(FOUND, grasps((np.eye(4), SIZES[0]), (ACROSS, 0.5 * SIZES[1])), PART, VIEW, None)


def test_conflicts_are_counted_as_a_plain_loop_counts_them() -> None:
    generator = np.random.default_rng(3)
    points = generator.uniform(-1, 1, (500, 3)).astype(np.float32) + np.float32([0, 0, 3])
    centers, sizes = generator.uniform(-0.5, 0.5, (2, 3)), generator.uniform(0.5, 1, (2, 3))
    T = pose((0.1, 0.2, 3.0), random_rotations(1, 8)[0])
    inside = 0
    for point in points.astype(float):
        local = T[:3, :3].T @ (point - T[:3, 3])
        inside += any((np.abs(local - c) <= s / 2).all() for c, s in zip(centers, sizes, strict=True))
    copy = Copy(pad_cloud(points, 1024), jnp.zeros((256, 3)), jnp.float32(0.1))
    found = conflict(T.astype(np.float32), centers.astype(np.float32), sizes.astype(np.float32), copy, VIEW.image)
    assert 0 < inside < 500
    assert found.inside == inside


@pytest.mark.parametrize(("x", "hidden"), [(0.75, 1.0), (-0.75, 0.0), (0.0, 0.0)])
def test_behind_another_part_all_is_hidden_and_behind_its_own_nothing(x: float, hidden: float) -> None:
    own = (PART.points + POSES[0][:3, 3]).astype(np.float32)  # the left box
    copy = Copy(pad_cloud(own[:0], 1024), jnp.asarray(own[:256]), jnp.float32(0.1))
    boxes = np.zeros((2, 3), np.float32), np.full((2, 3), 0.1, np.float32)  # in one place
    found = conflict(pose((x, 0, 3.15)).astype(np.float32), *boxes, copy, VIEW.image)
    assert found.inside == 0
    assert found.hidden == pytest.approx(hidden)
    deeper = pose((x, 0, 3.45)).astype(np.float32)  # than the own box reaches, too
    assert conflict(deeper, *boxes, copy, VIEW.image).hidden == pytest.approx(float(x != 0))


def test_grasps_are_one_for_each_part() -> None:
    some = grasps((np.eye(4), 1.0))
    assert grasps_of(None, 2) == [None, None]
    assert grasps_of([None, some], 2) == [None, some]
    with pytest.raises(InputError, match="given for 1 parts, but there are 2"):
        grasps_of(some, 2)
