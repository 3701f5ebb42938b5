"""The estimator of one part as a serialised program that runs without this package, wherever JAX does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
from jax import export as jax_export
from jaxtyping import Array, Bool, Float, UInt32

from kmn_jax.detection._bin_program import BinPosesConfig, device_calibration, poses_in_cloud
from kmn_jax.detection._depth_agreement import DepthImage, depth_buffer
from kmn_jax.detection._device_part import device_part
from kmn_jax.detection._estimator import PoseEstimator
from kmn_jax.detection._seeds import NUM_SEEDS
from kmn_jax.errors import InputError
from kmn_jax.files import write_whole
from kmn_jax.geometry import Intrinsics, PaddedCloud
from kmn_jax.objects import Part
from kmn_jax.platforms import for_any_platform

PLATFORMS = ("cpu", "cuda")
_SIDE = 512  # pixels along the depth image that is made of the points
_LEAST, _MOST = 2**12, 2**20  # points


def export_estimator(estimator: PoseEstimator, part: Part, path: str | Path, num_points: int = 65_536) -> int:
    """Write a program that finds a part in scans of up to `num_points` points, and return its bytes' number.

    The file is what `jax.export.deserialize` reads. The program takes points (num_points, 3) in the sensor's frame and
    the part's unit, float32, a mask (num_points,) of which are real and of the foreground, and a key (2,), uint32. It
    returns a dict of arrays with a row for each of s poses: T_scene_object (s, 4, 4), probability, num_inliers, and
    `keep`, true for the poses that stand, the most probable one of each place, which come first. It searches in one
    round, unlike `PoseEstimator.detect`. Raises InputError if the number of points is out of range or the file cannot
    be written.
    """
    if not _LEAST <= num_points <= _MOST:
        raise InputError(f"points is {num_points}, but must be between {_LEAST} and {_MOST}")
    if part.origin.any():
        raise InputError(
            f"{part.name} lies too far from the origin of its frame for the float32 poses of an exported program: move"
            " it there"
        )
    arguments = (
        jax.ShapeDtypeStruct((num_points, 3), jnp.float32),
        jax.ShapeDtypeStruct((num_points,), jnp.bool_),
        jax.ShapeDtypeStruct((2,), jnp.uint32),
    )
    program = jax.jit(_program(estimator, part))
    with for_any_platform():
        exported = jax_export.export(program, platforms=PLATFORMS)(*arguments)
    content = bytes(exported.serialize())
    write_whole(path, content)
    return len(content)


def _program(estimator: PoseEstimator, part: Part) -> Callable[..., dict[str, Array]]:
    """Return the search as a function of arrays only; all else is part of the program."""
    model, search = estimator.model, estimator.config.search
    config = BinPosesConfig(NUM_SEEDS, search=search.of_network(model.config))
    on_device, calibration = device_part(model, part), device_calibration(estimator.probabilities.found)

    def program(points: Float[Array, "r 3"], mask: Bool[Array, " r"], key: UInt32[Array, " 2"]) -> dict[str, Array]:
        mask = mask & jnp.isfinite(points).all(axis=1) & (points[:, 2] > 0)
        cloud = PaddedCloud(jnp.where(mask[:, None], points, 0), mask)
        camera = _fitting_camera(cloud)
        image = DepthImage(depth_buffer(cloud.points, mask, camera, (_SIDE, _SIDE)), camera)
        key = jax.random.wrap_key_data(key)
        poses = poses_in_cloud(*model, on_device, calibration, cloud, mask, image, key, config)
        return {
            "T_scene_object": poses.T_camera_object,
            "probability": poses.probability,
            "num_inliers": poses.num_inliers,
            "keep": poses.mask,
        }

    return program


def _fitting_camera(cloud: PaddedCloud) -> Intrinsics:
    """Return a camera at the sensor that sees all points."""
    depth = jnp.where(cloud.mask, cloud.points[:, 2], 1)
    directions = cloud.points[:, :2] / depth[:, None]
    low = jnp.where(cloud.mask[:, None], directions, jnp.inf).min(axis=0)
    high = jnp.where(cloud.mask[:, None], directions, -jnp.inf).max(axis=0)
    some = cloud.mask.any()
    low, high = jnp.where(some, low, 0), jnp.where(some, high, 1)
    focal = (_SIDE - 2) / jnp.maximum((high - low).max(), 1e-3)
    side = jnp.float32(_SIDE)
    return Intrinsics(focal, focal, 1 - low[0] * focal, 1 - low[1] * focal, side, side)
