"""A whole bin in one compiled call: depth image in, ranked poses out, and nothing goes through the host in between.

The fast sibling of `detect`, which searches in rounds until the foreground is covered, compares turned forms of a pose
and refines on more points. Here one round of seeds is searched, each with the pose that its evidence makes likeliest.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.detection._calibration import Calibration, CalibrationArrays
from kmn_jax.detection._crop_search import CropPoses
from kmn_jax.detection._depth_agreement import DepthImage
from kmn_jax.detection._device_part import DevicePart
from kmn_jax.detection._mapping import map_real
from kmn_jax.detection._search import SearchConfig, search_one
from kmn_jax.detection._seeds import spread_seeds
from kmn_jax.detection._selection import select
from kmn_jax.errors import InputError
from kmn_jax.geometry import PaddedCloud, depth_to_points, spread_rows
from kmn_jax.typing import PRNGKey


@dataclass(frozen=True)
class BinPosesConfig:
    """How a bin is searched in one call; `search` is that of a network, see `SearchConfig.of_network`."""

    num_seeds: int = 32  # crops that are searched: more than copies that may be seen, as some share one
    max_points: int = 32_768  # of the image that are kept, evenly over all that were measured
    search: SearchConfig = field(default_factory=SearchConfig)

    def __post_init__(self) -> None:
        if self.num_seeds < 1 or self.max_points < self.num_seeds:
            raise InputError(
                f"num_seeds = {self.num_seeds} must be 1 or more, and max_points = {self.max_points} no fewer"
            )


class BinPoses(NamedTuple):
    """Poses from the likeliest on, one for each copy, in the camera's frame and the depth image's unit."""

    T_camera_object: Float[Array, "s 4 4"]  # the identity where there is none
    probability: Float[Array, " s"]  # of being right; 0 where there is none
    num_inliers: Int[Array, " s"]  # matches that agree
    mask: Bool[Array, " s"]  # which there are
    overflow: Bool[Array, ""]  # more points were measured than are kept, so the image was thinned out


def device_calibration(calibration: Calibration) -> CalibrationArrays:
    """Put a calibration onto the device."""
    leaves = calibration.arrays()
    return CalibrationArrays(*(jnp.asarray(leaf, jnp.float32 if leaf.dtype.kind == "f" else None) for leaf in leaves))


@partial(jax.jit, static_argnames=("graphdef", "config"))
def bin_poses(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: DevicePart,
    calibration: CalibrationArrays,
    image: DepthImage,
    foreground: Bool[Array, "h w"],
    key: PRNGKey,
    config: BinPosesConfig,
) -> BinPoses:
    """Return the poses of a part's copies in a depth image (h, w), zero where nothing was measured.

    Seeds lie where `foreground` is true. An image without any measured foreground has no poses. The same inputs and
    key give the same bits on one device.
    """
    cloud, is_seed, overflow = _cloud(image, foreground, config.max_points)
    found = poses_in_cloud(graphdef, parameters, part, calibration, cloud, is_seed, image, key, config)
    return found._replace(overflow=overflow)


def poses_in_cloud(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: DevicePart,
    calibration: CalibrationArrays,
    cloud: PaddedCloud,
    is_seed: Bool[Array, " r"],
    image: DepthImage,
    key: PRNGKey,
    config: BinPosesConfig,
) -> BinPoses:
    """Return the same for points in the camera's frame, of which some may be seeds."""
    count = config.num_seeds
    rows, real = spread_seeds(cloud, is_seed, count)

    def search(row: Int[Array, ""], key: PRNGKey) -> tuple[CropPoses, Float[Array, "h f"]]:
        return search_one(graphdef, parameters, part, cloud, image, row, key, config.search)

    found, evidence = map_real(search, real, rows, jax.random.split(key, count))
    with jax.default_matmul_precision("highest"):
        logits = jnp.where(found.poses.converged, calibration.logits(evidence), -jnp.inf)

    best = jnp.argmax(logits, axis=1)
    poses, logits = jax.tree.map(lambda leaf: leaf[jnp.arange(count), best], (found.poses, logits))
    probability = jax.nn.sigmoid(logits)
    kept = select(poses.T_scene_object, probability, jnp.isfinite(logits), part).kept
    order = jnp.argsort(jnp.where(kept, -probability, jnp.inf), stable=True)
    kept = kept[order]
    return BinPoses(
        jnp.where(kept[:, None, None], poses.T_scene_object[order], jnp.eye(4, dtype=jnp.float32)[None]),
        jnp.where(kept, probability[order], 0),
        jnp.where(kept, poses.num_inliers[order], 0),
        kept,
        jnp.array(False),
    )


def _cloud(
    image: DepthImage, foreground: Bool[Array, "h w"], count: int
) -> tuple[PaddedCloud, Bool[Array, " r"], Bool[Array, ""]]:
    """Return the points of a depth image in the camera's frame, thinned out to a capacity; which are foreground."""
    fx, fy, cx, cy, *_ = image.camera
    zero, one = jnp.float32(0), jnp.float32(1)
    points = depth_to_points(image.depth, jnp.array([[fx, zero, cx], [zero, fy, cy], [zero, zero, one]])).reshape(-1, 3)
    measured = points[:, 2] > 0
    rows, real = spread_rows(measured, count)
    overflow = measured.sum(dtype=jnp.int32) > rows.shape[0]
    return PaddedCloud(jnp.where(real[:, None], points[rows], 0), real), real & foreground.reshape(-1)[rows], overflow
