"""A registration problem solved end to end: logits -> matches -> RANSAC -> ICP -> pose against the truth.

python -m experiments.demo [--seed 0] [--wrong-share 0.7] [--noise 0.005]

The part is a bracket, the scene what a camera would see of it (front faces, sensor noise) in front of clutter.
No trained network ships yet, so the logits are drawn as a network of the given quality would return them.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from kmn_jax.checks import InputError
from kmn_jax.geometry import farthest_point_indices, pose_error, random_rotation, rotate_vectors, transform_points
from kmn_jax.geometry.se3 import from_rotation_translation
from kmn_jax.pose import adi, diameter, find_matches, icp, is_correct, ransac

_NUM_KEYPOINTS = 20
# Three plates of a bracket: centre and size of each box, in millimetres.
_PLATES = (((0, 0, 2), (60, 40, 4)), ((-28, 0, 20), (4, 40, 40)), ((10, 18, 10), (30, 4, 20)))


@dataclass(frozen=True)
class DemoConfig:
    """What is drawn.

    Attributes:
        seed: of everything that is random.
        wrong_share: share of object points whose best keypoint is a random one.
        noise: deviation of the scene points, as a fraction of the object's diameter.
    """

    seed: int = 0
    wrong_share: float = 0.7
    noise: float = 0.005

    def __post_init__(self) -> None:
        if not 0 <= self.wrong_share <= 1:
            raise InputError(f"wrong_share is {self.wrong_share}, but must be in [0, 1]")
        if not self.noise >= 0:
            raise InputError(f"noise is {self.noise}, but cannot be negative")


def main(config: DemoConfig) -> int:
    """Solve one problem and print it; 0 if the pose is right."""
    keys = jax.random.split(jax.random.key(config.seed), 6)
    points, normals = (jnp.asarray(x) for x in bracket(config.seed, 2048))
    size = diameter(points)
    keypoints = farthest_point_indices(points, _NUM_KEYPOINTS)
    T_truth = from_rotation_translation(random_rotation(keys[0]), jnp.array([20.0, -10.0, 400.0]))
    scene_points, scene_normals, on_object = scene(config, keys[1], T_truth, float(size))
    segmentation, keypoint_logits = simulated_logits(
        config, keys[2], scene_points, on_object, transform_points(T_truth, points[keypoints])
    )
    print(f"part: {len(points)} points, diameter {float(size):.1f} mm, {_NUM_KEYPOINTS} keypoints")
    print(f"scene: {len(scene_points)} points, {int(on_object.sum())} of them on the part")

    def solve() -> tuple:
        matches = find_matches(
            segmentation,
            keypoint_logits,
            scene_points,
            scene_normals,
            points[keypoints],
            normals[keypoints],
            size,
        )
        coarse = ransac(keys[3], matches)
        fine = icp(points, scene_points, coarse.T_scene_object, size, scene_normals=scene_normals)
        return matches, coarse, jax.block_until_ready(fine)

    start = time.perf_counter()
    solve()
    compiled = time.perf_counter()
    matches, coarse, fine = solve()
    print(f"matches: {int(matches.mask.sum())}, compilation {compiled - start:.1f} s, solved again in", end=" ")
    print(f"{1e3 * (time.perf_counter() - compiled):.0f} ms")
    if not bool(coarse.converged):
        print(f"no pose: {coarse.reason}")
        return 1
    report("RANSAC", coarse.T_scene_object, T_truth)
    report("+ ICP", fine.T_scene_object, T_truth)
    with np.printoptions(precision=3, suppress=True):
        print(f"\nT_scene_object, estimated (mm):\n{np.asarray(fine.T_scene_object)}")
        print(f"T_scene_object, true (mm):\n{np.asarray(T_truth)}")
    error = adi(fine.T_scene_object, T_truth, points)
    right = bool(is_correct(error, size))
    print(f"\nADI {float(error):.2f} mm, {100 * float(error / size):.1f}% of the diameter: ", end="")
    print("right" if right else "wrong")
    return 0 if right else 1


def bracket(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points on the bracket's outer surface, (n, 3) in mm, and outward normals, (n, 3)."""
    rng = np.random.default_rng(seed)
    centers, sizes = np.array(_PLATES, dtype=np.float64).transpose(1, 0, 2)
    areas = np.stack([sizes[:, 1] * sizes[:, 2], sizes[:, 0] * sizes[:, 2], sizes[:, 0] * sizes[:, 1]], axis=1)
    face = rng.choice(9, size=4 * count, p=areas.ravel() / areas.sum())
    plate, axis = np.divmod(face, 3)
    rows = np.arange(len(face))
    place = rng.random((len(face), 3)) - 0.5
    side = rng.choice([-1.0, 1.0], len(face))
    place[rows, axis] = side / 2
    points = centers[plate] + place * sizes[plate]
    normals = np.zeros_like(points)
    normals[rows, axis] = side
    depth = np.abs(points[:, None] - centers[None]) - sizes[None] / 2
    hidden = (depth.max(axis=2) < -1e-6).any(axis=1)
    return points[~hidden][:count].astype(np.float32), normals[~hidden][:count].astype(np.float32)


def scene(
    config: DemoConfig, key: jax.Array, T_scene_object: jax.Array, size: float
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return 2048 scene points, their normals, and which of them lie on the part; the camera is at the origin."""
    keys = jax.random.split(key, 4)
    points, normals = (jnp.asarray(x) for x in bracket(config.seed + 1, 4096))
    points, normals = transform_points(T_scene_object, points), rotate_vectors(T_scene_object, normals)
    front = jnp.flatnonzero((points * normals).sum(axis=1) < 0)[:1400]
    clutter = T_scene_object[:3, 3][None, :] + size * jax.random.uniform(keys[0], (2048 - len(front), 3), minval=-0.7)
    clutter_normals = jax.random.normal(keys[1], clutter.shape)
    clutter_normals = clutter_normals / jnp.linalg.norm(clutter_normals, axis=1, keepdims=True)
    clutter_normals = jnp.where((clutter * clutter_normals).sum(axis=1, keepdims=True) > 0, -1, 1) * clutter_normals
    everything = jnp.concatenate([points[front], clutter])
    everything = everything + config.noise * size * jax.random.normal(keys[2], everything.shape)
    all_normals = jnp.concatenate([normals[front], clutter_normals])
    order = jax.random.permutation(keys[3], len(everything))
    return everything[order], all_normals[order], (jnp.arange(len(everything)) < len(front))[order]


def simulated_logits(
    config: DemoConfig, key: jax.Array, scene_points: jax.Array, on_object: jax.Array, keypoints_scene: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return segmentation (n, 2) and keypoint (n, k) logits with the given share of wrong points."""
    wrong_key, label_key, flip_key = jax.random.split(key, 3)
    nearest = ((scene_points[:, None] - keypoints_scene[None]) ** 2).sum(axis=2).argmin(axis=1)
    wrong = jax.random.bernoulli(wrong_key, config.wrong_share, nearest.shape)
    label = jnp.where(wrong, jax.random.randint(label_key, nearest.shape, 0, len(keypoints_scene)), nearest)
    flipped = jax.random.bernoulli(flip_key, 0.05, on_object.shape) ^ on_object
    return 4 * jax.nn.one_hot(flipped.astype(int), 2), 4 * jax.nn.one_hot(label, len(keypoints_scene))


def report(name: str, estimate: jax.Array, truth: jax.Array) -> None:
    """Print the error of one pose."""
    angle, distance = pose_error(estimate, truth)
    print(f"{name:7s} off by {float(jnp.rad2deg(angle)):.2f} degrees and {float(distance):.2f} mm")


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(DemoConfig)))
    except InputError as problem:
        print(f"demo: {problem}", file=sys.stderr)
        sys.exit(2)
