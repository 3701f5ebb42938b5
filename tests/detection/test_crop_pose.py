"""One crop to one pose: the released network on real crops, determinism, units, and crops of nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import experiments
import kmn_jax.detection._crop_pose as crop_pose_module
from experiments.evaluation.cases import Case, ObjectImages, draw_cases, padded
from experiments.evaluation.sources import bop_objects
from kmn_jax.detection import (
    CropPoseConfig,
    SceneArrays,
    crop_for_draws,
    crop_pose,
    draw_of_crop,
    matches_of,
    said_of_draw,
    search_draws,
)
from kmn_jax.models import Model, load_model, released_file
from kmn_jax.objects import PartArrays, arrays_of, make_part
from kmn_jax.pose import PoseResult, PoseStatus, adi, ransac

SMALL = Path(experiments.__file__).parent / "assets" / "small_test_set"
CONFIG = CropPoseConfig(num_draws=2, num_modes=2)


@pytest.fixture(scope="module")
def gear() -> ObjectImages:
    found = bop_objects(SMALL, "test", pytest.fail, most_images=2)
    return next(one for one in found if one.name == "gear_motor")


@pytest.fixture(scope="module")
def cases(gear: ObjectImages) -> list[Case]:
    return list(draw_cases(gear, 6, 0.0))


@pytest.fixture(scope="module")
def model() -> Model:
    return load_model(released_file("small"))


@pytest.fixture(scope="module")
def part(model: Model, gear: ObjectImages) -> PartArrays:
    return arrays_of(model, make_part(gear.model, model))


def solve(model: Model, part: PartArrays, scene: SceneArrays, config: CropPoseConfig = CONFIG) -> PoseResult:
    found = crop_pose(model.graphdef, model.parameters, part, scene, jax.random.key(0), 512, config)
    return jax.device_get(found)


def test_parts_are_found_where_they_lie(model: Model, part: PartArrays, cases: list[Case], gear: ObjectImages) -> None:
    right = 0
    for case in cases:
        found = solve(model, part, padded(case.points))
        errors = [float(adi(found.T_scene_object, pose, gear.model.points[:500])) for pose in case.T_camera_object]
        right += bool(found.converged) and min(errors) < 0.1 * gear.model.diameter
    assert right >= 4


def test_the_same_key_gives_the_same_bits(model: Model, part: PartArrays, cases: list[Case]) -> None:
    one, other = (solve(model, part, padded(cases[0].points)) for _ in range(2))
    np.testing.assert_array_equal(one.T_scene_object, other.T_scene_object)


def test_a_larger_capacity_gives_the_same_pose_and_compiles_the_crop_alone(
    model: Model, part: PartArrays, cases: list[Case]
) -> None:
    scene = padded(cases[0].points)
    larger = jax.tree.map(lambda leaf: jnp.concatenate([leaf, jnp.zeros_like(leaf)]), scene)
    one = solve(model, part, scene)
    before = crop_pose_module._pose_in_crop._cache_size(), crop_pose_module._crop._cache_size()
    other = solve(model, part, larger)
    after = crop_pose_module._pose_in_crop._cache_size(), crop_pose_module._crop._cache_size()
    np.testing.assert_array_equal(one.T_scene_object, other.T_scene_object)
    assert after == (before[0], before[1] + 1)


def test_metres_and_millimetres_give_one_pose(model: Model, part: PartArrays, cases: list[Case]) -> None:
    small = part._replace(points=part.points * 1e-3, diameter=part.diameter * 1e-3)
    one = solve(model, part, padded(cases[0].points))
    other = solve(model, small, padded(cases[0].points * np.float32(1e-3)))
    # Rounding may choose other triplets: the poses are the same to a gate's share, not to the digit.
    scaled = np.array(other.T_scene_object)
    scaled[:3, 3] *= 1e3
    assert float(adi(scaled, one.T_scene_object, part.points)) < 0.05 * float(part.diameter)


def test_one_draw_and_one_pose_are_the_published_search(model: Model, part: PartArrays, cases: list[Case]) -> None:
    plain, scene, key = replace(CONFIG, num_draws=1, num_modes=1), padded(cases[0].points), jax.random.key(0)
    found = solve(model, part, scene, plain)
    _, pose_key = jax.random.split(key)
    network = nnx.merge(model.graphdef, model.parameters)
    crop = jax.jit(crop_for_draws, static_argnums=(3, 4))(part, scene, key, 512, plain)
    said = jax.jit(lambda crop: said_of_draw(network, part, draw_of_crop(crop, 0, part.diameter, 512, plain)))(crop)
    matches = matches_of(said, part, plain.matches)
    alone = ransac(jax.random.split(pose_key, 1)[0], matches, plain.ransac)
    assert alone.converged
    np.testing.assert_allclose(found.T_scene_object[:3, :3], alone.T_scene_object[:3, :3], atol=1e-3)
    shift = np.asarray(found.T_scene_object)[:3, 3] - np.asarray(crop.seed) - np.asarray(alone.T_scene_object)[:3, 3]
    assert np.linalg.norm(shift) < 1e-3 * float(part.diameter)


def test_no_more_draws_are_made_than_it_takes(model: Model, part: PartArrays, cases: list[Case]) -> None:
    config, scene, key = replace(CONFIG, num_draws=3), padded(cases[0].points), jax.random.key(0)
    network = nnx.merge(model.graphdef, model.parameters)
    crop = jax.jit(crop_for_draws, static_argnums=(3, 4))(part, scene, key, 512, config)
    search = jax.jit(search_draws, static_argnums=(0, 4, 5))
    all_draws, one, none = (
        search(network, part, crop, key, 512, replace(config, enough=enough)) for enough in (None, -9.0, 9.0)
    )
    assert [int(found.num_draws) for found in (all_draws, one, none)] == [3, 1, 3]
    assert [int(jnp.isfinite(found.scores).any(axis=1).sum()) for found in (all_draws, one, none)] == [3, 1, 3]
    # Programs that differ round differently.
    poses = [found.poses.T_scene_object for found in (all_draws, none, one)]
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-3)
    np.testing.assert_allclose(poses[2][0], poses[0][0], atol=1e-3)
    np.testing.assert_array_equal(one.said.points[0], all_draws.said.points[0])
    for leaf in jax.tree.leaves((one.said, one.poses)):
        np.testing.assert_array_equal(leaf[1:], np.zeros_like(leaf[1:]))


@pytest.mark.parametrize("num_draws", [1, 3, 7, 11])
@pytest.mark.parametrize("count", [2, 40, 63, 64, 65, 190, 441, 442, 443, 694, 695, 3000])
def test_draws_are_full_and_share_but_the_seed_if_they_can(part: PartArrays, num_draws: int, count: int) -> None:
    room = 63  # beside the seed
    size = float(part.diameter) / 4
    grid = np.linspace(-size, size, count, dtype=np.float32)
    points = np.zeros((4096, 3), dtype=np.float32)
    points[:count] = np.stack([grid, np.zeros(count), np.full(count, 500)], axis=1)
    points[[0, count // 2]] = points[[count // 2, 0]]
    scene = SceneArrays(jnp.asarray(points), jnp.arange(len(points)) < count)
    config = replace(CONFIG, num_draws=num_draws)
    crop = jax.jit(crop_for_draws, static_argnums=(3, 4))(part, scene, jax.random.key(0), room + 1, config)
    draw = jax.jit(draw_of_crop, static_argnums=(3, 4))
    draws = [draw(crop, number, part.diameter, room + 1, config) for number in range(num_draws)]
    taken = [np.asarray(one.points[one.mask][:, 0]) for one in draws]
    for one, values in zip(draws, taken, strict=True):
        assert values[0] == 0
        assert len(np.unique(values)) == len(values) == min(count, room + 1)
        assert np.ptp(values) > (1.8 if count > 2 else 0.9) * size
        np.testing.assert_allclose(np.linalg.norm(one.normals, axis=1), one.mask, atol=1e-5)
    others = np.concatenate([values[1:] for values in taken])
    if count - 1 >= num_draws * room:
        assert len(np.unique(others)) == num_draws * room
    else:
        assert len(np.unique(others)) <= count - 1


@pytest.mark.parametrize("count", [0, 1, 2, 5, 12])
def test_crops_of_next_to_nothing_have_no_pose(model: Model, part: PartArrays, count: int) -> None:
    points = np.zeros((16_384, 3), dtype=np.float32)
    points[:count] = np.random.default_rng(0).uniform(-5, 5, (count, 3)) + np.array([0, 0, 500])
    found = solve(model, part, SceneArrays(jnp.asarray(points), jnp.arange(len(points)) < count))
    assert not found.converged
    np.testing.assert_array_equal(found.T_scene_object, np.eye(4))
    assert found.num_inliers == 0
    assert found.status != PoseStatus.OK


@pytest.mark.parametrize("values", [{"num_draws": 0}, {"num_modes": 0}, {"surface_points": 0}, {"enough": np.nan}])
def test_settings_without_meaning_are_refused(values: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        CropPoseConfig(**values)  # type: ignore[arg-type]
