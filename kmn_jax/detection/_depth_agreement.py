"""Poses against a depth image: what of an object's visible side it confirms, and what it contradicts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.errors import InputError
from kmn_jax.geometry import Intrinsics
from kmn_jax.simulate import SplatConfig, Surfels, visible_by_splatting
from kmn_jax.typing import Pose, Scalar


@dataclass(frozen=True)
class DepthAgreementConfig:
    """Set the comparison; the tolerance is a share of the object's diameter."""

    tolerance: float = 0.03  # between predicted and measured depth
    sunk: float = 0.2  # what lies in front by less than this is more likely the surface itself than another part
    window: int = 1  # pixels to each side in which a measurement may lie: edges are off by one
    splat: SplatConfig = field(default_factory=lambda: SplatConfig(resolution=128))

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        if not 0 < self.tolerance < self.sunk or self.window < 0:
            raise InputError(
                f"tolerance = {self.tolerance} must be above zero and below sunk = {self.sunk}, and window ="
                f" {self.window} not below zero"
            )


class DepthImage(NamedTuple):
    """A depth image, zero where nothing was measured, and its camera."""

    depth: Float[Array, "h w"]
    camera: Intrinsics


class DepthAgreement(NamedTuple):
    """Shares of the picture area that an object at a pose would cover if nothing hid it; the first four sum up to 1.

    Missing measurements, as on shiny flanks, speak neither for nor against a pose.
    """

    explained: Scalar  # measured where it is predicted
    violated: Scalar  # the sensor saw through it: something was measured behind
    occluded: Scalar  # something was measured in front
    unknown: Scalar  # nothing was measured
    sunk: Scalar  # of what is occluded, the share of the whole that something hides from close by


def depth_agreement(
    T_camera_object: Pose, surfels: Surfels, image: DepthImage, diameter: Scalar, config: DepthAgreementConfig
) -> DepthAgreement:
    """Compare an object at a pose with a depth image in the same unit, zero where nothing was measured."""
    depth, camera = image
    seen = visible_by_splatting(surfels, T_camera_object[None], jnp.ones(1, dtype=bool), camera, None, config.splat)
    row, column, z = _pixels(seen.points, seen.mask, camera)
    measured = _window(depth, row, column, config.window)
    there = measured > 0
    gap = jnp.where(there, measured - z[:, None], 0)
    tolerance = config.tolerance * diameter
    near = (there & (jnp.abs(gap) <= tolerance)).any(axis=1)
    some = there.any(axis=1)
    behind = (~there | (gap > tolerance)).all(axis=1)
    weight = jnp.where(seen.mask, seen.picture_area, 0)
    weight = weight / jnp.maximum(weight.sum(), jnp.finfo(jnp.float32).tiny)

    def share(which: Bool[Array, " m"]) -> Scalar:
        return jnp.where(which, weight, 0).sum()

    occluded = some & ~behind & ~near
    close = (there & (gap < 0) & (gap > -config.sunk * diameter)).any(axis=1)
    return DepthAgreement(
        explained=share(near),
        violated=share(some & behind & ~near),
        occluded=share(occluded),
        unknown=share(~some),
        sunk=share(occluded & close),
    )


def farthest_at(
    depth: Float[Array, "h w"], camera: Intrinsics, x: Float[Array, " r"], y: Float[Array, " r"], reach: int
) -> Float[Array, " r"]:
    """Return the farthest of what was measured around directions (x, y, 1), up to `reach` pixels away; zero if nothing.

    Images of clouds have holes where no point fell into a pixel.
    """
    row, column, _ = _pixels(jnp.stack([x, y, jnp.ones_like(x)], axis=1), jnp.ones(x.shape, dtype=bool), camera)
    return _window(depth, row, column, reach).max(axis=1)


def depth_at(image: DepthImage, x: Float[Array, "*s"], y: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Return what was measured in directions (x, y, 1); zero where nothing was, and outside of the image."""
    camera = image.camera
    row, column = (
        jnp.round(f * way + c).astype(jnp.int32) for f, way, c in ((camera.fy, y, camera.cy), (camera.fx, x, camera.cx))
    )
    return _value(image.depth, row, column)


def in_image(image: DepthImage, x: Float[Array, "*s"], y: Float[Array, "*s"]) -> Bool[Array, "*s"]:
    """Tell which directions (x, y, 1) fall into pixels of the camera: depth may be padded beyond these."""
    camera = image.camera
    column, row = jnp.round(camera.fx * x + camera.cx), jnp.round(camera.fy * y + camera.cy)
    return (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)


def measured_at(image: DepthImage, points: Float[Array, "m 3"]) -> tuple[Float[Array, "m 3"], Bool[Array, " m"]]:
    """Return what was measured in the pixels that points fall into, and whether anything was: else the points."""
    row, column, _ = _pixels(points, points[:, 2] > 0, image.camera)
    camera, z = image.camera, _value(image.depth, row, column)
    x = (column.astype(jnp.float32) - camera.cx) / camera.fx
    y = (row.astype(jnp.float32) - camera.cy) / camera.fy
    there = (z > 0) & (points[:, 2] > 0)
    return jnp.where(there[:, None], jnp.stack([x * z, y * z, z], axis=1), points), there


def _window(
    depth: Float[Array, "h w"], row: Int[Array, " m"], column: Int[Array, " m"], reach: int
) -> Float[Array, "m k"]:
    """Return the measurements around a pixel; zero outside of the image."""
    steps = [(u, v) for u in range(-reach, reach + 1) for v in range(-reach, reach + 1)]
    return jnp.stack([_value(depth, row + u, column + v) for u, v in steps], axis=1)


def _value(depth: Float[Array, "h w"], row: Int[Array, "*s"], column: Int[Array, "*s"]) -> Float[Array, "*s"]:
    height, width = depth.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return jnp.where(inside, depth[jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)], 0)


def _pixels(
    points: Float[Array, "m 3"], ahead: Bool[Array, " m"], camera: Intrinsics
) -> tuple[Int[Array, " m"], Int[Array, " m"], Float[Array, " m"]]:
    """Return row and column of the nearest pixel, and the depth; any pixel where a point is not ahead."""
    x, y, z = (points[:, axis] for axis in range(3))
    safe = jnp.where(ahead, z, 1)
    column = jnp.round(camera.fx * x / safe + camera.cx).astype(jnp.int32)
    row = jnp.round(camera.fy * y / safe + camera.cy).astype(jnp.int32)
    return row, column, z


def depth_buffer(
    points: Float[Array, "r 3"], mask: Bool[Array, " r"], camera: Intrinsics, shape: tuple[int, int]
) -> Float[Array, "h w"]:
    """Return the depth image that a camera at the origin would have of points: the nearest one of every pixel."""
    height, width = shape
    ahead = mask & (points[:, 2] > 0)
    row, column, z = _pixels(points, ahead, camera)
    inside = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = jnp.where(inside, row * width + column, height * width)
    nearest = jnp.full(height * width, jnp.inf, jnp.float32).at[index].min(jnp.where(inside, z, jnp.inf), mode="drop")
    return jnp.where(jnp.isfinite(nearest), nearest, 0).reshape(height, width)
