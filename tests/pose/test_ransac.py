import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.synthetic import synthetic_matches
from kmn_jax.errors import InputError
from kmn_jax.geometry import pose_error
from kmn_jax.pose import Matches, PoseStatus, RansacConfig, ransac, ransac_modes

KEY = jax.random.key(7)
SMALL = {"num_matches": 300, "inlier_share": 0.3}


def small_matches(seed=0, **changes):
    matches, pose = synthetic_matches(jax.random.key(seed), **SMALL)
    return matches._replace(**changes), pose


def is_recovered(estimated, truth, diameter):
    angle, shift = pose_error(estimated, truth)
    return (np.degrees(angle) < 3) & (shift < 0.02 * diameter)


def assert_failed(result, status):
    assert result.status == status, result.reason
    assert not result.converged
    assert result.num_inliers == 0
    assert result.score == 0
    assert not result.inlier_mask.any()
    np.testing.assert_array_equal(result.T_scene_object, np.eye(4))
    for field in result:
        assert np.isfinite(field).all()


@pytest.mark.usefixtures("all_optimisations")  # it runs for long
@pytest.mark.parametrize("use_normals", [True, False])
def test_recovers_the_pose_in_99_of_100_draws_at_20_percent_inliers(use_normals):
    @jax.jit
    def draw(key):
        matches, truth = synthetic_matches(key, num_matches=2048, inlier_share=0.2, noise=0.01)
        result = ransac(key, matches, RansacConfig(use_normals=use_normals))
        return result.T_scene_object, truth, matches.object_diameter

    recovered = [is_recovered(*draw(jax.random.key(seed))) for seed in range(100)]
    assert np.sum(recovered) >= 99


def test_matches_that_name_keypoints():
    recovered = 0
    for seed in range(10):
        matches, truth = synthetic_matches(jax.random.key(seed), inlier_share=0.3, num_keypoints=20)
        result = ransac(KEY, matches)
        angle, shift = pose_error(result.T_scene_object, truth)
        recovered += bool(result.converged & (angle < np.radians(10)) & (shift < 0.05 * matches.object_diameter))
    assert recovered >= 9


def test_result_is_consistent():
    matches, truth = small_matches()
    result = ransac(KEY, matches)
    assert result.converged
    assert result.reason == "the pose was found"
    assert is_recovered(result.T_scene_object, truth, matches.object_diameter)
    assert result.num_inliers == result.inlier_mask.sum()
    assert result.num_inliers.dtype == jnp.int32
    assert result.score == pytest.approx(float(result.num_inliers) / 300)
    moved = np.asarray(matches.object_points) @ np.asarray(result.T_scene_object)[:3, :3].T
    moved = moved + np.asarray(result.T_scene_object)[:3, 3]
    distances = np.linalg.norm(moved - np.asarray(matches.scene_points), axis=1)[np.asarray(result.inlier_mask)]
    assert distances.max() <= 0.15 * matches.object_diameter * 1.001
    assert result.rms_error == pytest.approx(np.sqrt((distances**2).mean()), rel=1e-3)


@pytest.mark.usefixtures("all_optimisations")
def test_same_key_same_bits():
    matches, _ = small_matches()
    first, again = ransac(KEY, matches), ransac(KEY, matches)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    raw = ransac(jax.random.key_data(KEY), matches)
    np.testing.assert_array_equal(first.T_scene_object, raw.T_scene_object)


def test_vmap_agrees_with_single_calls():
    cases = [small_matches(seed) for seed in range(3)]
    keys = jax.random.split(KEY, 3)
    batch = jax.vmap(ransac)(keys, jax.tree.map(lambda *rows: jnp.stack(rows), *(matches for matches, _ in cases)))
    for row, (matches, _) in enumerate(cases):
        single = ransac(keys[row], matches)
        np.testing.assert_allclose(batch.T_scene_object[row], single.T_scene_object, rtol=1e-4, atol=2e-3)
        assert batch.num_inliers[row] == single.num_inliers


def test_padding_is_ignored():
    matches, truth = small_matches()
    padded = Matches(
        *(jnp.concatenate([jnp.full((50, *rows.shape[1:]), jnp.nan), rows]) for rows in matches[:5]),
        mask=jnp.concatenate([jnp.zeros(50, dtype=bool), matches.mask]),
        overflow=matches.overflow,
        object_diameter=matches.object_diameter,
    )
    result = ransac(KEY, padded)
    assert is_recovered(result.T_scene_object, truth, matches.object_diameter)
    assert not result.inlier_mask[:50].any()
    assert result.score == pytest.approx(float(result.num_inliers) / 300)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_units_do_not_matter(scale):
    matches, _ = small_matches()
    scaled = matches._replace(
        object_points=matches.object_points * scale,
        scene_points=matches.scene_points * scale,
        object_diameter=matches.object_diameter * scale,
    )
    pose, other = ransac(KEY, matches).T_scene_object, ransac(KEY, scaled).T_scene_object
    np.testing.assert_allclose(other[:3, :3], pose[:3, :3], atol=1e-4)
    np.testing.assert_allclose(other[:3, 3] / scale, pose[:3, 3], atol=0.02)


def test_far_from_the_origin():
    matches, truth = small_matches()
    far = np.array([5e3, -2e4, 1e4], np.float32)
    result = ransac(KEY, matches._replace(scene_points=matches.scene_points + far[None]))
    assert is_recovered(result.T_scene_object, truth.at[:3, 3].add(far), matches.object_diameter)


def test_normals_that_disagree_are_no_inliers():
    matches, _ = small_matches(object_normals=-small_matches()[0].object_normals)
    assert_failed(ransac(KEY, matches), PoseStatus.NO_CONSENSUS)
    assert ransac(KEY, matches, RansacConfig(use_normals=False)).converged


def test_wrong_matches_give_no_consensus():
    for seed in range(5):
        matches, _ = synthetic_matches(jax.random.key(seed), num_matches=2048, inlier_share=0.0)
        assert_failed(ransac(KEY, matches), PoseStatus.NO_CONSENSUS)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_matches(count):
    matches, _ = small_matches(mask=jnp.arange(300) < count)
    assert_failed(ransac(KEY, matches), PoseStatus.TOO_FEW_MATCHES)
    assert "fewer than three" in ransac(KEY, matches).reason


@pytest.mark.parametrize("capacity", [0, 1, 2])
def test_capacity_below_three(capacity):
    matches, _ = small_matches()
    short = Matches(*(rows[:capacity] for rows in matches[:6]), *matches[6:])
    assert_failed(ransac(KEY, short), PoseStatus.TOO_FEW_MATCHES)


def test_duplicated_points():
    matches, truth = small_matches()
    twice = Matches(*(jnp.concatenate([rows, rows]) for rows in matches[:6]), *matches[6:])
    assert is_recovered(ransac(KEY, twice).T_scene_object, truth, matches.object_diameter)
    same = matches._replace(**{name: jnp.ones((300, 3)) for name in matches._fields[:4]})
    assert_failed(ransac(KEY, same), PoseStatus.DEGENERATE)


def test_collinear_points():
    line = jnp.linspace(-20.0, 20.0, 300)[:, None] * jnp.array([[1.0, 2, 3]]) / 4
    normals = jnp.tile(jnp.array([[0.0, 0, 1]]), (300, 1))
    matches, _ = small_matches(object_points=line, scene_points=line, object_normals=normals, scene_normals=normals)
    assert_failed(ransac(KEY, matches), PoseStatus.DEGENERATE)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", Matches._fields[:5])
def test_values_that_are_not_finite(name, value):
    matches, truth = small_matches()
    rows = getattr(matches, name)
    broken = matches._replace(**{name: rows.at[::2].set(value)})
    with pytest.raises(InputError, match=f"matches.{name} holds"):
        ransac(KEY, broken)
    result = jax.jit(ransac)(KEY, broken)
    assert is_recovered(result.T_scene_object, truth, matches.object_diameter)
    assert not result.inlier_mask[::2].any()
    assert_failed(jax.jit(ransac)(KEY, matches._replace(**{name: rows * value})), PoseStatus.TOO_FEW_MATCHES)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_diameter_must_be_positive(value):
    matches, _ = small_matches(object_diameter=jnp.float32(value))
    with pytest.raises(InputError, match="object_diameter"):
        ransac(KEY, matches)
    assert_failed(jax.jit(ransac)(KEY, matches), PoseStatus.INVALID_INPUT)


def test_bad_input_is_named():
    matches, _ = small_matches()
    bad = [
        ({"object_points": matches.object_points[:, :2]}, "matches.object_points has shape"),
        ({"scene_points": matches.scene_points[:5]}, "matches.scene_points has shape"),
        ({"scene_normals": matches.scene_normals.astype(jnp.int32)}, "matches.scene_normals has dtype"),
        ({"mask": jnp.ones(300)}, "matches.mask has dtype"),
        ({"weights": -matches.weights}, "negative"),
    ]
    for change, message in bad:
        with pytest.raises(InputError, match=message):
            ransac(KEY, matches._replace(**change))
    with pytest.raises(InputError, match="random key"):
        ransac(jnp.zeros(3), matches)
    with pytest.raises(InputError, match="random key"):
        ransac(jax.random.split(KEY, 2), matches)


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
    result = ransac(KEY, matches, RansacConfig(num_refinements=0))
    assert result.converged


def test_modes_are_the_poses_that_a_nearly_symmetric_part_may_have():
    matches, truth = small_matches(3)
    half_turn = jnp.diag(jnp.array([-1.0, -1.0, 1.0, 1.0]))
    # The same matches to the turned object: half as trusted, as they are half as many.
    turned, share = matches.object_points @ half_turn[:3, :3], jnp.arange(300) < 150
    both = matches._replace(
        object_points=jnp.concatenate([matches.object_points, turned]),
        object_normals=jnp.concatenate([matches.object_normals, matches.object_normals @ half_turn[:3, :3]]),
        scene_points=jnp.tile(matches.scene_points, (2, 1)),
        scene_normals=jnp.tile(matches.scene_normals, (2, 1)),
        weights=jnp.tile(matches.weights, 2),
        mask=jnp.concatenate([matches.mask, matches.mask & share]),
    )
    found = ransac_modes(KEY, both, 3)
    assert is_recovered(found.T_scene_object[0], truth, both.object_diameter)
    assert is_recovered(found.T_scene_object[1], truth @ half_turn, both.object_diameter)
    assert found.num_inliers[0] > found.num_inliers[1]
    assert bool(found.converged[:2].all())
    for one, other in zip(ransac(KEY, both), found, strict=True):
        np.testing.assert_allclose(one, other[0], rtol=1e-5, atol=1e-5)


def test_modes_without_consensus_are_none():
    matches, _ = small_matches(1)
    found = ransac_modes(KEY, matches._replace(mask=jnp.zeros(300, dtype=bool)), 2)
    assert not bool(found.converged.any())
    np.testing.assert_array_equal(found.T_scene_object, np.tile(np.eye(4), (2, 1, 1)))
    with pytest.raises(InputError, match="count is 0"):
        ransac_modes(KEY, matches, 0)
