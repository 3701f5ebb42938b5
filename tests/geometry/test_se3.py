"""Poses, rotations and quaternions: group laws, accuracy near 0 and pi, finite gradients."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax import geometry as g

SEEDS = range(5)
IDENTITY = np.eye(3, dtype=np.float32)
jit_pose = jax.jit(g.random_pose)
jit_rotation = jax.jit(g.random_rotation)
to_quaternion = jax.jit(g.matrix_to_quaternion)
to_matrix = jax.jit(g.quaternion_to_matrix)
angle_between = jax.jit(g.rotation_angle_between)
angle_gradient = jax.jit(jax.grad(lambda turn, R: g.rotation_angle_between(R, about_axis(turn) @ R)))


quaternion_jacobian = jax.jit(jax.jacrev(g.matrix_to_quaternion))
gradient_of_first = jax.jit(jax.grad(g.rotation_angle_between))
pose_error = jax.jit(g.pose_error)
compose, inverse, transform = jax.jit(g.compose), jax.jit(g.inverse), jax.jit(g.transform_points)
rotate, from_quaternion = jax.jit(g.rotate_vectors), jax.jit(g.from_quaternion_translation)
from_rotation = jax.jit(g.from_rotation_translation)


def about_axis(turn: jax.Array) -> jax.Array:
    """Return the rotation matrix of the quaternion (1, turn)."""
    return g.quaternion_to_matrix(jnp.concatenate([jnp.ones(1), turn]))


@jax.jit
def there_and_back(turn: jax.Array) -> jax.Array:
    """Return the quaternion of the matrix of the quaternion (1, turn)."""
    return g.matrix_to_quaternion(about_axis(turn))


forward_jacobian, reverse_jacobian = jax.jit(jax.jacfwd(there_and_back)), jax.jit(jax.jacrev(there_and_back))


def axis_angle(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return Rodrigues' rotation in float64."""
    x, y, z = axis / np.linalg.norm(axis)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


@pytest.mark.parametrize("seed", SEEDS)
def test_compose_applies_the_right_pose_first(seed: int) -> None:
    T_a_b, T_b_c = jit_pose(jax.random.key(seed)), jit_pose(jax.random.key(seed + 100))
    points = np.random.default_rng(seed).normal(size=(7, 3)).astype(np.float32)
    both = transform(compose(T_a_b, T_b_c), points)
    np.testing.assert_allclose(both, transform(T_a_b, transform(T_b_c, points)), atol=1e-5)
    expected = points @ np.asarray(T_b_c)[:3, :3].T + np.asarray(T_b_c)[:3, 3]
    np.testing.assert_allclose(transform(T_b_c, points), expected, atol=1e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_inverse_undoes_a_pose_from_both_sides(seed: int) -> None:
    pose = jit_pose(jax.random.key(seed), 10.0)
    np.testing.assert_allclose(compose(inverse(pose), pose), np.eye(4), atol=1e-5)
    np.testing.assert_allclose(compose(pose, inverse(pose)), np.eye(4), atol=1e-5)
    np.testing.assert_array_equal(np.asarray(inverse(pose))[3], [0, 0, 0, 1])


def test_vectors_are_rotated_but_not_moved() -> None:
    pose = from_rotation(IDENTITY, np.float32([1, 2, 3]))
    vectors = np.float32([[0, 0, 1], [1, 0, 0]])
    np.testing.assert_array_equal(rotate(pose, vectors), vectors)
    np.testing.assert_array_equal(transform(pose, vectors), vectors + np.float32([1, 2, 3]))


def test_a_known_quaternion_turns_the_known_way() -> None:
    quarter_turn_about_z = np.float32([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    pose = from_quaternion(quarter_turn_about_z, np.float32([0, 0, 5]))
    np.testing.assert_allclose(transform(pose, np.float32([[1, 0, 0]])), [[0, 1, 5]], atol=1e-6)


@pytest.mark.parametrize("seed", SEEDS)
def test_quaternions_and_matrices_are_two_forms_of_one_rotation(seed: int) -> None:
    rotation = jit_rotation(jax.random.key(seed))
    quaternion = np.asarray(to_quaternion(rotation))
    assert quaternion[0] >= 0
    np.testing.assert_allclose(np.linalg.norm(quaternion), 1, atol=1e-6)
    np.testing.assert_allclose(to_matrix(quaternion), rotation, atol=1e-6)
    np.testing.assert_allclose(to_matrix(-3 * quaternion), rotation, atol=1e-6)


def test_the_zero_quaternion_is_the_identity_and_has_a_finite_gradient() -> None:
    zero = np.zeros(4, np.float32)
    np.testing.assert_array_equal(to_matrix(zero), np.eye(3))
    assert np.isfinite(jax.jit(jax.jacrev(g.quaternion_to_matrix))(zero)).all()


@pytest.mark.parametrize("angle", [0, 1e-4, 1e-2, 1, np.pi / 2, 2, np.pi - 1e-2, np.pi - 1e-4, np.pi])
@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [-1, 2, 0.5]])
def test_conversion_and_angle_are_accurate_at_every_angle(axis: list[float], angle: float) -> None:
    rotation = axis_angle(np.array(axis), angle)
    np.testing.assert_allclose(to_matrix(to_quaternion(rotation.astype(np.float32))), rotation, atol=5e-7)
    base = axis_angle(np.array([0.3, -1, 2]), 0.7)
    found = angle_between(base.astype(np.float32), (base @ rotation).astype(np.float32))
    np.testing.assert_allclose(found, angle, atol=1e-6)


@pytest.mark.parametrize("seed", SEEDS)
def test_equal_rotations_differ_by_less_than_a_microradian(seed: int) -> None:
    rotation = jit_rotation(jax.random.key(seed))
    assert angle_between(rotation, rotation) < 1e-6


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_convert_exactly_with_finite_gradients(axis: int) -> None:
    half_turn = 2 * np.diag(IDENTITY[axis]) - IDENTITY  # trace -1
    quaternion = to_quaternion(half_turn)
    np.testing.assert_array_equal(np.abs(quaternion), np.eye(4)[axis + 1])
    for rotation in (half_turn, IDENTITY):
        assert np.isfinite(quaternion_jacobian(rotation)).all()
        assert np.isfinite(gradient_of_first(IDENTITY, rotation)).all()


def test_the_angle_between_equal_rotations_has_zero_gradient() -> None:
    np.testing.assert_array_equal(angle_gradient(np.zeros(3, np.float32), IDENTITY), 0)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_gradient_of_the_angle_is_the_axis(seed: int) -> None:
    turn = np.float32(0.5 * np.random.default_rng(seed).normal(size=3))
    gradient = angle_gradient(turn, jit_rotation(jax.random.key(seed + 100)))
    # The angle of the quaternion (1, turn) is 2 atan |turn|.
    length = np.linalg.norm(turn)
    np.testing.assert_allclose(gradient, 2 / (1 + length**2) * turn / length, atol=1e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_forward_and_reverse_derivatives_of_the_conversion_agree_with_finite_differences(seed: int) -> None:
    turn, direction = np.random.default_rng(seed).normal(size=(2, 3)).astype(np.float32)
    forward, reverse = np.asarray(forward_jacobian(turn)), reverse_jacobian(turn)
    np.testing.assert_allclose(forward, reverse, atol=1e-5)
    step = np.float32(1e-2)
    after, before = (np.asarray(there_and_back(turn + way * direction)) for way in (step, -step))
    difference = (after - before) / (2 * step)
    np.testing.assert_allclose(forward @ direction, difference, atol=2e-3)  # step^2 and float32 over the step


def test_pose_error_is_the_angle_and_the_distance() -> None:
    turned = axis_angle(np.array([0, 0, 1]), 0.3).astype(np.float32)
    T_a, T_b = from_rotation(IDENTITY, np.float32([1, 0, 0])), from_rotation(turned, np.float32([1, 3, 4]))
    angle, distance = pose_error(T_a, T_b)
    np.testing.assert_allclose(angle, 0.3, atol=1e-6)
    np.testing.assert_allclose(distance, 5, atol=1e-6)
    assert np.isfinite(jax.jit(jax.grad(lambda a, b: g.pose_error(a, b)[1]))(T_a, T_a)).all()


def test_random_rotations_are_proper_and_uniform() -> None:
    rotations = np.asarray(jax.jit(jax.vmap(g.random_rotation))(jax.random.split(jax.random.key(0), 4000)))
    np.testing.assert_allclose(
        rotations @ rotations.swapaxes(1, 2), np.broadcast_to(np.eye(3), (4000, 3, 3)), atol=1e-5
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-5)
    # Uniform: every entry has mean 0 and variance 1/3, here within 4 standard errors.
    assert np.abs(rotations.mean(axis=0)).max() < 4 / np.sqrt(3 * 4000)
    np.testing.assert_allclose((rotations**2).mean(axis=0), 1 / 3, atol=4 * 0.3 / np.sqrt(4000))
    # and the angle's density is (1 - cos) / pi, whose mean is pi/2 + 2/pi.
    angles = np.asarray(jax.jit(jax.vmap(lambda R: g.rotation_angle_between(jnp.eye(3), R)))(jnp.asarray(rotations)))
    np.testing.assert_allclose(angles.mean(), np.pi / 2 + 2 / np.pi, atol=4 * angles.std() / np.sqrt(4000))


def test_random_pose_scales_its_translation() -> None:
    poses = np.asarray(
        jax.jit(jax.vmap(lambda key: g.random_pose(key, 5.0)))(jax.random.split(jax.random.key(0), 2000))
    )
    np.testing.assert_allclose(poses[:, :3, 3].std(), 5, rtol=0.05)
    np.testing.assert_array_equal(poses[:, 3], np.broadcast_to([0, 0, 0, 1], (2000, 4)))


def test_vmap_equals_a_loop() -> None:
    keys = jax.random.split(jax.random.key(0), 4)
    poses = np.asarray(jax.jit(jax.vmap(g.random_pose))(keys))
    angles, distances = jax.device_get(jax.jit(jax.vmap(g.pose_error))(poses, poses[::-1]))
    for i in range(4):
        angle, distance = pose_error(poses[i], poses[3 - i])
        np.testing.assert_allclose([angles[i], distances[i]], [angle, distance], atol=1e-6)
