"""What the measured surface says of poses: of the true one, of wrong ones, hidden ones, and of nothing."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.pose import SurfaceAgreement, SurfaceConfig, surface_agreement
from tests.reference.clouds import box_cloud

CAMERA = np.array([0.0, 0, -10], dtype=np.float32)  # the scene's axes are the camera's, its origin is the object's
TRUE = np.eye(4, dtype=np.float32)
compare = jax.jit(surface_agreement, static_argnames="config")


def turned(axis: int, degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    pose, others = np.eye(4, dtype=np.float32), [row for row in range(3) if row != axis]
    pose[np.ix_(others, others)] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return pose


TILT = turned(0, 25) @ turned(1, 30)


@pytest.fixture(scope="module")
def cloud() -> np.ndarray:
    cloud = box_cloud(0, 3000).astype(np.float32)
    cloud[:, :3] /= np.ptp(cloud[:, :3], axis=0).max()
    return cloud


def seen(cloud: np.ndarray, pose: np.ndarray = TILT) -> tuple[np.ndarray, np.ndarray]:
    """Return the points and normals that the camera sees of a convex object."""
    points, normals = cloud[:, :3] @ pose[:3, :3].T + pose[:3, 3], cloud[:, 3:] @ pose[:3, :3].T
    front = (normals * (points - CAMERA)).sum(axis=1) < 0
    return points[front], normals[front]


def agreement(cloud: np.ndarray, pose: np.ndarray, points: np.ndarray, normals: np.ndarray) -> SurfaceAgreement:
    everywhere = np.ones(len(points), dtype=bool)
    object_points, object_normals = cloud[:, :3], cloud[:, 3:]
    return compare(pose, object_points, object_normals, points, normals, everywhere, everywhere, CAMERA, np.float32(1))


def test_the_true_pose_is_confirmed_and_no_wrong_one_is(cloud: np.ndarray) -> None:
    points, normals = seen(cloud)
    right = agreement(cloud, TILT, points, normals)
    assert float(right.confirmed) > 0.97
    assert float(right.seen_through) < 0.02
    assert float(right.explained) > 0.97
    assert float(right.score) == pytest.approx(float(right.confirmed - right.seen_through + right.explained))
    for wrong in (TILT @ turned(0, 40), TILT @ turned(2, 90)):
        assert float(agreement(cloud, wrong, points, normals).score) < float(right.score) - 0.3


def test_a_pose_in_front_of_what_was_measured_is_seen_through(cloud: np.ndarray) -> None:
    points, normals = seen(cloud)
    nearer = TILT.copy()
    nearer[2, 3] -= 0.5
    found = agreement(cloud, nearer, points, normals)
    assert float(found.seen_through) > 0.5
    assert float(found.confirmed) < 0.2


def test_a_hidden_pose_is_neither_confirmed_nor_contradicted(cloud: np.ndarray) -> None:
    points, normals = seen(cloud)
    behind = TILT.copy()
    behind[2, 3] += 2
    found = agreement(cloud, behind, points, normals)
    assert float(found.seen_through) == 0
    assert float(found.confirmed) == 0
    assert float(found.explained) == 0


def test_opposite_normals_do_not_agree(cloud: np.ndarray) -> None:
    points, normals = seen(cloud)
    assert float(agreement(cloud, TILT, points, -normals).explained) < 0.1


@pytest.mark.parametrize("distance", [1.0, 1e3])
def test_lengths_have_no_unit_and_may_lie_far_from_the_camera(cloud: np.ndarray, distance: float) -> None:
    scale = np.float32(distance)
    points, normals = seen(cloud)
    pose = TILT.copy()
    pose[:3, 3] *= scale
    everywhere = np.ones(len(points), dtype=bool)
    found = compare(
        pose,
        cloud[:, :3] * scale,
        cloud[:, 3:],
        points * scale,
        normals,
        everywhere,
        everywhere,
        CAMERA * scale,
        scale,
    )
    for one, other in zip(found, agreement(cloud, TILT, points, normals), strict=True):
        assert float(one) == pytest.approx(float(other), abs=0.01)


@pytest.mark.parametrize("mask", [True, False])
def test_nothing_measured_or_taken_is_nothing_and_finite(cloud: np.ndarray, mask: bool) -> None:
    points, normals = seen(cloud)
    taken = jnp.zeros(len(points), dtype=bool)
    there = jnp.full(len(points), mask)
    arrays = cloud[:300, :3], cloud[:300, 3:], points, normals
    found = compare(TILT, *arrays, there, taken, CAMERA, np.float32(1))
    assert float(found.explained) == 0
    assert np.isfinite(np.array(found)).all()
    if not mask:
        assert float(found.confirmed) == 0
        assert float(found.seen_through) == 0


@pytest.mark.parametrize("values", [{"tolerance": 0.0}, {"min_cosine": 1.0}, {"facing": -0.1}])
def test_settings_without_meaning_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        SurfaceConfig(**values)
