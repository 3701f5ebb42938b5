"""In programs that turned on JAX's double precision, poses are found as in others, in single precision."""

from __future__ import annotations

import os
import subprocess
import sys

# A process of its own: that it is turned on holds for all that a process does.
FOUND = """
import jax
import jax.numpy as jnp
import numpy as np
from configs import find_config
from kmn_jax import InputError, PoseEstimator, find_matches, icp, kabsch, ransac
from kmn_jax.geometry import random_pose
from kmn_jax.train import train

jax.config.update("jax_disable_most_optimizations", True)


def kinds(tree):
    return {str(leaf.dtype) for leaf in jax.tree.leaves(tree)} - {"bool", "int32"}


points = np.float32(np.random.default_rng(0).normal(size=(60, 3)))
normals = points / np.linalg.norm(points, axis=1, keepdims=True)
pose = np.asarray(random_pose(jax.random.key(1), 0.5))
turned, faces = points @ pose[:3, :3].T + pose[:3, 3], normals @ pose[:3, :3].T
logits = np.float32(np.eye(60)) * 20
matches = find_matches(logits[:, 1::-1] * 0 + [[0, 1]], logits, turned, faces, points, normals, 3.0)
results = ransac(jax.random.key(0), matches), icp(points, turned, pose, 3.0, faces, object_normals=normals)
assert kinds((matches, results, kabsch(points, turned), pose)) == {"float32"}, kinds((matches, results))
assert max(abs(result.T_scene_object - pose).max() for result in results) < 1e-5
assert kabsch(points, turned, np.ones(60)).dtype == kabsch(points, turned, [1] * 60).dtype == jnp.float32
assert kabsch(points.astype(float), turned.astype(float)).dtype == jnp.float64

estimator = PoseEstimator.from_pretrained()
part = estimator.prepare("experiments/assets/industrial/gear_motor.stl")
scene = estimator.scene("experiments/assets/small_test_set/test/000002/depth/000003.png", part)
true = scene.truth[int(np.argmin([copy[2, 3] for copy in scene.truth]))]
pose = estimator.detect(part, scene, at=true[:3, 3] + 0.3 * part.diameter * np.array([0, 0, -1])).poses[0]
assert pose.probability > 0.9, pose
assert abs(pose.T_scene_object - true)[:3].max() < 1

try:
    train(find_config("debug"), "nowhere")
except InputError as error:
    assert str(error) == "training is in single precision: turn JAX_ENABLE_X64 off", error
else:
    raise AssertionError("it trains")
"""


def test_poses_are_found_in_double_precision_too() -> None:
    environment = os.environ | {"JAX_ENABLE_X64": "1"}
    done = subprocess.run([sys.executable, "-c", FOUND], capture_output=True, text=True, env=environment)
    assert not done.returncode, done.stderr
