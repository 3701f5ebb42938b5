from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.synthetic import synthetic_matches
from kmn_jax.errors import InputError
from kmn_jax.geometry import pose_error
from kmn_jax.pose import Matches, PoseStatus, RansacConfig, ransac, ransac_modes

KEY = jax.random.key(7)
_drawn = jax.jit(partial(synthetic_matches, num_matches=2048, noise=0.01), static_argnames="inlier_share")
_pose_error = jax.jit(pose_error)


@cache
def drawn(seed, inlier_share):
    return jax.device_get(_drawn(jax.random.key(seed), inlier_share=inlier_share))


def small_matches(seed=0, **changes):
    matches, pose = drawn(seed, 0.3)
    return Matches(*(rows[:300] for rows in matches[:6]), *matches[6:])._replace(**changes), pose


def twice(matches):
    return Matches(*(np.concatenate([rows, rows]) for rows in matches[:6]), *matches[6:])


def solved(matches, *config, key=KEY):
    return jax.device_get(ransac(key, matches, *config))


def is_recovered(estimated, truth, diameter, degrees=3, share=0.02):
    angle, shift = _pose_error(estimated, truth)
    return bool(np.degrees(angle) < degrees and shift < share * diameter)


def assert_failed(result, status):
    assert result.status == status, result.reason
    assert not result.converged
    assert result.num_inliers == 0
    assert result.score == 0
    assert not result.inlier_mask.any()
    np.testing.assert_array_equal(result.T_scene_object, np.eye(4))
    for field in result:
        assert np.isfinite(field).all()


@pytest.fixture(scope="module")
def hard_cases():
    return [drawn(seed, 0.2) for seed in range(100)]


@pytest.mark.usefixtures("all_optimisations")  # it runs for long
@pytest.mark.parametrize("use_normals", [True, False])
def test_recovers_the_pose_in_99_of_100_draws_at_20_percent_inliers(use_normals, hard_cases):
    recovered = 0
    for seed, (matches, truth) in enumerate(hard_cases):
        result = solved(matches, RansacConfig(use_normals=use_normals), key=jax.random.key(seed))
        recovered += is_recovered(result.T_scene_object, truth, matches.object_diameter)
    assert recovered >= 99


def test_matches_that_name_keypoints():
    recovered = 0
    for seed in range(10):
        matches, truth = drawn(seed, 0.3)
        points = matches.object_points  # drawn evenly, so that any 20 of them are keypoints
        nearest = np.square(points[:, None] - points[None, :20]).sum(axis=2).argmin(axis=1)
        named = matches._replace(object_points=points[nearest], object_normals=matches.object_normals[nearest])
        result = solved(named)
        near = is_recovered(result.T_scene_object, truth, matches.object_diameter, degrees=10, share=0.05)
        recovered += result.converged and near
    assert recovered >= 9


def test_result_is_consistent():
    matches, truth = small_matches()
    result = solved(matches)
    assert result.converged
    assert result.reason == "the pose was found"
    assert is_recovered(result.T_scene_object, truth, matches.object_diameter)
    assert result.num_inliers == result.inlier_mask.sum()
    assert result.num_inliers.dtype == jnp.int32
    assert result.score == pytest.approx(float(result.num_inliers) / 300)
    moved = matches.object_points @ result.T_scene_object[:3, :3].T + result.T_scene_object[:3, 3]
    distances = np.linalg.norm(moved - matches.scene_points, axis=1)[result.inlier_mask]
    assert distances.max() <= 0.15 * matches.object_diameter * 1.001
    assert result.rms_error == pytest.approx(np.sqrt((distances**2).mean()), rel=1e-3)


@pytest.mark.usefixtures("all_optimisations")
def test_same_key_same_bits():
    matches, _ = small_matches()
    first, again = solved(matches), solved(matches)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    raw = solved(matches, key=jax.random.key_data(KEY))
    np.testing.assert_array_equal(first.T_scene_object, raw.T_scene_object)


def test_vmap_agrees_with_single_calls():
    cases = [small_matches(seed) for seed in range(3)]
    keys = jax.random.split(KEY, 3)
    stacked = jax.tree.map(lambda *rows: np.stack(rows), *(matches for matches, _ in cases))
    batch = jax.device_get(jax.vmap(ransac)(keys, stacked))
    for row, (matches, _) in enumerate(cases):
        single = solved(matches, key=keys[row])
        np.testing.assert_allclose(batch.T_scene_object[row], single.T_scene_object, rtol=1e-4, atol=2e-3)
        assert batch.num_inliers[row] == single.num_inliers


def test_padding_is_ignored():
    matches, truth = small_matches()
    padded = twice(matches)
    padded.mask[:300] = False
    for rows in padded[:5]:
        rows[:300] = np.nan
    result = solved(padded)
    assert is_recovered(result.T_scene_object, truth, matches.object_diameter)
    assert not result.inlier_mask[:300].any()
    assert result.score == pytest.approx(float(result.num_inliers) / 300)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_units_do_not_matter(scale):
    matches, _ = small_matches()
    scaled = matches._replace(
        object_points=matches.object_points * np.float32(scale),
        scene_points=matches.scene_points * np.float32(scale),
        object_diameter=matches.object_diameter * np.float32(scale),
    )
    pose, other = solved(matches).T_scene_object, solved(scaled).T_scene_object
    np.testing.assert_allclose(other[:3, :3], pose[:3, :3], atol=1e-4)
    np.testing.assert_allclose(other[:3, 3] / scale, pose[:3, 3], atol=0.02)


def test_far_from_the_origin():
    matches, truth = small_matches()
    far = np.array([5e3, -2e4, 1e4], np.float32)
    result = solved(matches._replace(scene_points=matches.scene_points + far))
    there = truth.copy()
    there[:3, 3] += far
    assert is_recovered(result.T_scene_object, there, matches.object_diameter)


def test_normals_that_disagree_are_no_inliers():
    matches, _ = drawn(0, 0.3)
    matches = matches._replace(object_normals=-matches.object_normals)
    assert_failed(solved(matches), PoseStatus.NO_CONSENSUS)
    assert solved(matches, RansacConfig(use_normals=False)).converged


def test_wrong_matches_give_no_consensus():
    for seed in range(5):
        matches, _ = drawn(seed, 0.3)
        another = {name: np.roll(getattr(matches, name), 1, axis=0) for name in ("object_points", "object_normals")}
        assert_failed(solved(matches._replace(**another)), PoseStatus.NO_CONSENSUS)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_matches(count):
    matches, _ = small_matches(mask=np.arange(300) < count)
    assert_failed(solved(matches), PoseStatus.TOO_FEW_MATCHES)
    assert "fewer than three" in solved(matches).reason


@pytest.mark.parametrize("capacity", [0, 1, 2])
def test_capacity_below_three(capacity):
    matches, _ = small_matches()
    short = Matches(*(rows[:capacity] for rows in matches[:6]), *matches[6:])
    assert_failed(solved(short), PoseStatus.TOO_FEW_MATCHES)


def test_duplicated_points():
    matches, truth = small_matches()
    assert is_recovered(solved(twice(matches)).T_scene_object, truth, matches.object_diameter)
    same = matches._replace(**{name: np.ones((300, 3), np.float32) for name in matches._fields[:4]})
    assert_failed(solved(same), PoseStatus.DEGENERATE)


def test_collinear_points():
    line = np.linspace(-20, 20, 300, dtype=np.float32)[:, None] * np.float32([1, 2, 3]) / 4
    normals = np.tile(np.float32([0, 0, 1]), (300, 1))
    matches, _ = small_matches(object_points=line, scene_points=line, object_normals=normals, scene_normals=normals)
    assert_failed(solved(matches), PoseStatus.DEGENERATE)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", Matches._fields[:5])
def test_values_that_are_not_finite(name, value):
    matches, truth = small_matches()
    rows = getattr(matches, name)
    half = rows.copy()
    half[::2] = value
    broken = matches._replace(**{name: half})
    with pytest.raises(InputError, match=f"matches.{name} holds"):
        ransac(KEY, broken)
    result = jax.device_get(jax.jit(ransac)(KEY, broken))
    assert is_recovered(result.T_scene_object, truth, matches.object_diameter)
    assert not result.inlier_mask[::2].any()
    unusable = matches._replace(**{name: np.copysign(np.float32(value), rows)})
    assert_failed(jax.device_get(jax.jit(ransac)(KEY, unusable)), PoseStatus.TOO_FEW_MATCHES)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_diameter_must_be_positive(value):
    matches, _ = small_matches(object_diameter=np.float32(value))
    with pytest.raises(InputError, match="object_diameter"):
        ransac(KEY, matches)
    assert_failed(jax.device_get(jax.jit(ransac)(KEY, matches)), PoseStatus.INVALID_INPUT)


def test_bad_input_is_named():
    matches, _ = small_matches()
    bad = [
        ({"object_points": matches.object_points[:, :2]}, "matches.object_points has shape"),
        ({"scene_points": matches.scene_points[:5]}, "matches.scene_points has shape"),
        ({"scene_normals": matches.scene_normals.astype(bool)}, "matches.scene_normals has dtype"),
        ({"mask": np.ones(300, np.float32)}, "matches.mask has dtype"),
        ({"weights": -matches.weights}, "negative"),
    ]
    for change, message in bad:
        with pytest.raises(InputError, match=message):
            ransac(KEY, matches._replace(**change))
    with pytest.raises(InputError, match="random key"):
        ransac(np.zeros(3, np.float32), matches)
    with pytest.raises(InputError, match="random key"):
        ransac(jax.random.split(KEY, 3), matches)


@pytest.mark.parametrize(
    "change",
    [
        {"num_hypotheses": 0},
        {"num_hypotheses": 20000},
        {"distance_gate": 0.0},
        {"normal_gate_degrees": 0.0},
        {"num_refinements": -1},
        {"min_inliers": 2},
        {"min_inlier_share": 1.5},
    ],
)
def test_config_refuses_contradictions(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        RansacConfig(**change)


def test_refinement_gates_shrink_as_published():
    gates = RansacConfig(distance_gate=0.2).refinement_gates
    np.testing.assert_allclose(np.square(gates), 0.04 / np.arange(2, 7))
    matches, _ = small_matches()
    assert solved(matches, RansacConfig(num_refinements=0)).converged


def test_modes_are_the_poses_that_a_nearly_symmetric_part_may_have():
    matches, truth = small_matches(3)
    half_turn = np.diag(np.float32([-1, -1, 1, 1]))
    # The same matches to the turned object: half as trusted, as they are half as many.
    both = twice(matches)
    both.object_points[300:] = matches.object_points @ half_turn[:3, :3]
    both.object_normals[300:] = matches.object_normals @ half_turn[:3, :3]
    both.mask[450:] = False
    found = jax.device_get(ransac_modes(KEY, both, 3))
    assert is_recovered(found.T_scene_object[0], truth, both.object_diameter)
    assert is_recovered(found.T_scene_object[1], truth @ half_turn, both.object_diameter)
    assert found.num_inliers[0] > found.num_inliers[1]
    assert bool(found.converged[:2].all())
    for one, other in zip(solved(both), found, strict=True):
        np.testing.assert_allclose(one, other[0], rtol=1e-5, atol=1e-5)


def test_modes_without_consensus_are_none():
    matches = twice(small_matches(1)[0])
    found = jax.device_get(ransac_modes(KEY, matches._replace(mask=np.zeros(600, dtype=bool)), 3))
    assert not bool(found.converged.any())
    np.testing.assert_array_equal(found.T_scene_object, np.tile(np.eye(4), (3, 1, 1)))
    with pytest.raises(InputError, match="count is 0"):
        ransac_modes(KEY, matches, 0)
