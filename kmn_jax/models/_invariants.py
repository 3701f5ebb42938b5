"""What the first EdgeConv sees: raw coordinates and normals as published, or rotation invariants of both.

Distances and cosines are the same for a shape and for its mirror image, so a network of these "invariant" inputs cannot
tell a point of a symmetric part from its mirror image. "chiral" inputs have signed volumes beside them, which change
their sign in a mirror.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.geometry import safe_norm

Inputs = Literal["raw", "invariant", "chiral"]

SCENE_CHANNELS: dict[Inputs, int] = {"raw": 6, "invariant": 4, "chiral": 5}  # of each point of a crop
OBJECT_CHANNELS: dict[Inputs, int] = {"raw": 6, "invariant": 2, "chiral": 2}  # of each point of an object's cloud
PAIR_CHANNELS: dict[Inputs, int] = {"raw": 0, "invariant": 4, "chiral": 6}  # of each edge in the first block
LATER_PAIR_CHANNELS: dict[Inputs, int] = {"raw": 0, "invariant": 0, "chiral": 6}  # and in the second


class EncoderInputs(NamedTuple):
    """Normalised points, the features of each, and the normals from which pair features follow (or None)."""

    xyz: Float[Array, "n 3"]
    point_features: Float[Array, "n f"]
    normals: Float[Array, "n 3"] | None

    def rows(self, indices: Int[Array, " m"]) -> EncoderInputs:
        """Return the points of these indices."""
        normals = None if self.normals is None else self.normals[indices]
        return EncoderInputs(self.xyz[indices], self.point_features[indices], normals)

    def pair_features(
        self, graph: Int[Array, "n k"], chiral: bool, centers: Int[Array, " n"] | None = None
    ) -> Float[Array, "n k p"] | None:
        """Return the point pair features of every edge, from `centers` or else from all points; None for raw inputs.

        They are |d| of d = x_j - x_i and the cosines between n_i and d, n_j and d, n_i and n_j (Drost et al.,
        CVPR 2010, with cosines for angles); on the edge from a point to itself the two with d are zero. The `chiral`
        ones beside them are the volumes of n_i, n_j and d / |d|, and of n_i, d / |d| and x_i: to which side a normal
        turns along the edge, and on which side the neighbour is, seen from outside with the origin ahead.
        """
        if self.normals is None:
            return None
        xyz = self.xyz if centers is None else self.xyz[centers]
        normals = self.normals if centers is None else self.normals[centers]
        difference = self.xyz[graph] - xyz[:, None, :]
        distance = safe_norm(difference)
        direction = difference / jnp.where(distance > 0, distance, 1)[..., None]
        own, other = normals[:, None, :], self.normals[graph]
        features = [distance, _dot(own, direction), _dot(other, direction), _dot(own, other)]
        if chiral:
            features += [_volume(own, other, direction), _volume(own, direction, xyz[:, None, :])]
        return jnp.stack(features, axis=-1)

    def later_pair_features(
        self, graph: Int[Array, "n k"], chiral: bool, centers: Int[Array, " n"] | None = None
    ) -> Float[Array, "n k p"] | None:
        """Return what blocks after the first see of every edge: only `chiral` inputs have pair features there.

        In a graph that the first block has, too, XLA computes them once for both.
        """
        return self.pair_features(graph, True, centers) if chiral else None


def raw_inputs(cloud: Float[Array, "n 6"]) -> EncoderInputs:
    """Return the published inputs: coordinates and normals as they are."""
    return EncoderInputs(cloud[:, :3], cloud, None)


def object_invariants(cloud: Float[Array, "m 6"]) -> EncoderInputs:
    """Return per point the distance from the object's centre (the origin here) and n.x."""
    xyz, normals = cloud[:, :3], cloud[:, 3:]
    return EncoderInputs(xyz, jnp.stack([safe_norm(xyz), _dot(normals, xyz)], axis=1), normals)


def scene_invariants(cloud: Float[Array, "n 6"], mask: Bool[Array, " n"] | None, chiral: bool) -> EncoderInputs:
    """Return per point the distance from the seed (the origin), n.x, n_seed.x and n.n_seed; `chiral`: their volume.

    The seed's normal is that of the (real) point nearest to the origin.
    """
    xyz, normals = cloud[:, :3], cloud[:, 3:]
    squared = _dot(xyz, xyz)
    seed = jnp.argmin(squared if mask is None else jnp.where(mask, squared, jnp.inf))
    seed_normal = normals[seed][None, :]
    features = [safe_norm(xyz), _dot(normals, xyz), _dot(xyz, seed_normal), _dot(normals, seed_normal)]
    if chiral:
        features.append(_volume(normals, seed_normal, xyz))
    return EncoderInputs(xyz, jnp.stack(features, axis=1), normals)


def _dot(a: Float[Array, "... 3"], b: Float[Array, "... 3"]) -> Float[Array, "..."]:
    x, y, z = (a[..., axis] * b[..., axis] for axis in range(3))  # summed up, XLA's CPU compiler vectorises nothing
    return x + y + z


def _volume(a: Float[Array, "... 3"], b: Float[Array, "... 3"], c: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """Return a . (b x c), which changes its sign in a mirror."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = ([v[..., axis] for axis in range(3)] for v in (a, b, c))
    return ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
