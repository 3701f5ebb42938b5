"""Examples from a pack's scenes and from crops made before: clouds, keypoints and labels against plain NumPy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.data import (
    CropConfig,
    DevicePack,
    LabelledCrop,
    Pack,
    StackedPack,
    draw_crop,
    stack_pack,
    take_scene,
    visible_points,
)
from kmn_jax.errors import InputError
from kmn_jax.geometry import SmoothConfig
from kmn_jax.models import KeyMatchNetConfig
from kmn_jax.simulate import FaultConfig, WorldConfig
from kmn_jax.train import ExampleConfig
from kmn_jax.train._examples import Group, RenderedCrops, make_group
from tests.reference.meshes import pose, random_rotations

PACK = Path(__file__).parent.parent.parent / "experiments" / "assets" / "small_pack"
NETWORK = KeyMatchNetConfig(num_scene_points=64, num_object_points=96, num_keypoints=6)
CONFIG = ExampleConfig(crops=CropConfig(num_points=64, normals="surface"))
make = jax.jit(make_group, static_argnames=("network", "config"))


@pytest.fixture(scope="module")
def stacked() -> StackedPack:
    return stack_pack(Pack(PACK), "train")


def keys(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2**32, (count, 2), dtype=np.uint32)


def group(stacked: StackedPack, seed: int, config: ExampleConfig, count: int = 4) -> Group:
    drops = np.arange(count, dtype=np.int32)
    found: Group = make(stacked.arrays, np.int32(1), drops, keys(seed, count), NETWORK, config)
    return found


def test_a_network_of_one_object_has_the_same_keypoints_whatever_is_drawn(stacked: StackedPack) -> None:
    network = replace(NETWORK, object_branch="learned")
    drops = np.arange(4, dtype=np.int32)
    for seed in range(3):
        found: Group = make(stacked.arrays, np.int32(1), drops, keys(seed, 4), network, CONFIG)
        np.testing.assert_array_equal(found.keypoint_indices, np.arange(6))
        own = group(stacked, seed, CONFIG)
        # What is drawn of the scenes is the same; programs that differ may round it differently.
        np.testing.assert_allclose(found.crops, own.crops, rtol=0, atol=1e-6)
        assert (np.asarray(found.keypoint) < 6).all()


def no_crops(count: int) -> RenderedCrops:
    nothing = np.zeros((count, 64), dtype=bool)
    flat = np.zeros((count, 64, 3), dtype=np.float32)
    return RenderedCrops(
        flat, flat, nothing, nothing, np.tile(np.eye(4, dtype=np.float32), (count, 1, 1)), nothing[:, 0]
    )


def cloud_alone(arrays: DevicePack, seed: int, config: ExampleConfig) -> Group:
    """Return a group without scenes, which take longest to compile."""
    found: Group = make(arrays, np.int32(1), np.zeros(1, np.int32), keys(seed, 1), NETWORK, config, no_crops(1))
    return found


def distances(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points[None], axis=2)


def farthest(points: np.ndarray, count: int) -> list[int]:
    rows = [0]
    for _ in range(count - 1):
        rows.append(int(distances(points)[:, rows].min(axis=1).argmax()))
    return rows


def test_plain_examples_have_the_first_surfels_and_farthest_keypoints(stacked: StackedPack) -> None:
    found = group(stacked, 0, CONFIG.plain())
    points, normals = (np.asarray(array)[1, :96] for array in (stacked.arrays.points, stacked.arrays.normals))
    np.testing.assert_array_equal(found.cloud, np.concatenate([points, normals], axis=1))
    assert np.asarray(found.keypoint_indices).tolist() == farthest(points, 6)
    assert float(found.length) == stacked.arrays.diameter[1]
    assert found.crops.shape == (4, 64, 6)
    assert np.asarray(found.valid).all()
    np.testing.assert_allclose(np.linalg.norm(np.asarray(found.crops)[:, 0, :3], axis=1), 0, atol=1e-7)
    # Labels are the nearest of these keypoints in the pose of the seed's copy, which the crop itself is drawn with.
    keypoints = np.asarray(found.cloud)[np.asarray(found.keypoint_indices), :3]

    @jax.jit
    def drawn(key: jax.Array, keypoints: jax.Array) -> LabelledCrop:
        scene = take_scene(stacked.arrays, jnp.int32(1), jnp.int32(2))
        key = jax.random.fold_in(jax.random.wrap_key_data(key), 0)
        poses, diameter = scene.T_camera_object, scene.diameter
        return draw_crop(key, visible_points(scene), keypoints, poses, diameter, config=CONFIG.plain().crops)

    made = drawn(keys(0, 4)[2], keypoints)
    np.testing.assert_allclose(np.asarray(found.crops)[2, :, :3], made.points, atol=1e-7)
    inside = np.asarray(made.points) - np.asarray(made.T_crop_object)[:3, 3]
    points_object = inside @ np.asarray(made.T_crop_object)[:3, :3]
    apart = np.linalg.norm(points_object[:, None] - keypoints[None], axis=2)
    on_object = np.asarray(found.is_object)[2]
    assert on_object.sum() > 5
    chosen = apart[np.arange(64), np.asarray(found.keypoint)[2]]
    np.testing.assert_allclose(chosen[on_object], apart.min(axis=1)[on_object], atol=1e-6)


def test_augmented_clouds_are_moved_by_a_rigid_motion_and_noise(stacked: StackedPack) -> None:
    # With as many surfels as points, which surfel a point is, is known.
    few = stacked.arrays._replace(points=stacked.arrays.points[:, :96], normals=stacked.arrays.normals[:, :96])
    surfels, diameter = np.asarray(few.points)[1], float(few.diameter[1])

    clean, noisy = (np.asarray(cloud_alone(few, 1, replace(CONFIG, object_noise=x)).cloud) for x in (0.0, 0.05))
    np.testing.assert_allclose(distances(clean[:, :3]), distances(surfels), atol=1e-5 * diameter)
    rotation = np.linalg.lstsq(surfels - surfels.mean(axis=0), clean[:, :3] - clean[:, :3].mean(axis=0))[0]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    assert np.abs(rotation - np.eye(3)).max() > 0.1
    np.testing.assert_allclose(clean[:, 3:], np.asarray(few.normals)[1] @ rotation, atol=1e-4)
    shift = clean[:, :3].mean(axis=0) - surfels.mean(axis=0) @ rotation
    assert 0 < np.linalg.norm(shift) <= 0.1 * diameter * 3**0.5
    moved = (noisy - clean)[:, :3]
    assert 0 < np.abs(moved).max() <= 3 * 0.05 * diameter
    np.testing.assert_array_equal(noisy[:, 3:], clean[:, 3:])


def test_keypoints_are_random_in_the_configured_share(stacked: StackedPack) -> None:
    always, never = (cloud_alone(stacked.arrays, 2, replace(CONFIG, random_keypoints=x)) for x in (1.0, 0.0))

    def least_distance(found: Group) -> float:
        apart = distances(np.asarray(found.cloud)[np.asarray(found.keypoint_indices), :3])
        return float(apart[~np.eye(6, dtype=bool)].min())

    assert least_distance(never) > least_distance(always)
    assert len(set(np.asarray(always.keypoint_indices).tolist())) == 6


def test_crops_of_one_scene_are_those_of_its_keys(stacked: StackedPack) -> None:
    shared = np.asarray(group(stacked, 3, replace(CONFIG, crops_per_scene=2)).crops)
    alone = np.asarray(group(stacked, 3, CONFIG).crops)
    for row in (0, 2):  # programs that differ may round differently
        np.testing.assert_allclose(shared[row], alone[row], rtol=0, atol=1e-6)
    assert not np.allclose(shared[1], alone[1], atol=1e-3)  # of the scene before
    assert not np.allclose(shared[0], shared[1], atol=1e-3)


def test_labels_of_rendered_crops_are_the_nearest_keypoints(stacked: StackedPack) -> None:
    rng = np.random.default_rng(4)
    diameter = float(stacked.arrays.diameter[2])
    poses = np.stack([pose((0.01, 0.02, 0.3), R) for R in random_rotations(2, 5)]).astype(np.float32)
    surfels = np.asarray(stacked.arrays.points)[2][rng.integers(0, 4096, (2, 64))]
    points = np.einsum("bij,bnj->bni", poses[:, :3, :3], surfels) + poses[:, None, :3, 3]
    rendered = RenderedCrops(
        points=points.astype("f4"),
        normals=np.zeros((2, 64, 3), dtype="f4"),
        mask=np.ones((2, 64), dtype=bool),
        is_object=np.ones((2, 64), dtype=bool),
        T_crop_object=poses,
        valid=np.array([True, False]),
    )
    empty = stacked.arrays._replace(T_camera_object=np.zeros((4, 0, 0, 4, 4), dtype=np.float32))
    drops = np.zeros(2, dtype=np.int32)
    found: Group = make(empty, np.int32(2), drops, keys(5, 2), NETWORK, CONFIG.plain(), rendered)
    keypoints = np.asarray(stacked.arrays.points)[2, :96][np.asarray(found.keypoint_indices)]
    apart = np.linalg.norm(surfels[:, :, None] - keypoints[None, None], axis=3)
    least = apart.min(axis=2)
    chosen = np.take_along_axis(apart, np.asarray(found.keypoint)[..., None], axis=2)[..., 0]
    np.testing.assert_allclose(chosen, least, atol=1e-5 * diameter)
    np.testing.assert_array_equal(found.valid, [True, False])
    np.testing.assert_array_equal(np.asarray(found.crops)[..., :3], rendered.points)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"random_keypoints": 1.5}, "must be between 0 and 1"),
        ({"object_noise": -0.1}, "must not be < 0"),
        ({"crops_per_scene": 0}, "must be at least 1"),
    ],
)
def test_values_that_make_no_sense_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ExampleConfig(**values)


def test_a_pack_of_too_few_surfels_is_refused(stacked: StackedPack) -> None:
    network = replace(NETWORK, num_object_points=8192)
    with pytest.raises(InputError, match="the pack has 4096 surfels an object, but num_object_points = 8192"):
        make_group(
            stacked.arrays, jnp.int32(0), jnp.zeros(1, dtype=jnp.int32), jnp.asarray(keys(0, 1)), network, CONFIG
        )


def test_worlds_make_crops_of_copies_and_of_none() -> None:
    stacked = stack_pack(Pack(PACK), "train", scenes=False)
    assert stacked.arrays.T_camera_object.shape[1] == 0
    crops = CropConfig(num_points=64, normal_points=256, other_seeds=0.5, faults=FaultConfig(), smooth=SmoothConfig())
    worlds = WorldConfig(background_points=2048, resolution=128)
    config = replace(CONFIG, crops=crops, crops_per_scene=4, worlds=worlds)
    shares = []
    for seed in range(6):
        found = group(stacked, seed, config)
        assert all(np.isfinite(leaf).all() for leaf in found)
        valid = np.asarray(found.valid)
        on_copy = np.asarray(found.is_object)
        # The seed is the first point: on a copy, or nothing of the crop is.
        np.testing.assert_array_equal(on_copy[valid].any(axis=1), on_copy[valid, 0])
        shares += on_copy[valid, 0].tolist()
    assert len(shares) >= 16
    assert 0.1 < np.mean(shares) < 0.9
