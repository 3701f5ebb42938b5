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

from kmn_jax.detection._calibrate import Calibration
from kmn_jax.detection._candidates import surfels_of
from kmn_jax.detection._evidence import Sight, evidence_of
from kmn_jax.detection._scan_crop import SceneArrays
from kmn_jax.detection._search import SearchConfig, crop_features, each, search, seed_keys, spread_rows, spread_seeds
from kmn_jax.detection._select import SelectConfig, overlap, padded_symmetries, same_place
from kmn_jax.detection._verify import VerifyConfig
from kmn_jax.errors import InputError
from kmn_jax.geometry import depth_to_points, transform_points
from kmn_jax.models import Model
from kmn_jax.objects import Part, PartArrays, arrays_of
from kmn_jax.pose import mssd
from kmn_jax.simulate import Surfels
from kmn_jax.typing import Pose, PRNGKey, Scalar


@dataclass(frozen=True)
class BinPosesConfig:
    """How a bin is searched in one call."""

    num_seeds: int = 32  # crops that are searched: more than copies that may be seen, as some share one
    max_points: int = 32_768  # of the image that are kept, evenly over all that were measured
    search: SearchConfig = field(default_factory=SearchConfig)
    verify: VerifyConfig = field(default_factory=VerifyConfig)
    select: SelectConfig = field(default_factory=SelectConfig)

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        if self.num_seeds < 1 or self.max_points < self.num_seeds:
            raise InputError(
                f"num_seeds = {self.num_seeds} must be 1 or more, and max_points = {self.max_points} no fewer"
            )


class BinPart(NamedTuple):
    """All that the call needs of a part, on the device; lengths in the depth image's unit."""

    arrays: PartArrays
    surfels: Surfels
    symmetries: Float[Array, "t 4 4"]
    reach: Scalar  # poses whose surfaces are nowhere further apart are one
    weights: Float[Array, " f"]  # of the evidence, see `Calibration`
    bias: Scalar


class BinPoses(NamedTuple):
    """Poses from the likeliest on, one for each copy, in the camera's frame and the depth image's unit."""

    T_camera_object: Float[Array, "s 4 4"]  # the identity where there is none
    probability: Float[Array, " s"]  # of being right; 0 where there is none
    num_inliers: Int[Array, " s"]  # matches that agree
    mask: Bool[Array, " s"]  # which there are
    overflow: Bool[Array, ""]  # more points were measured than are kept, so the image was thinned out


def bin_part(model: Model, part: Part, calibration: Calibration, config: BinPosesConfig) -> BinPart:
    """Put a part onto the device, once for all images; its lengths must be in their unit."""
    return BinPart(
        arrays_of(model, part),
        surfels_of(part),
        padded_symmetries(part),
        jnp.float32(same_place(part, config.select)),
        jnp.asarray(calibration.weights, dtype=jnp.float32),
        jnp.float32(calibration.bias),
    )


@partial(jax.jit, static_argnames=("graphdef", "num_points", "config"))
def bin_poses(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: BinPart,
    sight: Sight,
    foreground: Bool[Array, "h w"],
    key: PRNGKey,
    num_points: int,
    config: BinPosesConfig = BinPosesConfig(),
) -> BinPoses:
    """Return the poses of a part's copies in a depth image (h, w), zero where nothing was measured.

    Seeds lie where `foreground` is true. `num_points` of a crop are as many as the network was made for. An image
    without any measured foreground has no poses. The same inputs and key give the same bits on one device.
    """
    scene, is_seed, overflow = _scene(sight, foreground, config.max_points)
    found = poses_in_scene(graphdef, parameters, part, scene, is_seed, sight, key, num_points, config)
    return found._replace(overflow=overflow)


def poses_in_scene(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: BinPart,
    scene: SceneArrays,
    is_seed: Bool[Array, " r"],
    sight: Sight,
    key: PRNGKey,
    num_points: int,
    config: BinPosesConfig,
) -> BinPoses:
    """Return the same for points in the camera's frame, of which some may be seeds."""
    rows, real = spread_seeds(scene, is_seed, config.num_seeds)
    crop_keys, pose_keys = seed_keys(key, config.num_seeds)
    diameter = part.arrays.diameter
    crops = crop_features(
        graphdef, parameters, scene, rows, real, diameter, crop_keys, config=config.search, num_points=num_points
    )
    found, said = search(graphdef, parameters, part.arrays, crops, pose_keys, config=config.search)
    shown = crops._replace(features=crops.features[:, :, :0])
    evidence = evidence_of(found, said, shown, part.arrays, part.surfels, sight, config.verify)
    logits = jnp.matmul(evidence, part.weights, precision=jax.lax.Precision.HIGHEST) + part.bias
    logits = jnp.where(found.found, logits, -jnp.inf)

    best = jnp.argmax(logits, axis=1)
    one_each = jax.tree.map(lambda leaf: leaf[jnp.arange(config.num_seeds), best], (found, logits))
    order = jnp.argsort(-one_each[1], stable=True)
    found, logits = jax.tree.map(lambda leaf: leaf[order], one_each)
    kept = _standing(found.T_scene_object, jnp.isfinite(logits), part, config.select)
    order = jnp.argsort(~kept, stable=True)
    kept = kept[order]
    return BinPoses(
        jnp.where(kept[:, None, None], found.T_scene_object[order], jnp.eye(4)[None]),
        jnp.where(kept, jax.nn.sigmoid(logits[order]), 0),
        jnp.where(kept, found.num_inliers[order], 0),
        kept,
        jnp.array(False),
    )


def _scene(
    sight: Sight, foreground: Bool[Array, "h w"], count: int
) -> tuple[SceneArrays, Bool[Array, " r"], Bool[Array, ""]]:
    """Return the points of a depth image in the camera's frame, thinned out to a capacity; which are foreground."""
    fx, fy, cx, cy, *_ = sight.camera
    zero, one = jnp.zeros(()), jnp.ones(())
    points = depth_to_points(sight.depth, jnp.array([[fx, zero, cx], [zero, fy, cy], [zero, zero, one]])).reshape(-1, 3)
    measured = points[:, 2] > 0
    rows, real = spread_rows(measured, count)
    overflow = measured.sum(dtype=jnp.int32) > rows.shape[0]
    return SceneArrays(jnp.where(real[:, None], points[rows], 0), real), real & foreground.reshape(-1)[rows], overflow


def _standing(
    poses: Float[Array, "s 4 4"], there: Bool[Array, " s"], part: BinPart, config: SelectConfig
) -> Bool[Array, " s"]:
    """Tell which poses, from the likeliest on, stand: no likelier one that stands is the same, or in the same place."""
    count, diameter = config.num_points, part.arrays.diameter
    points, normals = part.arrays.points[:count], part.arrays.normals[:count]
    spacing = jnp.sqrt(part.surfels.area / count)
    centers = jax.vmap(transform_points, in_axes=(0, None))(poses, points.mean(axis=0)[None])[:, 0]
    near = ((centers[:, None] - centers[None]) ** 2).sum(axis=2) <= (2 * diameter) ** 2
    first, second = jnp.triu_indices(len(poses), 1)
    relevant = near[first, second] & there[first] & there[second]

    def exclude(pose: Pose, other: Pose) -> Bool[Array, ""]:
        apart = mssd(pose, other, points, part.symmetries)
        shared = overlap(pose, other, points, normals, spacing, config.depth * diameter)
        return (apart <= part.reach) | (shared > config.overlap)

    pairs = each(exclude, relevant, poses[first], poses[second])
    excluded = jnp.zeros((len(poses), len(poses)), dtype=bool).at[first, second].set(pairs)

    def take(row: Int[Array, ""], taken: Bool[Array, " s"]) -> Bool[Array, " s"]:
        return taken.at[row].set(there[row] & ~(excluded[:, row] & taken).any())

    return jax.lax.fori_loop(0, len(poses), take, jnp.zeros(len(poses), dtype=bool))
