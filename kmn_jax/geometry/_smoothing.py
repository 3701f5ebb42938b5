"""Normals of noisy points, and the points moved onto their planes: from all points around them, the more the noisier.

The noise is measured first: on most of a part's surface the points within a small ball lie on a plane, but for noise.
Where there is next to none, small balls keep edges sharp and points stay where they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kmn_jax.errors import InputError, require
from kmn_jax.geometry._ball_normals import normals_within_radius, planes_within_radius
from kmn_jax.geometry._normals import orient_to_camera
from kmn_jax.typing import Scalar


@dataclass(frozen=True)
class SmoothConfig:
    """Set the smoothing; lengths are shares of the object's diameter."""

    least_radius: float = 0.06  # of the balls without noise
    most_radius: float = 0.25
    radius_per_noise: float = 5.0  # by which the radius grows with the noise's deviation
    probe_radius: float = 0.12  # of the balls in which noise is measured
    probes: int = 64  # of them, around points evenly spread over the rows
    quantile: float = 0.25  # of the probes' spreads is the noise: those at edges and corners spread more
    moved_noise: float = 0.03  # points of such a noise, and above, are moved onto their planes; of less, less

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        require(
            0 < self.least_radius <= self.most_radius,
            f"least_radius = {self.least_radius} must be above zero, and most_radius = {self.most_radius} not below",
        )
        if self.radius_per_noise < 0 or self.probe_radius <= 0 or self.moved_noise <= 0:
            raise InputError("radius_per_noise must not be negative, probe_radius and moved_noise be above zero")
        if self.probes < 1 or not 0 <= self.quantile <= 1:
            raise InputError(f"probes = {self.probes} must be 1 or more, and quantile = {self.quantile} in [0, 1]")


def smoothed(
    points: Float[Array, "q 3"],
    mask: Bool[Array, " q"],
    cloud: Float[Array, "n 3"],
    cloud_mask: Bool[Array, " n"],
    diameter: Scalar,
    config: SmoothConfig = SmoothConfig(),
) -> tuple[Float[Array, "q 3"], Float[Array, "q 3"], Bool[Array, " q"], Scalar]:
    """Return points moved towards the surface, their normals of arbitrary sign, which are known, and the noise.

    `cloud` is all that was measured around the points, and its noise the deviation along the normal, in its unit.
    """
    # Rows are those of an image, from its top to its bottom: the first ones lie side by side.
    count = min(config.probes, points.shape[0])
    real = jnp.nonzero(mask, size=points.shape[0], fill_value=0)[0]
    rows = real[jnp.arange(count, dtype=jnp.int32) * mask.sum(dtype=jnp.int32) // count]
    probed = planes_within_radius(points[rows], cloud, config.probe_radius * diameter, cloud_mask)
    spreads = jnp.where(probed.valid & mask[rows], probed.residuals, jnp.nan)
    measured = jnp.nanquantile(spreads, config.quantile)
    noise = jnp.where(jnp.isfinite(measured), measured, 0)
    radius = (config.least_radius * diameter) + config.radius_per_noise * noise
    planes = planes_within_radius(points, cloud, jnp.minimum(radius, config.most_radius * diameter), cloud_mask)
    share = jnp.minimum(noise / (config.moved_noise * diameter), 1) ** 2
    moved = points - share * planes.heights[:, None] * planes.normals
    return jnp.where(mask[:, None], moved, points), planes.normals, planes.valid & mask, noise


def with_normals(
    points: Float[Array, "q 3"],
    mask: Bool[Array, " q"],
    cloud: Float[Array, "n 3"],
    cloud_mask: Bool[Array, " n"],
    camera: Float[Array, "3"],
    diameter: Scalar,
    normal_radius: float,
    smooth: SmoothConfig | None,
) -> tuple[Float[Array, "q 3"], Float[Array, "q 3"]]:
    """Return points as the network takes them, with unit normals towards the camera; zero where masked out.

    `cloud` is all that was measured around the points. Without smoothing, normals are those of the planes within
    `normal_radius` (a share of the diameter), and points stay. Where there is no plane, the normal is the direction to
    the camera, whose place is given.
    """
    if smooth is None:
        normals, known = normals_within_radius(points, cloud, normal_radius * diameter, cloud_mask)
    else:
        points, normals, known, _ = smoothed(points, mask, cloud, cloud_mask, diameter, smooth)
    return points, jnp.where(mask[:, None], _towards_camera(points, normals, known, camera), 0)


def _towards_camera(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"], known: Bool[Array, " n"], camera: Float[Array, "3"]
) -> Float[Array, "n 3"]:
    """Return normals turned towards a camera; where one is not known, the direction to it."""
    away = camera[None] - points
    length = jnp.sqrt((away**2).sum(axis=1, keepdims=True))
    return jnp.where(known[:, None], orient_to_camera(points, normals, camera), away / jnp.where(length > 0, length, 1))
