"""A pose against the measured surface around it: what of the object's near side is there, and what cannot be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kmn_jax.errors import InputError
from kmn_jax.geometry import first_smallest, inverse, squared_distances, transform_points
from kmn_jax.typing import Mask, Normals, Points, Pose, Scalar


@dataclass(frozen=True)
class SurfaceConfig:
    """Set the comparison; lengths are shares of the object's diameter.

    They have to span the gaps between points: of 1,000 on a crop's surface, neighbours are 0.04 diameters apart.
    """

    tolerance: float = 0.05
    min_cosine: float = 0.5  # between normals that agree
    facing: float = 0.15  # cosine between normal and line of sight from which on a point faces the camera

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        if not self.tolerance > 0 or not -1 <= self.min_cosine < 1 or not 0 <= self.facing < 1:
            raise InputError(
                f"tolerance = {self.tolerance} must be above zero, min_cosine = {self.min_cosine} in [-1, 1) and"
                f" facing = {self.facing} in [0, 1)"
            )


class SurfaceAgreement(NamedTuple):
    """Shares, each from 0 to 1.

    Surface that is hidden, or not measured, is not confirmed, but not seen through either.
    """

    confirmed: Scalar  # of the object's surface that faces the camera: measured there, with a normal like its own
    seen_through: Scalar  # of the same: the camera measured something behind it
    explained: Scalar  # of the measured points taken for the object: on its surface

    @property
    def score(self) -> Scalar:
        """What speaks for a pose less what speaks against it, from -1 to 2."""
        return self.confirmed - self.seen_through + self.explained


def surface_agreement(
    T_scene_object: Pose,
    object_points: Float[Array, "m 3"],
    object_normals: Float[Array, "m 3"],
    scene_points: Points,
    scene_normals: Normals,
    mask: Mask,
    on_object: Bool[Array, " n"],
    camera: Float[Array, "3"],
    object_diameter: Scalar,
    config: SurfaceConfig = SurfaceConfig(),
) -> SurfaceAgreement:
    """Compare an object at a pose with measured points, `on_object` being those taken for it.

    `camera` is the camera's place in the scene's frame. All lengths are in one unit. A pose of which no point faces the
    camera, and points of which none is taken for the object, count as nothing confirmed.
    """
    highest = jax.lax.Precision.HIGHEST
    surface = transform_points(T_scene_object, object_points)
    normals = jnp.matmul(object_normals, T_scene_object[:3, :3].T, precision=highest)
    sight, away = _directions(surface, camera)
    faces = (normals * sight).sum(axis=1) < -config.facing
    reach = config.tolerance * object_diameter

    # As sums over coordinates and minima down columns, CPUs vectorise all of it and store no matrix.
    alike = (_cosines(scene_normals, normals) > config.min_cosine) & mask[:, None]
    confirmed = jnp.where(alike, squared_distances(scene_points, surface), jnp.inf).min(axis=0) <= reach**2

    # Of the measured lines of sight the one that passes nearest: does it end behind the surface?
    lines, ends = _directions(scene_points, camera)
    nearest, beside = first_smallest(jnp.where(mask[:, None], squared_distances(lines, sight), jnp.inf))
    passes = beside * away**2 <= reach**2
    through = passes & (ends[nearest] - away > reach) & ~confirmed

    # From the points' side: in the object's frame, so that the same function of pairs serves.
    local = transform_points(inverse(T_scene_object), scene_points)
    local_normals = jnp.matmul(scene_normals, T_scene_object[:3, :3], precision=highest)
    same = _cosines(object_normals, local_normals) > config.min_cosine
    explained = jnp.where(same, squared_distances(object_points, local), jnp.inf).min(axis=0) <= reach**2
    taken = mask & on_object
    return SurfaceAgreement(_share(confirmed, faces), _share(through, faces), _share(explained, taken))


def _cosines(normals: Float[Array, "a 3"], others: Float[Array, "b 3"]) -> Float[Array, "a b"]:
    """Return the cosines between unit vectors."""
    x, y, z = (normals[:, None, axis] * others[None, :, axis] for axis in range(3))
    return x + y + z


def _directions(
    points: Float[Array, "p 3"], camera: Float[Array, "3"]
) -> tuple[Float[Array, "p 3"], Float[Array, " p"]]:
    offsets = points - camera[None]
    length = jnp.sqrt((offsets**2).sum(axis=1))
    return offsets / jnp.where(length > 0, length, 1)[:, None], length


def _share(which: Bool[Array, " p"], among: Bool[Array, " p"]) -> Scalar:
    return (which & among).sum(dtype=jnp.float32) / jnp.maximum(among.sum(dtype=jnp.int32), 1).astype(jnp.float32)
