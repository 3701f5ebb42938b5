"""An object on the device: what searches, verification and selection need of it, in the scene's unit."""

from __future__ import annotations

from itertools import permutations, product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from kmn_jax.models import Model
from kmn_jax.objects import Part, PartArrays, Symmetries, arrays_of
from kmn_jax.pose import discretise_symmetry, mssd
from kmn_jax.simulate import Surfels
from kmn_jax.typing import Points, Scalar

_VERIFIED_POINTS = 2048  # on the surface
_SAME_POSE = 0.2  # diameters: poses whose surfaces are nowhere further apart are one
_BREADTHS = 0.5  # of a part, between poses of one copy
_SAME = 0.1  # diameters between points of turned and unturned parts that look the same
_SIMILAR = 0.05  # diameters, in the mean, between the surfaces of parts that may be taken for each other
_COMPARED = 256  # points
_TURNS = 36  # of a continuous symmetry: 10 degrees, under which poses count as the same anyway


class DevicePart(NamedTuple):
    """An object on the device."""

    arrays: PartArrays
    surfels: Surfels
    symmetries: Float[Array, "t 4 4"]
    reach: Scalar  # poses whose surfaces are nowhere further apart are one
    turns: Float[Array, "v 4 4"]  # by which it is taken for another pose of itself, see `main_turns`
    is_rival: Bool[Array, " v"]


def device_part(model: Model, part: Part) -> DevicePart:
    """Put a part onto the device; its lengths must be in the unit of the scenes."""
    transforms = symmetry_transforms(part.symmetries)
    spare = (1 << (len(transforms) - 1).bit_length()) - len(transforms)  # a power of two is compiled
    count = _VERIFIED_POINTS
    return DevicePart(
        arrays_of(model, part),
        Surfels(jnp.asarray(part.points[:count]), jnp.asarray(part.normals[:count]), jnp.float32(part.area)),
        jnp.asarray(np.concatenate([transforms, np.tile(np.eye(4, dtype=np.float32), (spare, 1, 1))])),
        jnp.float32(same_place(part)),
        *map(jnp.asarray, main_turns(part, transforms)),
    )


def same_place(part: Part) -> float:
    """Return how far apart poses of one copy may be: less than slender parts that lie side by side are."""
    breadth = float(np.sort(part.maximum - part.minimum)[1])
    return min(_SAME_POSE * part.diameter, _BREADTHS * breadth)


def symmetry_transforms(symmetries: Symmetries) -> Float[np.ndarray, "t 4 4"]:
    """Return all poses `T_object_object` under which the object looks the same, continuous ones in steps."""
    result = symmetries.transforms
    for axis in symmetries.axes:
        turns = np.asarray(discretise_symmetry(axis.astype(np.float32), symmetries.center.astype(np.float32), _TURNS))
        result = np.einsum("tij,sjk->tsik", turns.astype(float), result).reshape(-1, 4, 4)
    return result.astype(np.float32)


def main_turns(
    part: Part, symmetries: Float[np.ndarray, "t 4 4"]
) -> tuple[Float32[np.ndarray, "v 4 4"], Bool[np.ndarray, " v"]]:
    """Return the 23 turns that map the part's main axes onto each other, about the centroid of its surface.

    These axes are those of its frame, or of its moments, whichever box along them is smaller.
    The flags are false for those under which the part looks the same, or not at all like itself.
    """
    from scipy.spatial import cKDTree

    points = part.points.astype(np.float64)
    center = points.mean(axis=0)
    moments = np.linalg.svd(points - center, full_matrices=False)[2]
    axes = min((np.eye(3), moments), key=lambda axes: float(np.prod(np.ptp(points @ axes.T, axis=0))))
    turns = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.zeros((3, 3))
        turn[range(3), order] = signs
        if np.linalg.det(turn) > 0 and not np.array_equal(turn, np.eye(3)):
            pose = np.eye(4)
            pose[:3, :3] = axes.T @ turn @ axes
            pose[:3, 3] = center - pose[:3, :3] @ center
            turns.append(pose)
    poses = np.array(turns, dtype=np.float32)
    moved = _moved(jnp.asarray(poses), jnp.asarray(part.points[:_COMPARED]), jnp.asarray(symmetries))
    surface, some = cKDTree(points), points[:_COMPARED]
    apart = [surface.query(some @ pose[:3, :3].T + pose[:3, 3])[0].mean() for pose in turns]
    return poses, (np.asarray(moved) > _SAME * part.diameter) & (np.array(apart) <= _SIMILAR * part.diameter)


@jax.jit
def _moved(poses: Float[Array, "v 4 4"], points: Points, symmetries: Float[Array, "t 4 4"]) -> Float[Array, " v"]:
    return jax.lax.map(lambda pose: mssd(pose, jnp.eye(4), points, symmetries), poses)
