"""An object on the device: what searches, verification and selection need of it, in the scene's unit."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from kmn_jax.detection._look_alikes import look_alikes
from kmn_jax.models import Model
from kmn_jax.objects import Part, PartArrays, Symmetries, arrays_of
from kmn_jax.pose import discretise_symmetry
from kmn_jax.programs import compiled_size
from kmn_jax.simulate import Surfels
from kmn_jax.typing import Scalar

_VERIFIED_POINTS = 2048  # on the surface
_SAME_POSE = 0.2  # diameters: poses whose surfaces are nowhere further apart are one
_BREADTHS = 0.5  # of a part, between poses of one copy
_TURNS = 36  # of a continuous symmetry: 10 degrees, under which poses count as the same anyway


class DevicePart(NamedTuple):
    """An object on the device."""

    arrays: PartArrays
    surfels: Surfels
    symmetries: Float[Array, "t 4 4"]
    reach: Scalar  # poses whose surfaces are nowhere further apart are one
    turns: Float[Array, "v 4 4"]  # to poses that it is mistaken for, see `look_alikes`
    is_rival: Bool[Array, " v"]  # which turns are real


def device_part(model: Model, part: Part) -> DevicePart:
    """Put a part onto the device; its lengths must be in the unit of the scenes."""
    found = symmetry_transforms(part.symmetries)
    spare = compiled_size(len(found)) - len(found)
    transforms = np.concatenate([found, np.tile(np.eye(4, dtype=np.float32), (spare, 1, 1))])
    count = _VERIFIED_POINTS
    return DevicePart(
        arrays_of(model, part),
        Surfels(jnp.asarray(part.points[:count]), jnp.asarray(part.normals[:count]), jnp.float32(part.area)),
        jnp.asarray(transforms),
        jnp.float32(same_place(part)),
        *map(jnp.asarray, look_alikes(part, transforms)),
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
