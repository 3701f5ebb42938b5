import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kmn_jax.errors import InputError
from kmn_jax.geometry import pose_error
from kmn_jax.pose import IcpConfig, PoseStatus, _icp, icp
from tests.reference.clouds import box_cloud
from tests.reference.meshes import random_rotations

DIAMETER = 50.0
METHODS = ["point_to_plane", "point_to_point"]
# One for each method in all tests, and clouds of the same size: a program takes longer to compile than to run.
CONFIGS = {"point_to_plane": IcpConfig(), "point_to_point": IcpConfig(method="point_to_point", iterations=100)}
_pose_error = jax.jit(pose_error)


def make_scene(seed, noise=0.005, clutter=0.2, scale=1.0):
    """A noisy cloud of the visible half of a box among clutter, the model of the box, and the true pose."""
    generator = np.random.default_rng(seed)
    model, surface = box_cloud(seed, 800)[:, :3], box_cloud(seed + 100, 2400)
    truth = np.eye(4)
    truth[:3, :3], truth[:3, 3] = random_rotations(1, seed)[0], 3 * DIAMETER * generator.normal(size=3)
    points, normals = surface[:, :3] @ truth[:3, :3].T + truth[:3, 3], surface[:, 3:] @ truth[:3, :3].T
    visible = np.flatnonzero(normals @ truth[:3, 3] < 0)[:600]
    points, normals = points[visible] + noise * DIAMETER * generator.normal(size=(600, 3)), normals[visible]
    strewn = round(clutter * 600)
    points[:strewn] = truth[:3, 3] + DIAMETER * generator.uniform(-1, 1, (strewn, 3))
    truth[:3, 3] *= scale
    return tuple(array.astype(np.float32) for array in (model * scale, points * scale, normals, truth))


def perturbed(truth, seed, degrees, shift, scale=1.0):
    axis = np.random.default_rng(seed).normal(size=(2, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis[0]).as_matrix()
    motion[:3, 3] = shift * DIAMETER * scale * axis[1]
    return (truth @ motion).astype(np.float32)


def errors(pose, truth):
    angle, shift = _pose_error(pose, truth)
    return float(np.degrees(angle)), float(shift) / DIAMETER


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("method", METHODS)
def test_converges_on_a_noisy_partial_view(method, seed):
    model, scene, normals, truth = make_scene(seed)
    start = perturbed(truth, seed, degrees=8, shift=0.05)
    result = icp(model, scene, start, DIAMETER, normals, config=CONFIGS[method])
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
    rubbish = np.full((7, 3), np.nan, np.float32)
    result = icp(
        np.concatenate([model, rubbish]),
        np.concatenate([rubbish, scene]),
        start,
        DIAMETER,
        np.concatenate([rubbish, normals]),
        object_mask=np.arange(len(model) + 7) < len(model),
        scene_mask=np.arange(len(scene) + 7) >= 7,
    )
    np.testing.assert_allclose(result.T_scene_object, expected.T_scene_object, atol=2e-3)
    assert result.num_inliers == expected.num_inliers
    assert not np.asarray(result.inlier_mask)[:7].any()


def test_a_single_plane_keeps_its_open_directions():
    generator = np.random.default_rng(0)
    plane = np.c_[generator.uniform(-25, 25, size=(800, 2)), np.zeros(800)].astype(np.float32)
    normals = np.tile(np.array([[0, 0, 1]], np.float32), (600, 1))
    start = np.eye(4, dtype=np.float32)
    start[:3, 3] = [1.0, -0.5, 2.0]
    result = icp(plane, plane[:600], start, DIAMETER, normals)
    assert result.converged
    np.testing.assert_allclose(np.asarray(result.T_scene_object)[:3, 3], [1.0, -0.5, 0.0], atol=0.05)


@pytest.mark.parametrize("method", METHODS)
def test_no_overlap_returns_the_initial_pose(method):
    model, scene, normals, truth = make_scene(4)
    start = perturbed(truth, 4, 0, 20)
    result = icp(model, scene, start, DIAMETER, normals, config=CONFIGS[method])
    assert not result.converged
    assert result.status == PoseStatus.NO_OVERLAP
    assert "gate" in result.reason
    np.testing.assert_array_equal(result.T_scene_object, start)


def test_points_on_a_line_are_degenerate():
    line = np.linspace(-20, 20, 800, dtype=np.float32)[:, None] * np.array([[1, 0, 0]], np.float32)
    start = np.eye(4, dtype=np.float32)
    start[2, 3] = 1
    result = icp(line, line[100:700], start, DIAMETER, config=CONFIGS["point_to_point"])
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
    arguments = [model, scene, truth, np.float32(DIAMETER), normals]
    arguments[argument] = arguments[argument] * np.float32(np.nan)
    with pytest.raises(InputError, match="NaN"):
        icp(*arguments)
    result = jax.jit(icp)(*arguments)
    assert not result.converged
    for field in result:
        assert np.isfinite(field).all()


def test_vmap_agrees_with_single_calls():
    scenes = [make_scene(seed) for seed in range(2)]
    starts = [perturbed(truth, seed, 5, 0.03) for seed, (*_, truth) in enumerate(scenes)]
    models, points, normals = (np.stack(side) for side in list(zip(*scenes, strict=True))[:3])
    batch = jax.vmap(lambda m, s, p, n: icp(m, s, p, DIAMETER, n))(models, points, np.stack(starts), normals)
    for row, (model, scene, normal, _) in enumerate(scenes):
        single = icp(model, scene, starts[row], DIAMETER, normal)
        np.testing.assert_allclose(np.asarray(batch.T_scene_object)[row], single.T_scene_object, atol=5e-3)
    with pytest.raises(ValueError, match="batched"):
        _ = batch.reason


def test_bad_input_is_named():
    model, scene, normals, truth = make_scene(7)
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
        icp(model.astype(bool), scene, truth, DIAMETER, normals)


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
    points = rng.normal(size=(800, 3)).astype(np.float32)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    scene, scene_normals = points[:600] + np.float32(0.01), normals[:600]
    match case:
        case "one object point":
            points = np.zeros((1, 3), np.float32)
            scene = scene * np.float32(0.01)
        case "one scene point":
            scene, scene_normals = np.tile(points[:1], (600, 1)), np.tile(normals[:1], (600, 1))
        case "scene on a line":
            points = np.linspace(0, 1, 800, dtype=np.float32)[:, None] * np.float32([[1, 2, 3]])
            scene = points[:600]
        case "no normals":
            scene_normals = normals[:600] * 0
    result = icp(points, scene, np.eye(4), 3.0, scene_normals)
    assert not bool(result.converged)
    np.testing.assert_array_equal(result.T_scene_object, np.eye(4))


@pytest.mark.parametrize("method", METHODS)
def test_many_points_end_where_all_distances_do(method, monkeypatch):
    model, scene, normals, truth = make_scene(8)
    start = perturbed(truth, 8, degrees=6, shift=0.04)
    object_mask, scene_mask = (np.arange(len(points)) % 7 != 3 for points in (model, scene))
    assert len(model) * len(scene) <= _icp._FEW_DISTANCES
    all_distances = icp(model, scene, start, DIAMETER, normals, object_mask, scene_mask, config=CONFIGS[method])
    monkeypatch.setattr(_icp, "_FEW_DISTANCES", 0)
    given = model, scene, start, np.float32(DIAMETER), normals, object_mask, scene_mask, None
    # Of a new function: one that was traced before is not traced again.
    grouped = jax.jit(lambda *given: _icp._icp.__wrapped__(*given, CONFIGS[method]))(*given)
    assert all_distances.converged
    assert grouped.converged
    np.testing.assert_allclose(all_distances.T_scene_object, grouped.T_scene_object, atol=2e-4 * DIAMETER)
    inliers = np.asarray(grouped.inlier_mask)
    assert (np.asarray(all_distances.inlier_mask) != inliers).mean() < 0.005
    assert not inliers[~scene_mask].any()


def test_the_far_side_of_a_thin_wall_is_no_partner():
    generator = np.random.default_rng(0)
    side = np.c_[generator.uniform(-20, 20, size=(600, 2)), np.zeros(600)].astype(np.float32)
    up = np.tile(np.float32([[0, 0, 1]]), (600, 1))
    wall = np.float32([[0, 0, 2]])
    plate, directions = np.concatenate([side[:400], side[:400] - wall]), np.concatenate([up[:400], -up[:400]])
    start = np.eye(4, dtype=np.float32)
    start[2, 3] = 2
    drawn = icp(plate, side, start, DIAMETER, up)
    np.testing.assert_allclose(np.asarray(drawn.T_scene_object)[2, 3], 2, atol=0.05)  # its far side lies on the scene
    right = icp(plate, side, start, DIAMETER, up, object_normals=directions)
    assert not right.converged  # of a start whose every partner disagrees
    seen = icp(plate, side, start, DIAMETER, up, object_mask=directions[:, 2] > 0, object_normals=directions)
    assert seen.converged
    np.testing.assert_allclose(np.asarray(seen.T_scene_object)[2, 3], 0, atol=0.05)
    with pytest.raises(InputError, match="object_normals is given without"):
        icp(plate, side, start, DIAMETER, config=IcpConfig(method="point_to_point"), object_normals=directions)
