"""A scan as calls take it, and the crop around its first point."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from kmn_jax.data import Crop, CropConfig, crop_around
from kmn_jax.simulate import BIN, VisiblePoints
from kmn_jax.typing import PRNGKey, Scalar


class SceneArrays(NamedTuple):
    """A scan in its sensor's frame, padded to a capacity: the sensor is at the origin."""

    points: Float[Array, "r 3"]
    mask: Bool[Array, " r"]


def padded_points(points: Float32[np.ndarray, "n 3"], least: int = 2) -> tuple[Float[Array, "r 3"], Bool[Array, " r"]]:
    """Return points with zeros after them, and which are real: few sizes, powers of two, are ever compiled for."""
    capacity = max(least, 1 << (len(points) - 1).bit_length())
    padded = np.zeros((capacity, 3), dtype=np.float32)
    padded[: len(points)] = points
    return jnp.asarray(padded), jnp.asarray(np.arange(capacity) < len(points))


def as_visible(scene: SceneArrays) -> VisiblePoints:
    """Return a scan as visible points that all count alike."""
    return VisiblePoints(
        points=scene.points,
        normals=jnp.zeros_like(scene.points),
        picture_area=jnp.ones_like(scene.points[:, 0]),
        instance=jnp.full(scene.mask.shape, BIN, dtype=jnp.int32),
        mask=scene.mask,
        visible_fraction=jnp.ones(1),
    )


def first_crop(scene: SceneArrays, diameter: Scalar, key: PRNGKey, config: CropConfig) -> Crop:
    """Return the crop around a scene's first point, without labels."""
    nowhere = jnp.zeros((1, 3)), jnp.eye(4)[None]
    return crop_around(key, as_visible(scene), jnp.int32(0), jnp.bool_(True), *nowhere, diameter, config)


def even_rows(place: Int[Array, " p"], total: Int[Array, ""], count: int) -> Int[Array, " p"]:
    """Return place * total // count, the rows of `count` places that lie evenly among `total`; no product overflows."""
    return place * (total // count) + place * (total % count) // count
