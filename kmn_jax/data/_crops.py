"""Labelled crops for training, inside jit: the points around a visible object point, as a sensor would give them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from kmn_jax.errors import InputError
from kmn_jax.geometry import SmoothConfig, draw_rows, nearest, orient_to_camera, transform_points, with_normals
from kmn_jax.simulate import BIN, FaultConfig, VisiblePoints, displaced, draw_faults, measured
from kmn_jax.typing import Pose, PRNGKey, Scalar

NormalSource = Literal["estimated", "surface"]

_MOST_SIGMAS = 3.0  # noise is clipped there, as published
_TINY = 1e-30  # keeps sums of nothing from dividing by zero


@dataclass(frozen=True)
class CropConfig:
    """Choose what a crop holds; lengths are shares of the object's diameter.

    Normals are those of the CAD "surface", or "estimated" from noisy points as by a sensor, which has more points than
    a crop keeps: `normal_points` are drawn, those within `normal_radius` define a plane, and `num_points` of them are
    the crop. (By the 16 nearest of a crop's own 512 points, the median normal would be off by about 20 degrees.)
    """

    num_points: int = 2048
    radius: float = 1.0
    max_noise: float = 0.0075  # the noise's deviation is drawn uniformly between 0 and this
    normals: NormalSource = "estimated"
    normal_radius: float = 0.06
    normal_points: int = 4096
    smooth: SmoothConfig | None = None  # of estimated normals: the radius is then its own, and points are moved
    include_bin: bool = True
    min_points: int = 16  # a crop of fewer is not valid
    min_visible_fraction: float = 0.1  # of the seed's copy, see VisiblePoints
    instance_seeds: float = 0.0  # share of seeds that lie on a random copy, whatever picture area it covers
    other_seeds: float = 0.0  # share of seeds that lie on no copy, but on the background or on a part of another kind
    faults: FaultConfig | None = None  # of the depth sensor, beside the noise

    def __post_init__(self) -> None:
        if not 1 <= self.min_points <= self.num_points:
            raise InputError(f"min_points = {self.min_points} must lie between 1 and num_points = {self.num_points}")
        if self.radius <= 0 or self.max_noise < 0:
            raise InputError(
                f"radius = {self.radius} must be above zero, and max_noise = {self.max_noise} not below it"
            )
        if self.normals not in ("estimated", "surface"):
            raise InputError(f'normals = "{self.normals}", but must be "estimated" or "surface"')
        if self.normal_radius <= 0 or self.normal_points < 3:
            raise InputError(
                f"normal_radius = {self.normal_radius} must be above zero"
                f" and normal_points = {self.normal_points} at least 3"
            )
        for name in ("instance_seeds", "other_seeds"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{name} = {getattr(self, name)} is a share: it must be between 0 and 1")

    @property
    def num_drawn(self) -> int:
        """The number of points to draw, of which `num_points` are the crop."""
        return self.num_points if self.normals == "surface" else max(self.num_points, self.normal_points)


class LabelledCrop(NamedTuple):
    """Points around a seed point, which is the origin and the first of them; axes are the camera's.

    If `valid` is false, no visible point may be a seed or too few are around it; all is finite even so.
    """

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]  # unit, towards the camera
    mask: Bool[Array, " n"]  # false for padding, where points and normals are zero
    is_object: Bool[Array, " n"]  # on the same copy as the seed; nowhere if that is on none
    keypoint: Int[Array, " n"]  # nearest keypoint of that copy; means nothing where is_object is false
    seed: Float[Array, " 3"]  # in the camera frame
    instance: Int[Array, ""]  # of the seed: the index of a copy, or below zero
    T_crop_object: Pose  # of the seed's copy, if it is on one
    noise: Scalar  # standard deviation per coordinate, in the points' unit
    num_inside: Int[Array, ""]  # visible points within the radius, of which at most n were drawn
    valid: Bool[Array, ""]


def draw_crop(
    key: PRNGKey,
    visible: VisiblePoints,
    keypoints_object: Float[Array, "k 3"],
    T_camera_object: Float[Array, "c 4 4"],
    diameter: Scalar,
    config: CropConfig = CropConfig(),
    seeds: Bool[Array, " r"] | None = None,
) -> LabelledCrop:
    """Draw a seed among the visible object points, in proportion to the picture area covered, and the crop around it.

    In the configured share of the draws, the seed's copy is drawn first, all being equally likely. `seeds` are the rows
    that may be one; all unless given.
    """
    _check_points(visible)
    seed_key, crop_key = jax.random.split(key)
    row, found = _draw_seed(seed_key, visible, config, seeds)
    return labelled_crop_around(crop_key, visible, row, found, keypoints_object, T_camera_object, diameter, config)


def labelled_crop_around(
    key: PRNGKey,
    visible: VisiblePoints,
    seed_row: Int[Array, ""],
    found: Bool[Array, ""],
    keypoints_object: Float[Array, "k 3"],
    T_camera_object: Float[Array, "c 4 4"],
    diameter: Scalar,
    config: CropConfig = CropConfig(),
) -> LabelledCrop:
    """Draw the points of a crop around the seed in a row, without replacement; `found` tells whether it is one.

    They are drawn as pixels of an image would be: in proportion to the picture area that each covers. Noise is added
    before normals are estimated; labels are those of the points without it. Where a normal cannot be estimated (fewer
    than three points, or all on a line), it is the direction to the camera.
    """
    _check_points(visible)
    draw_key, sigma_key, noise_key = jax.random.split(key, 3)
    weights = jnp.where(visible.mask, visible.picture_area, 0)
    x, y, z = (visible.points[:, axis] - visible.points[seed_row, axis] for axis in range(3))
    faults = None
    if config.faults is not None:
        fault_key, loss_key, depth_key = jax.random.split(jax.random.fold_in(key, 1), 3)
        faults = draw_faults(fault_key, config.faults)
        place = visible.points[seed_row]
        weights = jnp.where(
            measured(loss_key, faults, visible.points, visible.normals, visible.mask, diameter, place), weights, 0
        )
    inside = found & (weights > 0) & (x**2 + y**2 + z**2 <= (config.radius * diameter) ** 2)
    if not config.include_bin:
        inside = inside & (visible.instance != BIN)
    likely = jnp.where(inside, weights, 0)
    rows, drawn, kept = draw_rows(draw_key, likely, seed_row, found, config.num_drawn, config.num_points)

    exact = jnp.where(drawn[:, None], visible.points[rows], 0)
    sigma = config.max_noise * diameter * jax.random.uniform(sigma_key)
    if faults is not None:
        exact_normals = jnp.where(drawn[:, None], visible.normals[rows], 0)
        seen = jnp.where(drawn[:, None], displaced(depth_key, faults, exact, exact_normals, diameter), 0)
    else:
        seen = exact
    noisy = seen + sigma * jnp.clip(jax.random.normal(noise_key, exact.shape), -_MOST_SIGMAS, _MOST_SIGMAS)
    seed = jnp.where(found, noisy[0], 0)
    noisy = jnp.where(drawn[:, None], noisy - seed[None], 0)

    mask = drawn[: kept.shape[0]]
    rows, exact, points = rows[kept], exact[kept], noisy[kept]
    if config.normals == "surface":
        normals = jnp.where(mask[:, None], orient_to_camera(points, visible.normals[rows], -seed), 0)
    else:
        points, normals = with_normals(points, mask, noisy, drawn, -seed, diameter, config.normal_radius, config.smooth)
        seed, points = seed + points[0], jnp.where(mask[:, None], points - points[:1], 0)

    instance = jnp.where(found, visible.instance[seed_row], 0)
    on_copy = found & (instance >= 0)
    pose = jnp.where(on_copy, T_camera_object[jnp.maximum(instance, 0)].astype(jnp.float32), jnp.eye(4))
    keypoint, _ = nearest(exact, transform_points(pose, keypoints_object))
    num_inside = inside.sum(dtype=jnp.int32)

    def padded(rows: Shaped[Array, "drawn ..."]) -> Shaped[Array, "n ..."]:
        return jnp.pad(rows, ((0, config.num_points - rows.shape[0]), *((0, 0) for _ in rows.shape[1:])))

    return LabelledCrop(
        points=padded(points),
        normals=padded(normals),
        mask=padded(mask),
        is_object=padded(mask & on_copy & (visible.instance[rows] == instance)),
        keypoint=padded(keypoint.astype(jnp.int32)),
        seed=seed,
        instance=instance,
        T_crop_object=pose.at[:3, 3].add(-seed),
        noise=sigma,
        num_inside=num_inside,
        valid=num_inside >= config.min_points,
    )


def _check_points(visible: VisiblePoints) -> None:
    if visible.mask.shape[0] < 1:
        raise InputError("visible holds no points: a scene needs at least one copy and one surfel")


def _draw_seed(
    key: PRNGKey, visible: VisiblePoints, config: CropConfig, seeds: Bool[Array, " r"] | None
) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """Return the row of a random point on a copy of which enough is visible, and whether there is one."""
    place_key, share_key, copy_key = jax.random.split(key, 3)
    on_copy = visible.instance >= 0
    enough = visible.visible_fraction >= config.min_visible_fraction
    seen = visible.mask & (visible.picture_area > 0)
    if seeds is not None:
        seen = seen & seeds
    weights = jnp.where(seen & on_copy & enough[jnp.where(on_copy, visible.instance, 0)], visible.picture_area, 0)
    if config.instance_seeds > 0:
        drawable = enough & (visible.visible_fraction > 0)
        copy = jax.random.categorical(copy_key, jnp.where(drawable, 0.0, -jnp.inf))
        whole = jax.random.uniform(share_key) >= config.instance_seeds
        weights = jnp.where(whole | (visible.instance == copy), weights, 0)
    if config.other_seeds > 0:
        elsewhere = jax.random.uniform(jax.random.fold_in(key, 1)) < config.other_seeds
        weights = jnp.where(elsewhere, jnp.where(seen & ~on_copy, visible.picture_area, 0), weights)
    # In whole numbers, whose running sums never fall and are exact.
    ends = jnp.cumsum((weights * (2.0**30 / jnp.maximum(weights.sum(), _TINY))).astype(jnp.int32))
    place = jax.random.randint(place_key, (), 0, jnp.maximum(ends[-1], 1))
    row = jnp.searchsorted(ends, place, side="right")
    return jnp.minimum(row, ends.shape[0] - 1), ends[-1] > 0
