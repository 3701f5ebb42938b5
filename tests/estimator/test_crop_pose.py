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
from experiments.evaluation.cases import Case, ObjectImages, draw_cases
from experiments.evaluation.methods import padded
from experiments.evaluation.sources import bop_objects
from kmn_jax.estimator.candidates import arrays_of
from kmn_jax.estimator.crop_pose import CropPoseConfig, crop_for_draws, crop_pose, matches_of, said_of_draws
from kmn_jax.estimator.part import make_part
from kmn_jax.estimator.search import PartArrays, SceneArrays
from kmn_jax.models import Model, load_model, released_file
from kmn_jax.pose import PoseResult, adi, ransac

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
    said = jax.jit(said_of_draws, static_argnums=(0, 3))(network, part, crop, plain)
    first = jax.tree.map(lambda leaf: leaf[0], said)
    matches = matches_of(first, part, plain.matches)
    alone = ransac(jax.random.split(pose_key, 1)[0], matches, plain.ransac)
    assert alone.converged
    np.testing.assert_allclose(found.T_scene_object[:3, :3], alone.T_scene_object[:3, :3], atol=1e-3)
    shift = np.asarray(found.T_scene_object)[:3, 3] - np.asarray(crop.seed) - np.asarray(alone.T_scene_object)[:3, 3]
    assert np.linalg.norm(shift) < 1e-3 * float(part.diameter)


@pytest.mark.parametrize("count", [0, 1, 2, 5, 12])
def test_crops_of_next_to_nothing_have_no_pose(model: Model, part: PartArrays, count: int) -> None:
    points = np.zeros((16_384, 3), dtype=np.float32)
    points[:count] = np.random.default_rng(0).uniform(-5, 5, (count, 3)) + np.array([0, 0, 500])
    found = solve(model, part, SceneArrays(jnp.asarray(points), jnp.arange(len(points)) < count))
    assert not found.converged
    np.testing.assert_array_equal(found.T_scene_object, np.eye(4))
    assert found.num_inliers == 0


@pytest.mark.parametrize("values", [{"num_draws": 0}, {"num_modes": 0}, {"surface_points": 0}])
def test_settings_without_meaning_are_refused(values: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        CropPoseConfig(**values)  # type: ignore[arg-type]
