"""One crop to one pose: the released network on real crops, determinism, units, and crops of nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import experiments
from experiments.evaluation.cases import Case, ObjectImages, draw_cases, padded
from experiments.evaluation.methods import Ours
from experiments.evaluation.sources import bop_objects
from kmn_jax.detection import (
    CropSearchConfig,
    DetectConfig,
    ForegroundOptions,
    PoseEstimator,
    SearchConfig,
    draw_of_crop,
    matches_of,
    poses_at,
    predict,
    search_draws,
)
from kmn_jax.detection._crop_search import (
    DrawsSearch,
    crop_of_scene,
    draws_in_turn,
    draws_side_by_side,
    find_poses_in_crop,
)
from kmn_jax.errors import InputError
from kmn_jax.geometry import PaddedCloud
from kmn_jax.models import KeyMatchNet, Model, load_model, released_file
from kmn_jax.objects import PartArrays, arrays_of, make_part
from kmn_jax.pose import IcpConfig, PoseResult, PoseStatus, adi, ransac

SMALL = Path(experiments.__file__).parent / "assets" / "small_test_set"
CONFIG = CropSearchConfig(num_points=512, num_draws=2, num_modes=2, icp=None)
REFINED = IcpConfig(iterations=8)
SEARCH = jax.jit(search_draws, static_argnums=(0, 4))


@pytest.fixture(scope="module")
def gear() -> ObjectImages:
    found = bop_objects(SMALL, "test", pytest.fail, most_images=2)
    return next(one for one in found if one.name == "gear_motor")


@pytest.fixture(scope="module")
def cases(gear: ObjectImages) -> list[Case]:
    return list(draw_cases(gear, 6, 0.0))


@pytest.fixture(scope="module")
def model() -> Model:
    return load_model(released_file())


@pytest.fixture(scope="module")
def network(model: Model) -> KeyMatchNet:
    """Return one network for all tests: programs are of this very one."""
    return nnx.merge(model.graphdef, model.parameters)


@pytest.fixture(scope="module")
def part(model: Model, gear: ObjectImages) -> PartArrays:
    return arrays_of(model, make_part(gear.model, model))


def solve(model: Model, part: PartArrays, cloud: PaddedCloud, config: CropSearchConfig = CONFIG) -> PoseResult:
    """Return the best pose."""
    found = jax.device_get(poses_at(model, part, cloud, 0, 0, config))
    best: PoseResult = jax.tree.map(lambda leaf: leaf[0], found.poses)
    return best


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
    before = find_poses_in_crop.compiled._cache_size(), crop_of_scene.compiled._cache_size()
    other = solve(model, part, larger)
    after = find_poses_in_crop.compiled._cache_size(), crop_of_scene.compiled._cache_size()
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


def test_the_evaluation_and_detection_at_a_point_have_one_pose(
    model: Model, cases: list[Case], gear: ObjectImages
) -> None:
    usual = DetectConfig().search_of(model.config, at_places=True).crops
    assert Ours("ours", model).config.of_network(model.config) == usual
    crops = replace(CONFIG, icp=REFINED)
    estimator = PoseEstimator.from_pretrained(config=DetectConfig(search=SearchConfig(crops=crops)))
    part, everything = make_part(gear.model, model), ForegroundOptions(remove_plane="never")
    solver, compared = Ours("ours", model, crops).prepare(gear.model), 0
    for case in cases[:3]:
        evaluated = solver(case)
        found = estimator.detect(
            part,
            case.points,
            at=case.points[0],
            unit="mm",
            background=everything,
            random_seed=case.random_seed,
        )
        if found.poses:
            assert evaluated is not None
            # Detections are proper rigid poses in float64, which float32 is but to rounding.
            np.testing.assert_allclose(found.poses[0].T_scene_object, evaluated, atol=1e-4)
            compared += 1
    assert compared >= 2


def test_one_draw_and_one_pose_are_the_published_search(
    model: Model, network: KeyMatchNet, part: PartArrays, cases: list[Case]
) -> None:
    plain, key = replace(CONFIG, num_draws=1, num_modes=1, num_poses=1), jax.random.key(0)
    crop = crop_of_scene(padded(cases[0].points), 0, part.diameter, key, plain)
    found = jax.device_get(find_poses_in_crop(*model, part, crop, key, plain)).poses
    prediction = jax.jit(lambda crop: predict(network, part, draw_of_crop(crop, 0, part.diameter, plain)))(crop)
    matches = matches_of(prediction, part, plain.matches)
    alone = ransac(jax.random.split(key, 1)[0], matches, plain.ransac)
    assert alone.converged
    pose = found.T_scene_object[0]
    np.testing.assert_allclose(pose[:3, :3], alone.T_scene_object[:3, :3], atol=1e-3)
    shift = pose[:3, 3] - np.asarray(crop.seed) - np.asarray(alone.T_scene_object)[:3, 3]
    assert np.linalg.norm(shift) < 1e-3 * float(part.diameter)


def test_poses_differ_the_best_first_and_are_refined(model: Model, part: PartArrays, cases: list[Case]) -> None:
    case = cases[1]  # ICP leaves the pose of the first one as it is, where it found no better one
    rough, fine = (
        jax.device_get(poses_at(model, part, padded(case.points), 0, 0, replace(CONFIG, icp=icp)))
        for icp in (None, REFINED)
    )
    there = rough.poses.converged
    assert there[0]
    assert (np.diff(rough.scores[there]) <= 0).all()
    surface = np.asarray(part.points)
    placed = [surface @ pose[:3, :3].T + pose[:3, 3] for pose in rough.poses.T_scene_object[there]]
    for row, one in enumerate(placed):
        for other in placed[:row]:
            assert np.linalg.norm(one - other, axis=1).max() > CONFIG.distinct * float(part.diameter)
    np.testing.assert_array_equal(fine.scores, rough.scores)
    moved = np.abs(fine.poses.T_scene_object - rough.poses.T_scene_object)[there].max(axis=(1, 2))
    assert moved[0] > 0  # a lesser pose may have nothing near it that ICP could pair
    truth = min(float(adi(fine.poses.T_scene_object[0], pose, surface)) for pose in case.T_camera_object)
    before = min(float(adi(rough.poses.T_scene_object[0], pose, surface)) for pose in case.T_camera_object)
    assert truth < before + 0.01 * float(part.diameter)


@pytest.mark.usefixtures("all_optimisations")
def test_no_more_draws_are_made_than_it_takes(network: KeyMatchNet, part: PartArrays, cases: list[Case]) -> None:
    config, key = replace(CONFIG, num_draws=3), jax.random.key(0)
    crop = crop_of_scene(padded(cases[0].points), 0, part.diameter, key, config)
    one, none = (
        jax.device_get(SEARCH(network, part, crop, key, replace(config, enough=enough))) for enough in (-9.0, 9.0)
    )
    assert [int(found.num_draws) for found in (one, none)] == [1, 3]
    assert [np.isfinite(found.scores).any(axis=1).sum() for found in (one, none)] == [1, 3]
    # Programs that differ round differently.
    np.testing.assert_allclose(one.poses.T_scene_object[0], none.poses.T_scene_object[0], atol=1e-3)
    np.testing.assert_array_equal(one.predictions.points[0], none.predictions.points[0])
    for leaf in jax.tree.leaves((one.predictions, one.poses)):
        np.testing.assert_array_equal(leaf[1:], np.zeros_like(leaf[1:]))


@pytest.mark.usefixtures("all_optimisations")
def test_draws_side_by_side_are_those_made_in_turn(network: KeyMatchNet, part: PartArrays, cases: list[Case]) -> None:
    config, key = replace(CONFIG, num_draws=3, enough=9.0), jax.random.key(0)
    crop = crop_of_scene(padded(cases[0].points), 0, part.diameter, key, config)
    in_turn, at_once = (SEARCH(network, part, crop, key, replace(config, side_by_side=given)) for given in (None, True))
    assert at_once.num_draws == in_turn.num_draws == 3
    np.testing.assert_array_equal(at_once.poses.converged, in_turn.poses.converged)
    # Programs that differ round differently.
    np.testing.assert_allclose(at_once.predictions.logits, in_turn.predictions.logits, atol=1e-3)
    apart = jax.vmap(jax.vmap(adi, in_axes=(0, 0, None)), in_axes=(0, 0, None))(
        at_once.poses.T_scene_object, in_turn.poses.T_scene_object, part.points[:256]
    )
    assert apart.max() < 1e-4 * part.diameter
    np.testing.assert_allclose(at_once.scores, in_turn.scores, atol=1e-3)


@pytest.mark.parametrize(
    ("scores", "enough", "give_up", "valid", "number"),
    [
        ([0.1, 0.8, 0.2], 0.7, False, True, 2),
        ([0.9, 0.8, 0.2], 0.7, False, True, 1),
        ([0.1, 0.2, 0.7], 0.7, False, True, 3),
        ([0.1, -jnp.inf, 0.7], 0.7, True, True, 3),
        ([-jnp.inf, -jnp.inf, -jnp.inf], 0.7, False, True, 3),
        ([-jnp.inf, 0.1, 0.2], 0.7, True, True, 1),
        ([-jnp.inf, 0.1, 0.2], None, True, True, 1),
        ([0.9, 0.8, 0.2], None, False, True, 3),
        ([0.1, 0.2, 0.3], 0.7, False, False, 1),
        ([0.1, 0.2, 0.3], None, False, False, 1),
    ],
)
@pytest.mark.parametrize("way", [draws_in_turn, draws_side_by_side])
def test_no_draws_are_made_or_kept_that_are_not_wanted(
    way: Callable[..., DrawsSearch], scores: list[float], enough: float | None, give_up: bool, valid: bool, number: int
) -> None:
    config = replace(CONFIG, num_draws=3, num_modes=2, enough=enough, give_up=give_up)
    poses = jnp.stack([jnp.array(scores), jnp.full(3, -jnp.inf)], axis=1)

    def one(draw: jax.Array) -> Any:
        return draw + 1, draw + 1

    def scored(found: Any, so_far: Any) -> jax.Array:
        return poses[found - 1] + (so_far.max() - found).astype(jnp.float32)  # by no draw after it

    made = way(one, scored, jnp.bool_(valid), config)
    there = np.arange(3) < number
    assert made.num_draws == number
    for draws in (made.predictions, made.poses):
        np.testing.assert_array_equal(draws, np.where(there, [1, 2, 3], 0))
    np.testing.assert_allclose(made.scores[:, 0], np.where(there, scores, -np.inf), atol=1e-6)


@pytest.mark.parametrize("num_draws", [1, 3, 7, 11])
@pytest.mark.parametrize("count", [2, 40, 63, 64, 65, 190, 441, 442, 443, 694, 695, 3000])
def test_draws_are_full_and_share_but_the_seed_if_they_can(part: PartArrays, num_draws: int, count: int) -> None:
    room = 63  # beside the seed
    size = float(part.diameter) / 4
    grid = np.linspace(-size, size, count, dtype=np.float32)
    points = np.zeros((4096, 3), dtype=np.float32)
    points[:count] = np.stack([grid, np.zeros(count), np.full(count, 500)], axis=1)
    points[[0, count // 2]] = points[[count // 2, 0]]
    scene = PaddedCloud(jnp.asarray(points), jnp.asarray(np.arange(len(points)) < count))
    config = replace(CONFIG, num_draws=num_draws, num_points=room + 1)
    crop = crop_of_scene(scene, 0, part.diameter, jax.random.key(0), config)
    draw = jax.jit(draw_of_crop, static_argnums=3)
    draws = [jax.device_get(draw(crop, number, part.diameter, config)) for number in range(num_draws)]
    taken = [one.points[one.mask][:, 0] for one in draws]
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
    mask = np.arange(len(points)) < count
    found = solve(model, part, PaddedCloud(jnp.asarray(points), jnp.asarray(mask)))
    assert not found.converged
    np.testing.assert_array_equal(found.T_scene_object, np.eye(4))
    assert found.num_inliers == 0
    assert found.status != PoseStatus.OK


@pytest.mark.parametrize(
    "values",
    [
        {"num_draws": 0},
        {"num_modes": 0},
        {"surface_points": 0},
        {"enough": np.nan},
        {"num_poses": 0},
        {"icp_points": 0},
    ],
)
def test_settings_without_meaning_are_refused(values: dict[str, int]) -> None:
    with pytest.raises(InputError, match=next(iter(values))):
        CropSearchConfig(**values)  # type: ignore[arg-type]
