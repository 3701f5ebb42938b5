"""What the first EdgeConv sees: raw coordinates and normals as published, or rotation invariants of both."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.geometry import safe_norm

NUM_PAIR_INVARIANTS = 4
NUM_SCENE_INVARIANTS = 4
NUM_OBJECT_INVARIANTS = 2


class EncoderInputs(NamedTuple):
    """Normalised points, the features of each, and the normals from which pair features follow (or None)."""

    xyz: Float[Array, "n 3"]
    point_features: Float[Array, "n f"]
    normals: Float[Array, "n 3"] | None

    def rows(self, indices: Int[Array, " m"]) -> EncoderInputs:
        """Return the points of these indices."""
        normals = None if self.normals is None else self.normals[indices]
        return EncoderInputs(self.xyz[indices], self.point_features[indices], normals)

    def pair_features(self, graph: Int[Array, "n k"]) -> Float[Array, "n k 4"] | None:
        """Return the point pair features of every edge, or None for raw inputs.

        They are |d| of d = x_j - x_i and the cosines between n_i and d, n_j and d, n_i and n_j (Drost et al.,
        CVPR 2010, with cosines for angles); on the edge from a point to itself the two with d are zero.
        """
        if self.normals is None:
            return None
        difference = self.xyz[graph] - self.xyz[:, None, :]
        distance = safe_norm(difference)
        direction = difference / jnp.where(distance > 0, distance, 1)[..., None]
        own, other = self.normals[:, None, :], self.normals[graph]
        return jnp.stack([distance, _dot(own, direction), _dot(other, direction), _dot(own, other)], axis=-1)


def raw_inputs(cloud: Float[Array, "n 6"]) -> EncoderInputs:
    """Return the published inputs: coordinates and normals as they are."""
    return EncoderInputs(cloud[:, :3], cloud, None)


def object_invariants(cloud: Float[Array, "m 6"]) -> EncoderInputs:
    """Return per point the distance from the object's centre (the origin here) and n.x."""
    xyz, normals = cloud[:, :3], cloud[:, 3:]
    return EncoderInputs(xyz, jnp.stack([safe_norm(xyz), _dot(normals, xyz)], axis=1), normals)


def scene_invariants(cloud: Float[Array, "n 6"], mask: Bool[Array, " n"] | None) -> EncoderInputs:
    """Return per point the distance from the seed (the origin), n.x, n_seed.x and n.n_seed.

    The seed's normal is that of the (real) point nearest to the origin.
    """
    xyz, normals = cloud[:, :3], cloud[:, 3:]
    squared = _dot(xyz, xyz)
    seed = jnp.argmin(squared if mask is None else jnp.where(mask, squared, jnp.inf))
    seed_normal = normals[seed][None, :]
    features = [safe_norm(xyz), _dot(normals, xyz), _dot(xyz, seed_normal), _dot(normals, seed_normal)]
    return EncoderInputs(xyz, jnp.stack(features, axis=1), normals)


def _dot(a: Float[Array, "... 3"], b: Float[Array, "... 3"]) -> Float[Array, "..."]:
    x, y, z = (a[..., axis] * b[..., axis] for axis in range(3))  # summed up, XLA's CPU compiler vectorises nothing
    return x + y + z
