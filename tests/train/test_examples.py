"""Examples from a pack's scenes and from crops made before: clouds, keypoints and labels against plain NumPy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.data import CropConfig, Pack, StackedPack, draw_crop, stack_pack, take_scene, visible_points
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


def keys(seed: int, count: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).integers(0, 2**32, (count, 2), dtype=np.uint32))


def group(stacked: StackedPack, seed: int, config: ExampleConfig, count: int = 4) -> Group:
    drops = jnp.arange(count, dtype=jnp.int32)
    found: Group = make(stacked.arrays, jnp.int32(1), drops, keys(seed, count), NETWORK, config)
    return found


def test_a_network_of_one_object_has_the_same_keypoints_whatever_is_drawn(stacked: StackedPack) -> None:
    network = replace(NETWORK, object_branch="learned")
    drops = jnp.arange(4, dtype=jnp.int32)
    for seed in range(3):
        found: Group = make(stacked.arrays, jnp.int32(1), drops, keys(seed, 4), network, CONFIG)
        np.testing.assert_array_equal(found.keypoint_indices, np.arange(6))
        own = group(stacked, seed, CONFIG)
        # What is drawn of the scenes is the same; programs that differ may round it differently.
        np.testing.assert_allclose(found.crops, own.crops, rtol=0, atol=1e-6)
        assert (np.asarray(found.keypoint) < 6).all()


def no_crops(count: int) -> RenderedCrops:
    nothing = jnp.zeros((count, 64), dtype=bool)
    flat = jnp.zeros((count, 64, 3))
    return RenderedCrops(flat, flat, nothing, nothing, jnp.tile(jnp.eye(4)[None], (count, 1, 1)), nothing[:, 0])


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
    assert list(found.keypoint_indices) == farthest(points, 6)
    assert float(found.length) == stacked.arrays.diameter[1]
    assert found.crops.shape == (4, 64, 6)
    assert bool(found.valid.all())
    np.testing.assert_allclose(np.linalg.norm(np.asarray(found.crops)[:, 0, :3], axis=1), 0, atol=1e-7)
    # Labels are the nearest of these keypoints in the pose of the seed's copy, which the crop itself is drawn with.
    keypoints = jnp.asarray(found.cloud)[found.keypoint_indices, :3]
    scene = take_scene(stacked.arrays, jnp.int32(1), jnp.int32(2))
    key = jax.random.fold_in(jax.random.wrap_key_data(keys(0, 4)[2]), 0)
    made = jax.jit(draw_crop, static_argnames="config")(
        key, visible_points(scene), keypoints, scene.T_camera_object, scene.diameter, config=CONFIG.plain().crops
    )
    np.testing.assert_allclose(found.crops[2, :, :3], made.points, atol=1e-7)
    inside = np.asarray(made.points) - np.asarray(made.T_crop_object)[:3, 3]
    points_object = inside @ np.asarray(made.T_crop_object)[:3, :3]
    apart = np.linalg.norm(points_object[:, None] - np.asarray(keypoints)[None], axis=2)
    on_object = np.asarray(found.is_object)[2]
    assert on_object.sum() > 5
    chosen = apart[np.arange(64), np.asarray(found.keypoint)[2]]
    np.testing.assert_allclose(chosen[on_object], apart.min(axis=1)[on_object], atol=1e-6)


def test_augmented_clouds_are_moved_by_a_rigid_motion_and_noise(stacked: StackedPack) -> None:
    # With as many surfels as points, which surfel a point is, is known.
    few = stacked.arrays._replace(points=stacked.arrays.points[:, :96], normals=stacked.arrays.normals[:, :96])
    surfels, diameter = np.asarray(few.points)[1], float(few.diameter[1])

    def cloud(object_noise: float) -> np.ndarray:
        config = replace(CONFIG, object_noise=object_noise)
        drops = jnp.zeros(1, dtype=jnp.int32)
        found: Group = make(few, jnp.int32(1), drops, keys(1, 1), NETWORK, config, no_crops(1))
        return np.asarray(found.cloud)

    clean, noisy = cloud(0.0), cloud(0.05)
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
    always = group(stacked, 2, replace(CONFIG, random_keypoints=1.0))
    never = group(stacked, 2, replace(CONFIG, random_keypoints=0.0))

    def least_distance(found: Group) -> float:
        apart = distances(np.asarray(found.cloud)[np.asarray(found.keypoint_indices), :3])
        return float(apart[~np.eye(6, dtype=bool)].min())

    assert least_distance(never) > least_distance(always)
    assert len(set(np.asarray(always.keypoint_indices).tolist())) == 6


def test_crops_of_one_scene_are_those_of_its_keys(stacked: StackedPack) -> None:
    shared = group(stacked, 3, replace(CONFIG, crops_per_scene=2))
    alone = group(stacked, 3, CONFIG)
    for row in (0, 2):  # programs that differ may round differently
        np.testing.assert_allclose(shared.crops[row], alone.crops[row], rtol=0, atol=1e-6)
    assert not np.allclose(shared.crops[1], alone.crops[1], atol=1e-3)  # of the scene before
    assert not np.allclose(shared.crops[0], shared.crops[1], atol=1e-3)


def test_labels_of_rendered_crops_are_the_nearest_keypoints(stacked: StackedPack) -> None:
    rng = np.random.default_rng(4)
    diameter = float(stacked.arrays.diameter[2])
    poses = np.stack([pose((0.01, 0.02, 0.3), R) for R in random_rotations(2, 5)]).astype(np.float32)
    surfels = np.asarray(stacked.arrays.points)[2][rng.integers(0, 4096, (2, 64))]
    points = np.einsum("bij,bnj->bni", poses[:, :3, :3], surfels) + poses[:, None, :3, 3]
    rendered = RenderedCrops(
        points=jnp.asarray(points, "f4"),
        normals=jnp.zeros((2, 64, 3)),
        mask=jnp.ones((2, 64), dtype=bool),
        is_object=jnp.ones((2, 64), dtype=bool),
        T_crop_object=jnp.asarray(poses),
        valid=jnp.array([True, False]),
    )
    empty = stacked.arrays._replace(T_camera_object=np.zeros((4, 0, 0, 4, 4), dtype=np.float32))
    drops = jnp.zeros(2, dtype=jnp.int32)
    found: Group = make(empty, jnp.int32(2), drops, keys(5, 2), NETWORK, CONFIG.plain(), rendered)
    keypoints = np.asarray(stacked.arrays.points)[2, :96][np.asarray(found.keypoint_indices)]
    apart = np.linalg.norm(surfels[:, :, None] - keypoints[None, None], axis=3)
    least = apart.min(axis=2)
    chosen = np.take_along_axis(apart, np.asarray(found.keypoint)[..., None], axis=2)[..., 0]
    np.testing.assert_allclose(chosen, least, atol=1e-5 * diameter)
    np.testing.assert_array_equal(found.valid, [True, False])
    np.testing.assert_array_equal(found.crops[..., :3], rendered.points)


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
        make_group(stacked.arrays, jnp.int32(0), jnp.zeros(1, dtype=jnp.int32), keys(0, 1), network, CONFIG)


def test_worlds_make_crops_of_copies_and_of_none() -> None:
    stacked = stack_pack(Pack(PACK), "train", scenes=False)
    assert stacked.arrays.T_camera_object.shape[1] == 0
    crops = CropConfig(num_points=64, normal_points=256, other_seeds=0.5, faults=FaultConfig(), smooth=SmoothConfig())
    worlds = WorldConfig(background_points=2048, resolution=128)
    config = replace(CONFIG, crops=crops, crops_per_scene=4, worlds=worlds)
    shares = []
    for seed in range(6):
        found = group(stacked, seed, config)
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in found)
        valid = np.asarray(found.valid)
        on_copy = np.asarray(found.is_object)
        # The seed is the first point: on a copy, or nothing of the crop is.
        np.testing.assert_array_equal(on_copy[valid].any(axis=1), on_copy[valid, 0])
        shares += on_copy[valid, 0].tolist()
    assert len(shares) >= 16
    assert 0.1 < np.mean(shares) < 0.9
