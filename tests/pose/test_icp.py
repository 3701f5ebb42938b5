import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.synthetic import box_surface
from kmn_jax.errors import InputError
from kmn_jax.geometry import (
    compose,
    from_quaternion_translation,
    pose_error,
    random_pose,
    rotate_vectors,
    transform_points,
)
from kmn_jax.pose import IcpConfig, PoseStatus, _icp, icp

DIAMETER = 50.0
METHODS = ["point_to_plane", "point_to_point"]


def make_scene(seed, count=600, noise=0.005, clutter=0.2, scale=1.0):
    """A noisy cloud of the visible half of a box among clutter, the model of the box, and the true pose."""
    keys = jax.random.split(jax.random.key(seed), 6)
    model, _ = box_surface(keys[0], 800, DIAMETER * scale)
    truth = random_pose(keys[1], 3 * DIAMETER * scale)
    points, normals = box_surface(keys[2], 4 * count, DIAMETER * scale)
    points, normals = transform_points(truth, points), rotate_vectors(truth, normals)
    visible = np.flatnonzero((normals * truth[None, :3, 3]).sum(axis=1) < 0)[:count]
    points, normals = points[visible], normals[visible]
    points = points + noise * DIAMETER * scale * jax.random.normal(keys[3], points.shape)
    around = truth[None, :3, 3] + DIAMETER * scale * jax.random.uniform(keys[4], points.shape, minval=-1, maxval=1)
    is_clutter = jnp.arange(len(visible))[:, None] < round(clutter * len(visible))
    return model, jnp.where(is_clutter, around, points), normals, truth


def perturbed(truth, seed, degrees, shift, scale=1.0):
    axis = np.random.default_rng(seed).normal(size=(2, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half = np.radians(degrees) / 2
    quaternion = jnp.asarray(np.r_[np.cos(half), np.sin(half) * axis[0]], dtype=jnp.float32)
    offset = jnp.asarray(shift * DIAMETER * scale * axis[1], dtype=jnp.float32)
    return compose(truth, from_quaternion_translation(quaternion, offset))


def errors(pose, truth):
    angle, shift = pose_error(pose, truth)
    return float(np.degrees(angle)), float(shift) / DIAMETER


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("method", METHODS)
def test_converges_on_a_noisy_partial_view(method, seed):
    model, scene, normals, truth = make_scene(seed)
    start = perturbed(truth, seed, degrees=8, shift=0.05)
    result = icp(model, scene, start, DIAMETER, normals, config=IcpConfig(method=method, iterations=100))
    assert result.converged, result.reason
    angle, shift = errors(result.T_scene_object, truth)
    assert angle < 1.5
    assert shift < 0.01
    assert result.score > 0.75
    assert result.num_inliers == result.inlier_mask.sum()
    assert 0 < result.rms_error < 0.1 * DIAMETER


@pytest.mark.parametrize("robust", ["none", "tukey"])
def test_other_weights(robust):
    model, scene, normals, truth = make_scene(0)
    result = icp(model, scene, perturbed(truth, 0, 5, 0.03), DIAMETER, normals, config=IcpConfig(robust=robust))
    assert result.converged
    assert errors(result.T_scene_object, truth)[0] < 1.5


def test_a_perfect_start_stays():
    model, scene, normals, truth = make_scene(1, noise=0.0, clutter=0.0)
    result = icp(model, scene, truth, DIAMETER, normals)
    assert result.converged, result.reason
    angle, shift = errors(result.T_scene_object, truth)
    assert angle < 0.2
    assert shift < 0.002


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_units_do_not_matter(scale):
    poses = []
    for factor in (1.0, scale):
        model, scene, normals, truth = make_scene(2, scale=factor)
        start = perturbed(truth, 2, 5, 0.03, scale=factor)
        pose = np.array(icp(model, scene, start, DIAMETER * factor, normals).T_scene_object)
        pose[:3, 3] /= factor * DIAMETER
        poses.append(pose)
    np.testing.assert_allclose(poses[0], poses[1], atol=2e-4)


def test_padding_is_ignored():
    model, scene, normals, truth = make_scene(3)
    start = perturbed(truth, 3, 5, 0.03)
    expected = icp(model, scene, start, DIAMETER, normals)
    rubbish = jnp.full((7, 3), jnp.nan)
    result = icp(
        jnp.concatenate([model, rubbish]),
        jnp.concatenate([rubbish, scene]),
        start,
        DIAMETER,
        jnp.concatenate([rubbish, normals]),
        object_mask=jnp.arange(len(model) + 7) < len(model),
        scene_mask=jnp.arange(len(scene) + 7) >= 7,
    )
    np.testing.assert_allclose(result.T_scene_object, expected.T_scene_object, atol=2e-3)
    assert result.num_inliers == expected.num_inliers
    assert not result.inlier_mask[:7].any()


def test_a_single_plane_keeps_its_open_directions():
    generator = np.random.default_rng(0)
    plane = np.c_[generator.uniform(-25, 25, size=(400, 2)), np.zeros(400)].astype(np.float32)
    normals = np.tile(np.array([[0, 0, 1]], np.float32), (400, 1))
    start = np.eye(4, dtype=np.float32)
    start[:3, 3] = [1.0, -0.5, 2.0]
    result = icp(plane, plane, start, DIAMETER, normals)
    assert result.converged
    np.testing.assert_allclose(result.T_scene_object[:3, 3], [1.0, -0.5, 0.0], atol=0.05)


@pytest.mark.parametrize("method", METHODS)
def test_no_overlap_returns_the_initial_pose(method):
    model, scene, normals, truth = make_scene(4)
    start = perturbed(truth, 4, 0, 20)
    result = icp(model, scene, start, DIAMETER, normals, config=IcpConfig(method=method))
    assert not result.converged
    assert result.status == PoseStatus.NO_OVERLAP
    assert "gate" in result.reason
    np.testing.assert_array_equal(result.T_scene_object, start)


def test_points_on_a_line_are_degenerate():
    line = np.linspace(-20, 20, 50, dtype=np.float32)[:, None] * np.array([[1, 0, 0]], np.float32)
    start = np.eye(4, dtype=np.float32)
    start[2, 3] = 1
    result = icp(line, line, start, DIAMETER, config=IcpConfig(method="point_to_point"))
    assert result.status == PoseStatus.DEGENERATE
    np.testing.assert_array_equal(result.T_scene_object, start)


def test_iteration_limit_is_told_and_the_better_pose_kept():
    model, scene, normals, truth = make_scene(5)
    start = perturbed(truth, 5, 8, 0.05)
    result = icp(model, scene, start, DIAMETER, normals, config=IcpConfig(iterations=2))
    assert result.status == PoseStatus.ITERATION_LIMIT
    assert not result.converged
    assert errors(result.T_scene_object, truth)[0] < 8


@pytest.mark.parametrize("argument", [0, 1, 2, 3])
def test_values_that_are_not_finite(argument):
    model, scene, normals, truth = make_scene(6)
    arguments = [model, scene, truth, jnp.float32(DIAMETER), normals]
    arguments[argument] = arguments[argument] * jnp.nan
    with pytest.raises(InputError, match="NaN"):
        icp(*arguments)
    result = jax.jit(icp)(*arguments)
    assert not result.converged
    for field in result:
        assert np.isfinite(field).all()


def test_vmap_agrees_with_single_calls():
    scenes = [make_scene(seed, count=300) for seed in range(2)]
    starts = [perturbed(truth, seed, 5, 0.03) for seed, (*_, truth) in enumerate(scenes)]
    models, points, normals = (jnp.stack(side) for side in list(zip(*scenes, strict=True))[:3])
    batch = jax.vmap(lambda m, s, p, n: icp(m, s, p, DIAMETER, n))(models, points, jnp.stack(starts), normals)
    for row, (model, scene, normal, _) in enumerate(scenes):
        single = icp(model, scene, starts[row], DIAMETER, normal)
        np.testing.assert_allclose(batch.T_scene_object[row], single.T_scene_object, atol=5e-3)
    with pytest.raises(ValueError, match="batched"):
        _ = batch.reason


def test_bad_input_is_named():
    model, scene, normals, truth = make_scene(7, count=20)
    with pytest.raises(InputError, match="scene_normals is missing"):
        icp(model, scene, truth, DIAMETER)
    with pytest.raises(InputError, match="scene_normals has shape"):
        icp(model, scene, truth, DIAMETER, normals[:5])
    with pytest.raises(InputError, match="T_scene_object has shape"):
        icp(model, scene, truth[:3], DIAMETER, normals)
    with pytest.raises(InputError, match="0 scene points"):
        icp(model, scene[:0], truth, DIAMETER, normals[:0])
    with pytest.raises(InputError, match="object_diameter is 0"):
        icp(model, scene, truth, 0.0, normals)
    with pytest.raises(InputError, match="floating"):
        icp(model.astype(jnp.int32), scene, truth, DIAMETER, normals)


@pytest.mark.parametrize(
    "change",
    [{"iterations": 0}, {"distance_gate": 0.0}, {"tolerance": 0.0}],
)
def test_config_refuses_contradictions(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        IcpConfig(**change)


@pytest.mark.parametrize("case", ["one object point", "one scene point", "scene on a line", "no normals"])
def test_what_fixes_no_pose_is_no_success(case: str) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(100, 3)).astype(np.float32)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    scene, scene_normals = points + np.float32(0.01), normals
    match case:
        case "one object point":
            points = np.zeros((1, 3), np.float32)
            scene = scene * np.float32(0.01)
        case "one scene point":
            scene, scene_normals = np.tile(points[:1], (100, 1)), np.tile(normals[:1], (100, 1))
        case "scene on a line":
            points = np.linspace(0, 1, 100, dtype=np.float32)[:, None] * np.float32([[1, 2, 3]])
            scene = points
        case "no normals":
            scene_normals = normals * 0
    result = icp(points, scene, np.eye(4), 3.0, scene_normals)
    assert not bool(result.converged)
    np.testing.assert_array_equal(result.T_scene_object, np.eye(4))


@pytest.mark.parametrize("method", METHODS)
def test_many_points_end_where_all_distances_do(method, monkeypatch):
    model, scene, normals, truth = make_scene(8)
    start = perturbed(truth, 8, degrees=6, shift=0.04)
    object_mask, scene_mask = (jnp.arange(len(points)) % 7 != 3 for points in (model, scene))
    poses, inliers = [], []
    for few in (2**20, 0):
        monkeypatch.setattr(_icp, "_FEW_DISTANCES", few)
        given = model, scene, start, jnp.float32(DIAMETER), normals, object_mask, scene_mask, None
        # Of a new function each time: one that was traced before is not traced again.
        result = jax.jit(lambda *given: _icp._icp.__wrapped__(*given, IcpConfig(method=method)))(*given)
        assert result.converged
        poses.append(np.asarray(result.T_scene_object))
        inliers.append(np.asarray(result.inlier_mask))
    np.testing.assert_allclose(poses[0], poses[1], atol=2e-4 * DIAMETER)
    assert (inliers[0] != inliers[1]).mean() < 0.005
    assert not inliers[1][~np.asarray(scene_mask)].any()


def test_the_far_side_of_a_thin_wall_is_no_partner():
    generator = np.random.default_rng(0)
    side = np.c_[generator.uniform(-20, 20, size=(300, 2)), np.zeros(300)].astype(np.float32)
    up = np.tile(np.float32([[0, 0, 1]]), (300, 1))
    wall = np.float32([[0, 0, 2]])
    plate, directions = np.concatenate([side, side - wall]), np.concatenate([up, -up])
    start = np.eye(4, dtype=np.float32)
    start[2, 3] = 2
    drawn = icp(plate, side, start, DIAMETER, up)
    np.testing.assert_allclose(drawn.T_scene_object[2, 3], 2, atol=0.05)  # its far side lies on the scene
    right = icp(plate, side, start, DIAMETER, up, object_normals=directions)
    assert not right.converged  # of a start whose every partner disagrees
    seen = icp(plate, side, start, DIAMETER, up, object_mask=directions[:, 2] > 0, object_normals=directions)
    assert seen.converged
    np.testing.assert_allclose(seen.T_scene_object[2, 3], 0, atol=0.05)
    with pytest.raises(InputError, match="object_normals is given without"):
        icp(plate, side, start, DIAMETER, config=IcpConfig(method="point_to_point"), object_normals=directions)
