"""Poses that stand the wrong way round are told from the right one by all that was measured."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import Scene, make_scene
from kmn_jax.detection._disambiguation import _disambiguate_many, disambiguate, disambiguate_one
from kmn_jax.geometry import measured_points, pad_cloud
from kmn_jax.io import Scan
from kmn_jax.objects import Part
from kmn_jax.pose import mssd
from kmn_jax.simulate import RayMesh, render
from tests.detection.test_refinement import CAMERA, NO_RIVALS, TRUE, device_of, of_mesh, turns_of
from tests.reference.meshes import camera_scene, notched_box


@pytest.fixture(scope="module")
def part() -> Part:
    return of_mesh(notched_box())


def before_a_wall(share: float) -> Scene:
    """Return a scene of which such a share of the pixels is measured."""
    depth = render(RayMesh(*notched_box()), camera_scene([TRUE], CAMERA)).depth.astype(np.float32)
    depth = np.where(depth > 0, depth, 4.5).astype(np.float32)
    depth[np.random.default_rng(0).uniform(size=depth.shape) >= share] = 0
    points = measured_points(depth, CAMERA)
    return make_scene(Scan(points, None, depth, CAMERA, "m"), 1.0, inside=np.ones(len(points), dtype=bool))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return before_a_wall(1.0)


@pytest.mark.parametrize("share", [1.0, 0.1])
def test_a_pose_the_wrong_way_round_is_told(part: Part, share: float) -> None:
    turns, is_rival = turns_of(part)
    shown = before_a_wall(share)
    true = TRUE.astype(np.float32)
    starts = np.stack([true, *(TRUE @ np.linalg.inv(turn) for turn in turns[is_rival])]).astype(np.float32)
    found, is_other = disambiguate(starts, device_of(part, is_rival), shown.cloud, shown.image)
    np.testing.assert_array_equal(found[0], true)
    assert is_other.tolist() == [False] + [True] * (len(starts) - 1)
    apart = [float(mssd(pose, true, part.points[:300])) for pose in found]
    assert max(apart) < 0.02 * part.diameter


def test_what_nothing_speaks_against_stays(part: Part, scene: Scene) -> None:
    turns, is_rival = turns_of(part)
    start = (TRUE @ np.linalg.inv(turns[0])).astype(np.float32)
    behind = start.copy()
    behind[2, 3] *= -1
    nothing = pad_cloud(np.zeros((0, 3), np.float32)), scene.image._replace(depth=jnp.zeros_like(scene.image.depth))
    for pose, rivals, (cloud, image) in (
        (start, NO_RIVALS, (scene.cloud, scene.image)),
        (start, is_rival, nothing),
        (behind, is_rival, (scene.cloud, scene.image)),
    ):
        found, is_other = disambiguate_one(pose, device_of(part, rivals), cloud, image)
        np.testing.assert_array_equal(found, pose)
        assert not is_other
    unchanged, others = disambiguate(start[None], device_of(part), scene.cloud, scene.image)
    np.testing.assert_array_equal(unchanged, start[None])
    assert not others.any()
    none, _ = disambiguate(start[None][:0], device_of(part, is_rival), scene.cloud, scene.image)
    assert none.shape == (0, 4, 4)


def test_many_are_told_as_each_is(part: Part, scene: Scene) -> None:
    turns, is_rival = turns_of(part)
    starts = np.stack([TRUE, TRUE @ np.linalg.inv(turns[0])]).astype(np.float32)
    given = device_of(part, is_rival), scene.cloud, scene.image
    found, others = disambiguate(starts, *given)
    many, which = _disambiguate_many(starts, *given)
    assert others.tolist() == np.asarray(which).tolist() == [False, True]
    np.testing.assert_allclose(many, found, atol=1e-4 * part.diameter)
