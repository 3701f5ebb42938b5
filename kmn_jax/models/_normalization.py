"""Input scaling: "metric" divides both clouds by one length, "released" is that of the authors' weights."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def metric_object(cloud: Float[Array, "m 6"], length: Float[Array, ""]) -> Float[Array, "m 6"]:
    """Centre the points on their mean and divide them by `length`; unit normals stay as they are."""
    xyz = cloud[:, :3]
    return jnp.concatenate([(xyz - xyz.mean(axis=0)[None, :]) / length, cloud[:, 3:]], axis=1)


def metric_scene(crop: Float[Array, "n 6"], length: Float[Array, ""]) -> Float[Array, "n 6"]:
    """Divide the points (seed at the origin) by `length`; unit normals stay as they are."""
    return jnp.concatenate([crop[:, :3] / length, crop[:, 3:]], axis=1)


def released_object(cloud: Float[Array, "m 6"]) -> Float[Array, "m 6"]:
    """Subtract the mean of each of the six channels, divide by the deviation over all entries."""
    centered = cloud - cloud.mean(axis=0)[None, :]
    return centered / _nonzero(centered.std())


def released_scene(crop: Float[Array, "n 6"], mask: Bool[Array, " n"] | None) -> Float[Array, "n 6"]:
    """Divide points (seed at the origin) and normals by the deviation over all real entries."""
    return crop / _nonzero(crop.std() if mask is None else jnp.std(crop, where=mask[:, None]))


def _nonzero(x: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.where(x > 0, x, 1)
