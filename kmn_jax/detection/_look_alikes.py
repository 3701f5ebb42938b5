"""Poses that a part is mistaken for: at them, as at its own, most of its surface lies on the surface that is seen.

They are found by laying the part onto itself, from many rotations, until it stops moving. Half turns of a box with a
notch are such poses, and the legs of a bracket in each other's places, which no turn about an axis of the part finds.
"""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from kmn_jax.geometry import from_rotation_translation, nearest, transform_points
from kmn_jax.objects import Part
from kmn_jax.pose import kabsch
from kmn_jax.programs import kept
from kmn_jax.typing import Points, Scalar

MOST = 24  # look-alikes of a part
_SAME = 0.1  # diameters between points at two poses that are one
_SIMILAR = 0.08  # diameters, in the mean, between the surfaces at two poses of which one is taken for the other
_MOVED, _SURFACE = 128, 1024  # points that are laid onto so many
_COMPARED = 48  # points, by which poses are told apart
_STEPS = 12
_NEAR = 0.1  # diameters: points that lie farther from the surface hardly draw


def look_alikes(
    part: Part, symmetries: Float[np.ndarray, "t 4 4"]
) -> tuple[Float32[np.ndarray, "v 4 4"], Bool[np.ndarray, " v"]]:
    """Return poses `T_object_object` that the part is mistaken for, the most similar first, and which are real.

    No two are the same up to symmetry, and none is a symmetry. Of the last parts they are kept for the next scan.
    """
    points, same = part.points.astype(np.float64), symmetries.astype(np.float64)
    return _of_surface(points.tobytes(), same.tobytes(), part.diameter)


@lru_cache(maxsize=64)
def _of_surface(
    surface: bytes, same: bytes, diameter: float
) -> tuple[Float32[np.ndarray, "v 4 4"], Bool[np.ndarray, " v"]]:
    """Return look-alikes of a part with such points (m, 3) and symmetries (t, 4, 4), in float64, to be shared."""
    points, symmetries = np.frombuffer(surface).reshape(-1, 3), np.frombuffer(same).reshape(-1, 4, 4)
    center, moments = points.mean(axis=0), np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    scaled = ((points - center) / diameter).astype(np.float32)
    centred = _scaled(symmetries, center, 1 / diameter)
    given = jax.device_put((scaled, _starts(moments), centred))
    poses, distance, apart = map(np.asarray, _laid(given[0], given[1], given[2]))
    chosen = [0]  # the pose itself
    for row in np.argsort(distance, kind="stable").tolist():
        if distance[row] <= _SIMILAR and len(chosen) <= MOST and (apart[row, chosen] > _SAME).all():
            chosen.append(row)
    found = np.tile(np.eye(4), (MOST, 1, 1))
    found[: len(chosen) - 1] = _scaled(poses[chosen[1:]].astype(np.float64), -center / diameter, diameter)
    turns, is_real = found.astype(np.float32), np.arange(MOST) < len(chosen) - 1
    turns.flags.writeable = is_real.flags.writeable = False
    return turns, is_real


def _starts(moments: Float[np.ndarray, "3 3"]) -> Float32[np.ndarray, "s 3 3"]:
    """Return rotations, first none: those of a cube and of an icosahedron, about the part's axes and its moments."""
    from scipy.spatial.transform import Rotation

    if np.linalg.det(moments) < 0:
        moments = -moments
    cube, spread = (Rotation.create_group(name).as_matrix() for name in ("O", "I"))
    about = [moments.T @ group @ moments for group in (cube, spread)]
    return np.concatenate([np.eye(3)[None], cube, *about]).astype(np.float32)


def _scaled(
    poses: Float[np.ndarray, "s 4 4"], center: Float[np.ndarray, "3"], factor: float
) -> Float32[np.ndarray, "s 4 4"]:
    """Return motions of a frame as those of one whose origin lies at `center`, with lengths times a factor."""
    result = poses.copy()
    result[:, :3, 3] = factor * (poses[:, :3, 3] + poses[:, :3, :3] @ center - center)
    return result.astype(np.float32)


@kept()
def _laid(
    points: Points, rotations: Float[Array, "s 3 3"], symmetries: Float[Array, "t 4 4"]
) -> tuple[Float[Array, "s 4 4"], Float[Array, " s"], Float[Array, "s s"]]:
    """Return poses of a part of unit size that is laid onto itself, how far its surfaces are apart, and the poses.

    Poses are apart by the farthest point, up to symmetry. The first start stays where it is.
    """
    some, surface = points[:_MOVED], points[:_SURFACE]

    def lay(rotation: Float[Array, "3 3"]) -> tuple[Float[Array, "4 4"], Scalar]:
        def step(_: Int[Array, ""], pose: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
            row, distance = nearest(transform_points(pose, some), surface)
            return kabsch(some, surface[row], 1 / (1 + (distance / _NEAR) ** 2))

        pose = jax.lax.fori_loop(0, _STEPS, step, from_rotation_translation(rotation, jnp.zeros(3, jnp.float32)))
        return pose, nearest(transform_points(pose, some), surface)[1].mean()

    poses, distance = jax.lax.map(lay, rotations)
    poses = poses.at[0].set(jnp.eye(4, dtype=jnp.float32))
    few = jax.vmap(transform_points, in_axes=(0, None))(symmetries, points[:_COMPARED]).reshape(-1, 3)
    looks = jax.vmap(transform_points, in_axes=(0, None))(poses, few)
    looks = looks.reshape(len(rotations), -1, _COMPARED, 3)

    def from_others(pose: Float[Array, "4 4"]) -> Float[Array, " s"]:
        here = transform_points(pose, points[:_COMPARED])
        return jnp.sqrt(((looks - here[None, None]) ** 2).sum(axis=3).max(axis=2)).min(axis=1)

    return poses, distance, jax.lax.map(from_others, poses)
