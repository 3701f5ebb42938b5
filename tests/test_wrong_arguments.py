"""What pose functions and the estimator say of wrong arguments to callers whose calls no annotations are checked of."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields, is_dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import kmn_jax
from kmn_jax.errors import InputError, check_digits, check_whole, point_array, positive_scalar, rigid_pose
from kmn_jax.pose import add, discretise_symmetry, icp, kabsch, recall

# In a process of its own: in this one, the annotations of the package are checked first, with other errors.
CALLS = """
import jax
import numpy as np
import kmn_jax.detection as detection
from kmn_jax import ForegroundOptions, InputError
from kmn_jax.geometry import farthest_point_indices, k_nearest, rotate_vectors, transform_points
from kmn_jax.io import Scan
from kmn_jax.models import create_model
from kmn_jax.objects import ObjectConfig, load_object, make_part
from kmn_jax.pose import (
    IcpConfig, MatchConfig, average_precision, discretise_symmetry, find_matches, icp, match_copies, ransac,
    ransac_modes, recall,
)
from tests.reference.networks import TINY

digest, model = "0" * 64, create_model(TINY, jax.random.key(0))
estimator = detection.PoseEstimator(model, digest, None)
scan = Scan(np.ones((4, 3), np.float32), None, None, None, "mm")
nothing = Scan(np.zeros((0, 3), np.float32), None, None, None, "mm")
box = load_object("experiments/assets/industrial/gear_motor.stl", "mm", ObjectConfig(num_points=64))
part = make_part(box, model, digest)
points = np.ones((5, 3), np.float32)
calls = {
    "queries has shape": lambda: k_nearest(points, points[:, :2], 2),
    "points has shape": lambda: transform_points(np.eye(4), points[0]),
    "points is a list": lambda: transform_points(np.eye(4), [[0.0, 0.0, 0.0]]),
    "vectors has shape": lambda: rotate_vectors(np.eye(4), np.ones((5, 6))),
    "T_target_source has shape": lambda: transform_points(np.eye(3), points),
    "points has shape (5, 2)": lambda: farthest_point_indices(points[:, :2], 2),
    "right has dtype": lambda: average_precision([0.5], [1.0], 1),
    "errors has shape": lambda: match_copies([0.5], [True], 0.1),
    "threshold is 0": lambda: recall(np.ones(3), 1, 0),
    "a str is no Part": lambda: estimator.detect("part.stl", scan),
    "a NoneType is no Part": lambda: estimator.scene(scan, [None]),
    "a Scan is no Part": lambda: estimator.detect(scan, scan),
    "a str is no Part ": lambda: estimator.detect("", scan),
    "at is not an array": lambda: estimator.detect([part], scan, at=[[1, 2, 3], [1, 2]]),
    "the scan has no points": lambda: estimator.scene(nothing, part),
    "background is a str": lambda: estimator.scene(scan, part, background=ForegroundOptions("empty.ply")),
    "background is a Scan": lambda: estimator.scene(scan, part, background=scan),
    "grasps are a int": lambda: estimator.detect(part, scan, grasps=3),
    "roi (xmin ymin zmin xmax ymax zmax) must be 6 finite numbers": lambda: ForegroundOptions(roi=[0, 0, 0, 1, 1]),
    "the mesh's triangles must be": lambda: estimator.prepare((points, [[0.5, 1, 2]])),
    "count is 2.5": lambda: discretise_symmetry([0, 0, 1], [0, 0, 0], 2.5),
    "num_true is '2'": lambda: average_precision([], [], "2"),
    "threshold is nan": lambda: match_copies([[0.5]], [True], float("nan")),
    "threshold is not an array": lambda: recall(np.ones(3), 1, "x"),
    "config must be of class MatchConfig, not dict": lambda: find_matches(*[points] * 6, 1.0, config={"capacity": 9}),
    "config must be of class RansacConfig, not IcpConfig": lambda: ransac(jax.random.key(0), None, IcpConfig()),
    "config must be of class RansacConfig, not dict": lambda: ransac_modes(jax.random.key(0), None, 2, {}),
    "count is 1.5": lambda: ransac_modes(jax.random.key(0), None, 1.5),
    "config must be of class IcpConfig, not str": lambda: icp(points, points, np.eye(4), 1.0, config="robust"),
    "config must be of class DetectConfig, not str": lambda: detection.PoseEstimator.from_pretrained(config="fast"),
    "config must be of class DetectConfig, not dict": lambda: detection.PoseEstimator.from_pretrained(config={}),
}
for begins, call in calls.items():
    try:
        print("no error:", begins, call())
    except InputError as error:
        print("as said" if str(error).startswith(begins) else f"{begins}: {error}")
"""


def test_what_annotations_do_not_check_is_one_sentence() -> None:
    done = subprocess.run([sys.executable, "-c", CALLS], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["as said"] * CALLS.count(": lambda:")


def test_whole_numbers() -> None:
    for good in (0, 3, np.int64(2)):
        check_whole(good, "x", 0, 3)
    for bad in (-1, 4, 1.0, True, "1", None):
        with pytest.raises(InputError, match=r"x is .*, but must be a whole number between 0 and 3"):
            check_whole(bad, "x", 0, 3)
    with pytest.raises(InputError, match="of 1 or more"):
        check_whole(0, "x", 1)


def test_whole_numbers_are_as_exact_as_fractions_and_checked_in_traces() -> None:
    large = 5_000_000_000  # more than int32 holds
    T = np.eye(4, dtype=int)
    T[0, 3] = large
    assert float(rigid_pose(T, "T")[0, 3]) == float(positive_scalar(large, "d")) == large
    assert float(discretise_symmetry([0, 0, 1], [large, 0, 0], 2)[1, 0, 3]) == pytest.approx(2 * large, rel=1e-6)
    assert float(recall([0.4e9], large)) == 1
    points = np.float32(np.random.default_rng(0).normal(size=(4, 3)))
    with pytest.raises(InputError, match="T_estimated is not a rigid pose"):
        jax.jit(lambda some: add(2 * np.eye(4, dtype=int), np.eye(4), some))(points)
    with pytest.raises(InputError, match="size must be above zero"):
        jax.jit(lambda errors: recall(errors, -1))(np.float32([0.1, 0.2]))
    with pytest.raises(InputError, match="axis is zero"):
        jax.jit(lambda: discretise_symmetry([0, 0, 0], [0, 0, 0], 2))()
    turns = jax.jit(lambda: discretise_symmetry([0.0, 0, 1], [0, 0, 0], 2))()
    np.testing.assert_allclose(turns[1], np.diag([-1.0, -1, 1, 1]), atol=1e-6)
    by_thresholds = jax.vmap(lambda threshold: recall(np.float32([0.05, 0.2]), 1.0, threshold))
    np.testing.assert_array_equal(by_thresholds(jnp.array([0.1, 0.3])), [0.5, 1])


def test_constant_weights_are_those_of_a_trace_too() -> None:
    points = np.float32(np.random.default_rng(0).normal(size=(5, 3)))
    weights = np.float32([1, 1, 0, 1, 1])
    traced = jax.jit(lambda some: kabsch(some, points, weights))(points + 1)
    np.testing.assert_allclose(traced, kabsch(points + 1, points, weights), atol=1e-6)


def test_clouds_that_became_one_place_are_refused_by_what_they_show() -> None:
    points = np.float32(np.random.default_rng(0).normal(size=(30, 3)))
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    for far in (1e7, 1e8, 1e12):
        place = points + np.float32(far)
        with pytest.raises(InputError, match=r"target lies .* from the origin, but is only .* large"):
            kabsch(points, place)
        with pytest.raises(InputError, match=r"scene_points lies .* from the origin, but is only 9 large"):
            icp(points, place, np.eye(4), 9, normals)
    assert kabsch(np.full((4, 3), 7.0), np.full((4, 3), 9.0)).shape == (4, 4)  # one place each, at any size


def test_points_that_float32_cannot_hold_are_refused() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert point_array(points + 1e4, "x").shape == (20, 3)
    assert point_array(np.full((4, 3), 1e9), "x", 4).shape == (4, 3)  # one place has no shape to lose
    with pytest.raises(InputError, match=r"x lies 1e\+07 from the origin, but is only .* large"):
        point_array(points + np.array([1e7, 0, 0]), "x")
    padded = np.concatenate([points, np.full((1, 3), 1e12)])
    assert point_array(padded, "x", mask=jnp.arange(21) < 20).shape == (21, 3)
    check_digits(np.zeros((0, 3)), "x")


def test_records_of_arrays_are_compared_by_what_they_are() -> None:
    """Comparison by value would raise for arrays; each such record is equal to itself alone, and can be hashed."""
    records = [value for name in kmn_jax.__all__ if is_dataclass(value := getattr(kmn_jax, name))]
    of_arrays = [one for one in records if any("Float[" in str(field.type) for field in fields(one))]
    assert {one.__name__ for one in of_arrays} >= {"Part", "Scan", "Detection", "Detections"} & set(kmn_jax.__all__)
    assert [one.__name__ for one in of_arrays if one.__eq__ is not object.__eq__] == []
