"""Labelled crops for training, inside jit: the points around a visible object point, as a sensor would give them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from kmn_jax.data.splat import BIN, VisiblePoints
from kmn_jax.geometry import nearest, orient_to_camera, transform_points
from kmn_jax.geometry.ball_normals import normals_within_radius
from kmn_jax.typing import Pose, PRNGKey, Scalar

NormalSource = Literal["estimated", "surface"]

_MOST_SIGMAS = 3.0  # noise is clipped there, as published


@dataclass(frozen=True)
class CropConfig:
    """Choose what a crop holds; lengths are shares of the object's diameter.

    Normals are those of the CAD "surface", or "estimated" from noisy points as by a sensor, which has more points than
    a crop keeps: `normal_points` are drawn, those within `normal_radius` define a plane, and the first `num_points` are
    the crop. (By the 16 nearest of a crop's own 512 points, the median normal would be off by about 20 degrees.)
    """

    num_points: int = 2048
    radius: float = 1.0
    max_noise: float = 0.0075  # the noise's deviation is drawn uniformly between 0 and this
    normals: NormalSource = "estimated"
    normal_radius: float = 0.06
    normal_points: int = 4096
    include_bin: bool = True
    min_points: int = 16  # a crop of fewer is not valid
    min_visible_fraction: float = 0.1  # of the seed's copy, see VisiblePoints

    def __post_init__(self) -> None:
        if not 1 <= self.min_points <= self.num_points:
            raise ValueError(f"min_points = {self.min_points} must lie between 1 and num_points = {self.num_points}")
        if self.radius <= 0 or self.max_noise < 0:
            raise ValueError(
                f"radius = {self.radius} must be above zero, and max_noise = {self.max_noise} not below it"
            )
        if self.normals not in ("estimated", "surface"):
            raise ValueError(f'normals = "{self.normals}", but must be "estimated" or "surface"')
        if self.normal_radius <= 0 or self.normal_points < 3:
            raise ValueError(
                f"normal_radius = {self.normal_radius} must be above zero"
                f" and normal_points = {self.normal_points} at least 3"
            )

    @property
    def num_drawn(self) -> int:
        """The number of points to draw, of which the first `num_points` are the crop."""
        return self.num_points if self.normals == "surface" else max(self.num_points, self.normal_points)


class Crop(NamedTuple):
    """Points around a seed point, which is the origin and the first of them; axes are the camera's.

    If `valid` is false, no visible point may be a seed or too few are around it; all is finite even so.
    """

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]  # unit, towards the camera
    mask: Bool[Array, " n"]  # false for padding, where points and normals are zero
    is_object: Bool[Array, " n"]  # on the same copy as the seed
    keypoint: Int[Array, " n"]  # nearest keypoint of that copy; means nothing where is_object is false
    seed: Float[Array, " 3"]  # in the camera frame
    instance: Int[Array, ""]  # of the seed
    T_crop_object: Pose  # of the seed's copy
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
) -> Crop:
    """Draw a seed among the visible object points, and the points of its crop without replacement.

    Both are drawn as pixels of an image would be: in proportion to the picture area that each point covers. Noise is
    added before normals are estimated; labels are those of the points without it. Where a normal cannot be
    estimated (fewer than three points, or all on a line), it is the direction to the camera.
    """
    total = visible.mask.shape[0]
    if total < 1:
        raise ValueError("visible holds no points: a scene needs at least one copy and one surfel")
    seed_key, draw_key, sigma_key, noise_key = jax.random.split(key, 4)
    weights = jnp.log(jnp.where(visible.mask, visible.picture_area, 0))  # minus infinity: never drawn
    seed_row, found = _draw_seed(seed_key, visible, weights, config.min_visible_fraction)

    x, y, z = (visible.points[:, axis] - visible.points[seed_row, axis] for axis in range(3))
    inside = found & (weights > -jnp.inf) & (x**2 + y**2 + z**2 <= (config.radius * diameter) ** 2)
    if not config.include_bin:
        inside = inside & (visible.instance != BIN)
    # Gumbel numbers on log weights: the largest sums are a weighted draw without replacement, in the order of drawing.
    ranks = jnp.where(inside, weights, -jnp.inf) + jax.random.gumbel(draw_key, (total,))
    ranks = ranks.at[seed_row].set(jnp.where(found, jnp.inf, -jnp.inf))
    # Without the barrier XLA merges later slices into the selection, which then falls back to a full sort.
    # (One for each of the two: under shard_map XLA fails on one for both.)
    top, rows = map(jax.lax.optimization_barrier, jax.lax.top_k(ranks, min(config.num_drawn, total)))
    drawn = top > -jnp.inf

    exact = jnp.where(drawn[:, None], visible.points[rows], 0)
    sigma = config.max_noise * diameter * jax.random.uniform(sigma_key)
    noisy = exact + sigma * jnp.clip(jax.random.normal(noise_key, exact.shape), -_MOST_SIGMAS, _MOST_SIGMAS)
    seed = jnp.where(found, noisy[0], 0)
    noisy = jnp.where(drawn[:, None], noisy - seed[None], 0)

    rows, mask, exact, points = (part[: config.num_points] for part in (rows, drawn, exact, noisy))
    if config.normals == "surface":
        normals, known = visible.normals[rows], mask
    else:
        normals, known = normals_within_radius(points, noisy, config.normal_radius * diameter, drawn)
    normals = jnp.where(known[:, None], orient_to_camera(points, normals, -seed), _unit(-seed[None] - points))
    normals = jnp.where(mask[:, None], normals, 0)

    instance = jnp.where(found, visible.instance[seed_row], 0)
    pose = jnp.where(found, T_camera_object[instance].astype(jnp.float32), jnp.eye(4))
    keypoint, _ = nearest(exact, transform_points(pose, keypoints_object))
    num_inside = inside.sum(dtype=jnp.int32)

    def padded(rows: Shaped[Array, "drawn ..."]) -> Shaped[Array, "n ..."]:
        return jnp.pad(rows, ((0, config.num_points - rows.shape[0]), *((0, 0) for _ in rows.shape[1:])))

    return Crop(
        points=padded(points),
        normals=padded(normals),
        mask=padded(mask),
        is_object=padded(mask & (visible.instance[rows] == instance)),
        keypoint=padded(keypoint.astype(jnp.int32)),
        seed=seed,
        instance=instance,
        T_crop_object=pose.at[:3, 3].add(-seed),
        noise=sigma,
        num_inside=num_inside,
        valid=num_inside >= config.min_points,
    )


def _draw_seed(
    key: PRNGKey, visible: VisiblePoints, weights: Float[Array, " r"], min_visible_fraction: float
) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """Return the row of a random point on a copy of which enough is visible, and whether there is one."""
    on_copy = visible.instance != BIN
    enough = (visible.visible_fraction >= min_visible_fraction)[jnp.where(on_copy, visible.instance, 0)]
    ranks = jnp.where(on_copy & enough, weights, -jnp.inf) + jax.random.gumbel(key, weights.shape)
    row = jnp.argmax(ranks)
    return row, ranks[row] > -jnp.inf


def _unit(vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    length = jnp.sqrt((vectors**2).sum(axis=1, keepdims=True))
    return vectors / jnp.where(length > 0, length, 1)
