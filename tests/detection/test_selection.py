"""Selection of hypotheses: distances under symmetries, parts inside of parts, the greedy choice, and its gaps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import (
    Calibration,
    Candidates,
    DetectConfig,
    Selection,
    same_place,
    select,
    symmetry_transforms,
)
from kmn_jax.detection import chosen as choose_candidates
from kmn_jax.detection._selection import _greedy, overlap, share_inside
from kmn_jax.objects import Part, Symmetries
from kmn_jax.objects._symmetry import rotation_about
from kmn_jax.pose import mssd
from tests.reference.meshes import pose, random_rotations
from tests.reference.parts import box_part, on_device

Z = np.array([0.0, 0.0, 1.0])
BOX = box_part()
NO_TURN = np.eye(4, dtype=np.float32)[None]


def moved(x: float, y: float, z: float, rotation: np.ndarray | None = None) -> np.ndarray:
    return pose((x, y, z), np.eye(3) if rotation is None else rotation)


def apart(one: np.ndarray, others: list[np.ndarray], transforms: np.ndarray = NO_TURN) -> np.ndarray:
    single = [mssd(one.astype("f4"), other.astype("f4"), BOX.points, transforms) for other in others]
    return np.array(single)


def chosen(
    poses: np.ndarray, score: np.ndarray, usable: np.ndarray | None = None, part: Part = BOX, **settings: float
) -> Selection:
    """Select among at most four poses: as so many of 256 points, all are chosen from by one program."""
    count = len(score)
    usable = np.ones(count, dtype=bool) if usable is None else usable
    poses = np.concatenate([poses, np.tile(np.eye(4), (4 - count, 1, 1))]).astype(np.float32)
    score, usable = np.pad(score, (0, 4 - count)).astype(np.float32), np.pad(usable, (0, 4 - count))
    found = jax.device_get(choose(poses, score, usable, on_device(part), **settings))
    return jax.tree.map(lambda leaf: leaf[:count], found)


choose = jax.jit(select, static_argnames="contest")
shared, inside = jax.jit(overlap), jax.jit(share_inside)


def test_distances_are_those_of_the_farthest_point() -> None:
    turn = moved(0, 0, 0, rotation_about(Z, np.pi / 2))
    farthest = np.linalg.norm(BOX.points - BOX.points @ turn[:3, :3].T, axis=1).max()
    found = apart(np.eye(4), [np.eye(4), moved(0.3, 0.4, 0), turn])
    np.testing.assert_allclose(found, [0, 0.5, farthest], rtol=1e-5, atol=1e-5)


def test_symmetric_poses_are_the_same() -> None:
    rotations = np.stack([np.eye(3), rotation_about(Z, np.pi)])
    transforms = symmetry_transforms(Symmetries(rotations, np.zeros((0, 3)), np.array([0.1, 0, 0]), 0.02))
    base = pose((1.0, 2.0, 3.0), random_rotations(1, 0)[0])
    same, other = base @ transforms[1], base @ moved(0, 0, 0, rotation_about(Z, 0.5))
    found = apart(base, [same, other], transforms)
    np.testing.assert_allclose(found[0], 0, atol=1e-4)
    assert found[1] > 0.2
    np.testing.assert_allclose(transforms[1] @ [0.1, 0, 0, 1], [0.1, 0, 0, 1], atol=1e-6)  # about the centre


def test_continuous_symmetries_are_taken_in_steps() -> None:
    transforms = symmetry_transforms(Symmetries(np.eye(3)[None], Z[None], np.zeros(3), 0.02))
    assert transforms.shape == (36, 4, 4)
    found = apart(np.eye(4), [moved(0, 0, 0, rotation_about(Z, np.radians(95)))], transforms)
    widest = np.linalg.norm(BOX.points[:, :2], axis=1).max()
    np.testing.assert_allclose(found[0], 2 * widest * np.sin(np.radians(2.5)), rtol=1e-3)


def test_what_two_parts_share_is_counted_but_not_where_they_touch() -> None:
    half_turn = moved(0, 0, 0, rotation_about(Z, np.pi))
    others = [np.eye(4), moved(5, 0, 0), moved(0, 1.0, 0), moved(0, 0.4, 0), half_turn]
    given = (
        BOX.points,
        BOX.normals.astype(np.float32),
        np.float32((BOX.area / len(BOX.points)) ** 0.5),
        np.float32(0.05),
    )
    found = np.array([shared(NO_TURN[0], other.astype(np.float32), *given) for other in others])
    assert found[0] == 1
    assert found[1] == 0
    assert found[2] < 0.1  # they touch
    assert found[3] > 0.2
    assert found[4] > 0.7  # the other way round in the same place


def test_the_best_of_what_excludes_each_other_is_taken() -> None:
    score = np.float32([0.5, 0.9, 0.8, 0.99, 0.4])
    usable = np.array([True, True, True, False, True])
    excluded = np.zeros((5, 5), dtype=bool)
    for one, other in ((0, 1), (2, 4), (3, 1)):
        excluded[one, other] = excluded[other, one] = True
    rows = jnp.asarray(excluded)
    taken = jax.jit(lambda score: _greedy(score, jnp.asarray(usable), lambda row: rows[row])[0])
    np.testing.assert_array_equal(taken(score), [False, True, True, False, False])
    np.testing.assert_array_equal(taken(score * 0), [True, False, True, False, False])


def test_parts_too_far_apart_to_touch_are_two_also_if_all_that_is_known_of_one_is_its_inside() -> None:
    """From anywhere outside, a point is behind the nearest bit of a hollow ball, whose surface faces inwards."""
    order = np.random.default_rng(0).permutation(256)  # the first of a part's points are spread over all of it
    angle, height = order * 2.4, np.linspace(-0.99, 0.99, 256)[order]
    ring = np.sqrt(1 - height**2)
    ball = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1).astype(np.float32)
    hollow = replace(BOX, points=ball, normals=-ball, minimum=-np.ones(3), maximum=np.ones(3), diameter=2.0, area=12.6)
    score = np.array([0.9, 0.8])
    for away, both in ((2.6, True), (0.5, False)):
        found = chosen(np.stack([np.eye(4), moved(away, 0, 0)]), score, part=hollow)
        assert found.kept.tolist() == [True, both]


def test_nothing_is_in_a_part_beyond_a_thin_leg_of_which_only_two_points_are_known() -> None:
    """The nearest bits of what lies below the leg all face upwards: behind them it is not inside."""
    leg = np.array([[0.05, 0, -1.2], [-0.05, 0, -1.2]], dtype=np.float32)
    sides = np.array([[0.8, 0, 0.6], [-0.8, 0, 0.6]], dtype=np.float32)
    points, normals = np.concatenate([leg, BOX.points[2:]]), np.concatenate([sides, BOX.normals[2:]])
    spacing, below = np.float32((BOX.area / len(points)) ** 0.5), moved(0, 0, -2.4).astype(np.float32)
    assert shared(NO_TURN[0], below, points, normals, spacing, np.float32(0.1)) == 0
    legged = replace(BOX, points=points, normals=normals, minimum=points.min(axis=0))
    for away, both in ((0.4, False), (2.4, True)):
        found = chosen(np.stack([np.eye(4), moved(0, 0, -away)]), np.array([0.9, 0.8]), part=legged)
        assert found.kept.tolist() == [True, both]


def test_nothing_is_in_a_surface_of_one_side_but_within_its_box() -> None:
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 16), np.linspace(-0.5, 0.5, 16))
    cap = np.stack([x, y, 0.5 - x**2 - y**2], axis=-1).reshape(-1, 3).astype(np.float32)
    upwards = np.stack([2 * x, 2 * y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    known = cap, (upwards / np.linalg.norm(upwards, axis=1, keepdims=True)).astype(np.float32)
    block = np.float32(0.05) * BOX.points, BOX.normals
    for height, share in ((0.2, 1.0), (-0.5, 0.0)):
        place = moved(0, 0, height).astype(np.float32)
        assert inside(place, block, known, np.float32(0.1), np.float32(0.05)) == share


def test_nothing_is_in_a_part_beyond_its_hull_though_within_its_box() -> None:
    """Beyond a thin leg again, whose known bits face upwards; another leg reaches farther down on the other side."""
    legs = np.array([[1.05, 0, -1.2], [0.95, 0, -1.2], [-1.5, 0, -2.4]], dtype=np.float32)
    sides = np.array([[0.8, 0, 0.6], [-0.8, 0, 0.6], [0.7071, 0, -0.7071]], dtype=np.float32)
    known = np.concatenate([legs, BOX.points[3:]]), np.concatenate([sides, BOX.normals[3:]])
    block = np.float32(0.05) * (known[0] - known[0].mean(axis=0)), known[1]
    low, high = known[0].min(axis=0), known[0].max(axis=0)
    for at, share in (((0.9, 0, -2.0), 0.0), ((0, 0, 0), 1.0)):
        place, points = moved(*at).astype(np.float32), block[0] + np.array(at)
        assert ((points > low) & (points < high)).all()
        assert inside(place, block, known, np.float32(0.1), np.float32(0.05)) == share


def test_slender_parts_side_by_side_are_two() -> None:
    x, y, z = BOX.maximum - BOX.minimum
    assert same_place(BOX) == pytest.approx(min(0.2 * BOX.diameter, sorted((x, y, z))[1] / 2))
    along, angle = np.linspace(-0.5, 0.5, 256), np.arange(256) * 2.4
    round_ = np.stack([np.zeros(256), np.cos(angle), np.sin(angle)], axis=1)
    low = np.array([-0.5, -0.075, -0.075])
    rod = replace(
        BOX,
        points=(0.075 * round_ + along[:, None] * [1, 0, 0]).astype(np.float32),
        normals=round_.astype(np.float32),
        minimum=low,
        maximum=-low,
        diameter=1.01,
        area=0.47,
    )
    poses = np.stack([moved(0, 0.16 * row, 0) for row in range(3)]).astype(np.float32)
    assert chosen(poses, np.array([0.9, 0.8, 0.7]), part=rod).kept.all()


@pytest.mark.parametrize("first", [0, 1])
def test_one_pose_an_instance_is_kept_and_rivals_for_its_place_make_the_gap(first: int) -> None:
    there = moved(0, 0, 3)
    near = moved(0.02, 0, 3.01)
    crossed = there @ moved(0, 0.1, 0.1, rotation_about(Z, np.pi / 2))
    poses = np.stack([there, near, crossed, moved(0, 2.5, 3)]).astype(np.float32)
    score = np.array([0.9, 0.8, 0.7, 0.6])
    score[first] = 0.95
    found = chosen(poses, score)
    np.testing.assert_array_equal(found.kept, [first == 0, first == 1, False, True])
    np.testing.assert_allclose(found.gap[first], 0.95 - 0.7, rtol=1e-5)  # not the other form of itself
    np.testing.assert_allclose(found.gap[3], 0.6, rtol=1e-5)
    assert np.flatnonzero(found.rivalled & found.kept).tolist() == [first]
    assert not found.contenders.any()
    close = chosen(poses, score, contest=0.3)
    np.testing.assert_array_equal(close.contenders, [False, False, True, False])
    without = chosen(poses, score, np.array([False, False, False, True]))
    np.testing.assert_array_equal(without.kept, [False, False, False, True])


def test_of_turned_poses_in_one_place_the_exact_one_stands() -> None:
    # Both are right on average and the second a little more probable; only the first is right in all of its points.
    turned = moved(0, 0, 0, rotation_about(Z, np.pi / 2))
    names = ("on average", "everywhere")
    average, exact = Calibration(names, (1.0, 0.0), 2.0), Calibration(names, (0.0, 1.0), 0.0)
    poses, evidence = np.stack([np.eye(4), turned]).astype(np.float32), np.array([[1.0, 2.0], [1.1, -2.0]])
    nothing: Any = None  # what the network says of crops
    count, crop = np.zeros(2, dtype=np.int32), np.zeros(2, dtype=np.int64)
    found = Candidates(poses, np.ones(2, dtype=bool), evidence, count, crop, nothing, crop[:1])
    part, config = on_device(BOX), DetectConfig()
    assert choose_candidates(found, average, part, config).kept.tolist() == [False, True]
    by_exact = choose_candidates(found, average, part, config, exact)
    assert by_exact.kept.tolist() == [True, False]
    assert by_exact.gap[0] == pytest.approx(1 / (1 + np.exp(-2.0)) - 1 / (1 + np.exp(2.0)), abs=1e-6)
    doubted = Calibration(names, (0.0, 0.0), -5.0)  # what is not probable enough is not reported, however exact
    assert not choose_candidates(found, doubted, part, config, exact).kept.any()
