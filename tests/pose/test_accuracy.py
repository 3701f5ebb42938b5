"""Errors with symmetries taken out, average recall and precision, against plain forms."""

from __future__ import annotations

from itertools import product

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kmn_jax.errors import InputError
from kmn_jax.pose import (
    LEFT_OUT,
    RIGHT,
    THRESHOLDS,
    WRONG,
    average_precision,
    average_recall,
    match_copies,
    symmetric_pose_error,
)
from tests.reference.meshes import pose, random_rotations

NO_AXES = np.zeros((0, 3), np.float32)
CENTER = np.float32([0.1, -0.2, 0.3])
QUARTERS = Rotation.from_euler("z", [[0], [90], [180], [270]], degrees=True).as_matrix()
TRUE, OTHER = (pose(place, turn) for place, turn in zip(((1, 2, 3), (1.1, 2, 3)), random_rotations(2, 9), strict=True))


def error(estimated: np.ndarray, rotations: np.ndarray, axes: np.ndarray = NO_AXES) -> tuple[float, float]:
    given = (estimated, TRUE, rotations, axes, CENTER)
    turn, shift = symmetric_pose_error(*(np.asarray(value, np.float32) for value in given))
    return float(np.degrees(turn)), float(shift)


def test_the_most_favourable_symmetry_counts() -> None:
    plain = [Rotation.from_matrix(OTHER[:3, :3].T @ TRUE[:3, :3] @ turn).magnitude() for turn in QUARTERS]
    turn, shift = error(OTHER, QUARTERS)
    assert turn == pytest.approx(np.degrees(min(plain)), abs=1e-3)
    centers = [T[:3, :3] @ CENTER + T[:3, 3] for T in (OTHER, TRUE)]
    assert shift == pytest.approx(np.linalg.norm(centers[0] - centers[1]), rel=1e-5)
    assert error(OTHER, QUARTERS[:1])[0] == pytest.approx(np.degrees(plain[0]), abs=1e-3)


def test_a_turn_about_a_continuous_axis_is_no_error_but_a_tilt_is() -> None:
    axis = np.array([[0.0, 0.6, 0.8]])
    spun = pose((0, 0, 0), Rotation.from_rotvec(2.1 * axis[0]).as_matrix())
    tilted = pose((0, 0, 0), Rotation.from_rotvec([np.radians(7), 0, 0]).as_matrix())
    assert error(TRUE @ tilted @ spun, np.eye(3)[None], axis)[0] == pytest.approx(7, abs=1e-3)
    over = pose((0, 0, 0), np.diag([1.0, -1, -1]))  # end over end, which this one does not look the same at
    assert error(TRUE @ over, np.eye(3)[None], axis)[0] == pytest.approx(180, abs=0.1)
    assert error(TRUE @ over, np.stack([np.eye(3), np.diag([1.0, -1, -1])]), axis)[0] == pytest.approx(0, abs=0.05)
    assert error(OTHER, np.eye(3)[None], np.eye(3))[0] == 0


def test_digits_are_kept_far_away_and_batches_agree() -> None:
    far = pose((4000, 0, 0)) @ TRUE
    near = pose((0.25, 0, 0)) @ far
    arrays = [np.float32(value) for value in (near, far, QUARTERS, NO_AXES, CENTER)]
    turn, shift = symmetric_pose_error(*arrays)
    assert (float(turn), float(shift)) == (pytest.approx(0, abs=1e-6), pytest.approx(0.25, rel=1e-3))
    several = jax.vmap(lambda T: symmetric_pose_error(T, *arrays[1:]))(np.stack([arrays[0], arrays[1]]))
    np.testing.assert_allclose(several[1], [shift, 0], atol=1e-6)
    double = [there @ pose((0, -5e6, 0)) for there in (near, far)]
    shift = symmetric_pose_error(*double, QUARTERS, NO_AXES, CENTER + np.array([0, 5e6, 0]))[1]
    assert float(shift) == pytest.approx(0.25, rel=1e-5)
    with pytest.raises(InputError, match="rotations is empty"):
        symmetric_pose_error(arrays[0], arrays[1], np.zeros((0, 3, 3)), NO_AXES, CENTER)
    with pytest.raises(InputError, match="rotations has shape"):
        symmetric_pose_error(arrays[0], arrays[1], np.eye(3, dtype=np.float32), NO_AXES, CENTER)


def test_recall_is_the_mean_over_thresholds() -> None:
    assert THRESHOLDS == (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)
    assert average_recall([0.0, 0.22, 0.6, np.inf]) == pytest.approx((10 + 6) / 40)
    with pytest.raises(InputError, match="errors is empty"):
        average_recall(np.zeros(0))
    with pytest.raises(InputError, match="errors holds NaN"):
        average_recall([0.1, np.nan])


def test_each_copy_is_matched_once_and_hidden_ones_are_left_out() -> None:
    errors = np.array([[0.04, 0.9, 0.9], [0.05, 0.9, 0.9], [0.9, 0.08, 0.02], [0.9, 0.9, 0.03], [0.9, 0.9, 0.01]])
    seen = np.array([True, True, False])
    # The second finds its copy taken; the third prefers one that counts; the fourth takes the hidden one.
    assert match_copies(errors, seen, 0.1).tolist() == [RIGHT, WRONG, RIGHT, LEFT_OUT, WRONG]
    assert match_copies(errors, seen, 0.05).tolist() == [RIGHT, WRONG, LEFT_OUT, WRONG, WRONG]
    assert match_copies(np.zeros((2, 0)), np.zeros(0, bool), 0.1).tolist() == [WRONG, WRONG]
    with pytest.raises(InputError, match="counted has shape"):
        match_copies(errors, seen[:2], 0.1)
    with pytest.raises(InputError, match="errors holds NaN"):
        match_copies([[np.nan, 0.1, 0.1]], seen, 0.1)


def plain_precision(scores: np.ndarray, right: np.ndarray, num_true: int) -> float:
    """Return average precision as it is defined, threshold by threshold."""
    total = 0.0
    for percent in range(101):
        best = 0.0
        for least in scores:
            taken = right[scores >= least]
            if 100 * taken.sum() >= percent * num_true:
                best = max(best, taken.mean())
        total += best
    return total / 101


@pytest.mark.parametrize(("seed", "count"), list(product(range(4), (1, 7, 40))))
def test_average_precision_against_its_definition(seed: int, count: int) -> None:
    generator = np.random.default_rng(seed)
    scores, right = generator.permutation(count) / count, generator.random(count) < 0.6
    num_true = int(right.sum()) + seed + 1
    assert average_precision(scores, right, num_true) == pytest.approx(plain_precision(scores, right, num_true))


def test_average_precision_at_its_ends() -> None:
    assert average_precision(np.array([0.9, 0.8]), np.array([True, True]), 2) == 1
    assert average_precision(np.array([0.9, 0.8]), np.array([False, False]), 2) == 0
    assert average_precision(np.zeros(0), np.zeros(0, bool), 2) == 0
    with pytest.raises(InputError, match="num_true is 0"):
        average_precision(np.zeros(0), np.zeros(0, bool), 0)
    with pytest.raises(InputError, match="2 detections are right, but num_true is only 1"):
        average_precision([0.9, 0.8], [True, True], 1)
    with pytest.raises(InputError, match="right has shape"):
        average_precision([0.9, 0.8], [True], 2)
    with pytest.raises(InputError, match="scores holds 1 values that are NaN"):
        average_precision([0.9, np.nan], [True, True], 2)
