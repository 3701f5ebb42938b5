"""Training examples, made inside of a step: scenes of a pack become labelled crops, surfels become object clouds."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from kmn_jax.data import CropConfig, DevicePack, draw_crop, take_scene, visible_points
from kmn_jax.errors import InputError
from kmn_jax.geometry import farthest_point_indices, nearest, random_rotation, transform_points
from kmn_jax.models import KeyMatchNetConfig
from kmn_jax.simulate import SplatConfig, Surfels, VisiblePoints, WorldConfig, make_world
from kmn_jax.typing import PRNGKey

_MOST_SIGMAS = 3.0  # noise is clipped there, as published


@dataclass(frozen=True)
class ExampleConfig:
    """What is drawn anew for every example; the defaults are the published ones (arXiv 2303.16102, training section).

    Lengths are shares of the object's diameter.
    """

    crops: CropConfig = field(default_factory=CropConfig)
    visibility: Literal["bits", "splat"] = "bits"  # of the pack's views, or found anew for them in the step
    splat: SplatConfig = field(default_factory=SplatConfig)
    worlds: WorldConfig | None = None  # scenes are made in the step, of the pack's surfels; its own are not used
    crops_per_scene: int = 1  # crops of an object that come from the first one's scene: finding what is seen costs most
    random_keypoints: float = 0.6  # share of examples whose keypoints are random points, not farthest ones
    rotate_object: bool = True
    object_shift: float = 0.1  # at most, in any direction
    object_noise: float = 0.0075  # the noise's deviation is drawn uniformly between 0 and this

    def __post_init__(self) -> None:
        if self.visibility not in ("bits", "splat"):
            raise InputError(f'visibility is {self.visibility!r}, but must be "bits" or "splat"')
        if self.crops_per_scene < 1:
            raise InputError(f"crops_per_scene = {self.crops_per_scene} must be at least 1")
        if not 0 <= self.random_keypoints <= 1:
            raise InputError(f"random_keypoints = {self.random_keypoints} is a share: it must be between 0 and 1")
        if self.object_shift < 0 or self.object_noise < 0:
            raise InputError(
                f"object_shift = {self.object_shift} and object_noise = {self.object_noise} must not be < 0"
            )

    def plain(self) -> ExampleConfig:
        """Return the same without anything random but the choice of seed and points: what validation uses."""
        return replace(
            self,
            crops=replace(self.crops, max_noise=0.0),
            crops_per_scene=1,
            random_keypoints=0.0,
            rotate_object=False,
            object_shift=0.0,
            object_noise=0.0,
        )


class RenderedCrops(NamedTuple):
    """Crops that were made before, of depth images, with a leading axis for each sample; lengths in metres."""

    points: Float[Array, "... n 3"]
    normals: Float[Array, "... n 3"]
    mask: Bool[Array, "... n"]
    is_object: Bool[Array, "... n"]
    T_crop_object: Float[Array, "... 4 4"]
    valid: Bool[Array, "..."]


class Group(NamedTuple):
    """One object and g crops of bins of it, in the pack's unit."""

    cloud: Float[Array, "m 6"]
    keypoint_indices: Int[Array, " k"]
    length: Float[Array, ""]  # the crops' radius
    crops: Float[Array, "g n 6"]
    mask: Bool[Array, "g n"]
    is_object: Bool[Array, "g n"]
    keypoint: Int[Array, "g n"]
    valid: Bool[Array, " g"]


def make_group(
    pack: DevicePack,
    row: Int[Array, ""],
    drops: Int[Array, " g"],
    keys: UInt32[Array, "g 2"],
    network: KeyMatchNetConfig,
    config: ExampleConfig,
    rendered: RenderedCrops | None = None,
) -> Group:
    """Make the examples of one object. Each crop is a function of its key, the object's cloud of the first one.

    With `rendered` crops there are no scenes: only the object's cloud, its keypoints and the labels are made.

    Raises InputError if the pack has fewer surfels than the network's object cloud has points.
    """
    num_surfels = pack.points.shape[1]
    if num_surfels < network.num_object_points:
        raise InputError(
            f"the pack has {num_surfels} surfels an object, but num_object_points = {network.num_object_points}: build"
            " a pack with more, or choose fewer"
        )
    object_key = jax.random.fold_in(jax.random.wrap_key_data(keys[0]), 1)
    diameter = jnp.asarray(pack.diameter)[row]
    fixed = network.object_branch == "learned"  # then the first surfels, as an object model has them
    rows = _cloud_rows(
        jax.random.fold_in(object_key, 0), num_surfels, network.num_object_points, config.plain() if fixed else config
    )
    points, normals = jnp.asarray(pack.points)[row, rows], jnp.asarray(pack.normals)[row, rows]
    indices = (
        jnp.arange(network.num_keypoints, dtype=jnp.int32)
        if fixed
        else _keypoints(jax.random.fold_in(object_key, 1), points / diameter, network.num_keypoints, config)
    )
    keypoints = points[indices]

    def of_scene(drop: Int[Array, ""], keys: UInt32[Array, "s 2"]) -> tuple[Array, ...]:
        if config.worlds is not None:
            visible, poses, near = _world(keys[0], pack, row, config.worlds)
        else:
            scene = take_scene(pack, row, drop)
            visible = visible_points(scene, config.splat if config.visibility == "splat" else None)
            poses, near = scene.T_camera_object, None

        def crop(key: UInt32[Array, " 2"]) -> tuple[Array, ...]:
            crop_key = jax.random.fold_in(jax.random.wrap_key_data(key), 0)
            made = draw_crop(crop_key, visible, keypoints, poses, diameter, config.crops, near)
            cloud = jnp.concatenate([made.points, made.normals], axis=1)
            return cloud, made.mask, made.is_object, made.keypoint, made.valid

        return jax.lax.map(crop, keys)

    cloud = _augmented(jax.random.fold_in(object_key, 2), points, normals, diameter, config)
    length = config.crops.radius * diameter
    if rendered is not None:
        crops = jnp.concatenate([rendered.points, rendered.normals], axis=2)
        labels = jax.vmap(lambda points, pose: nearest(points, transform_points(pose, keypoints))[0])
        keypoint = labels(rendered.points, rendered.T_crop_object).astype(jnp.int32)
        return Group(cloud, indices, length, crops, rendered.mask, rendered.is_object, keypoint, rendered.valid)
    each = config.crops_per_scene
    scenes = jax.lax.map(lambda pair: of_scene(*pair), (drops[::each], keys.reshape(-1, each, 2)))
    return Group(cloud, indices, length, *(leaf.reshape(-1, *leaf.shape[2:]) for leaf in scenes))


def _world(
    key: UInt32[Array, " 2"], pack: DevicePack, row: Int[Array, ""], config: WorldConfig
) -> tuple[VisiblePoints, Float[Array, "c 4 4"], Bool[Array, " r"]]:
    """Return what is seen of a new world, where its copies are, and which points lie in the middle of it."""
    world_key, row_key = jax.random.split(jax.random.fold_in(jax.random.wrap_key_data(key), 2))
    points, normals, area = (jnp.asarray(array) for array in (pack.points, pack.normals, pack.area))
    other = jax.random.randint(row_key, (), 0, points.shape[0])
    own, foreign = (Surfels(points[which], normals[which], area[which]) for which in (row, other))
    diameter = jnp.asarray(pack.diameter)[row]
    world = make_world(world_key, own, foreign, diameter, config)
    away = world.visible.points - world.centre[None]
    return world.visible, world.T_camera_object, (away**2).sum(axis=1) < diameter**2


def _cloud_rows(key: PRNGKey, total: int, count: int, config: ExampleConfig) -> Int[Array, " count"]:
    """Return distinct rows, one of each of `count` equal stretches: surfels are in farthest-point order."""
    # Unaugmented, the first rows: those that an object model of so many points has.
    if config == config.plain():
        return jnp.arange(count, dtype=jnp.int32)
    starts = jnp.arange(count, dtype=jnp.int32)
    low, high = starts * total // count, (starts + 1) * total // count
    return jax.random.randint(key, (count,), low, high, dtype=jnp.int32)


def _keypoints(key: PRNGKey, points: Float[Array, "m 3"], count: int, config: ExampleConfig) -> Int[Array, " count"]:
    """Return farthest points, or random ones in the configured share of the draws."""
    if config.random_keypoints == 0:
        return farthest_point_indices(points, count)
    choice, first, draw = jax.random.split(key, 3)
    spread = farthest_point_indices(points, count, first)
    scattered = jax.random.choice(draw, points.shape[0], (count,), replace=False).astype(jnp.int32)
    return jnp.where(jax.random.uniform(choice) < config.random_keypoints, scattered, spread)


def _augmented(
    key: PRNGKey,
    points: Float[Array, "m 3"],
    normals: Float[Array, "m 3"],
    diameter: Float[Array, ""],
    config: ExampleConfig,
) -> Float[Array, "m 6"]:
    turn, shift, sigma, noise = jax.random.split(key, 4)
    if config.object_noise > 0:
        deviation = config.object_noise * diameter * jax.random.uniform(sigma)
        points = points + deviation * jnp.clip(jax.random.normal(noise, points.shape), -_MOST_SIGMAS, _MOST_SIGMAS)
    if config.rotate_object:
        rotation = random_rotation(turn)
        highest = jax.lax.Precision.HIGHEST
        points = jnp.matmul(points, rotation.T, precision=highest)
        normals = jnp.matmul(normals, rotation.T, precision=highest)
    if config.object_shift > 0:
        limit = config.object_shift * diameter
        points = points + limit * jax.random.uniform(shift, (1, 3), minval=-1.0, maxval=1.0)
    return jnp.concatenate([points, normals], axis=1)
