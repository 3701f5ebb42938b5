"""Parts without a network: a box, whose poses can be checked by hand, and any object."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from kmn_jax.detection import DevicePart, same_place, symmetry_transforms
from kmn_jax.objects import ObjectModel, Part, PartArrays, Symmetries
from kmn_jax.simulate import Surfels

HALF = np.array([1.0, 0.5, 0.5])


def box_part(
    count: int = 256, seed: int = 0, rotations: np.ndarray | None = None, axes: np.ndarray | None = None
) -> Part:
    """Return a box of 2 x 1 x 1 about the origin; it is symmetric only as far as is said."""
    rng = np.random.default_rng(seed)
    axis, sign = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    points = rng.uniform(-1, 1, (count, 3)) * HALF
    points[np.arange(count), axis] = sign * HALF[axis]
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = sign
    symmetries = Symmetries(
        np.eye(3)[None] if rotations is None else rotations,
        np.zeros((0, 3)) if axes is None else axes,
        np.zeros(3),
        0.02,
    )
    return Part(
        name="box",
        unit="m",
        points=points.astype(np.float32),
        normals=normals.astype(np.float32),
        features=np.zeros((8, 4), dtype=np.float32),
        diameter=float(2 * np.linalg.norm(HALF)),
        minimum=-HALF,
        maximum=HALF,
        area=10.0,
        symmetries=symmetries,
        source_digest="",
        model_digest="",
    )


def part_of(model: ObjectModel) -> Part:
    """Return an object as a part."""
    return Part(
        model.name,
        model.unit,
        model.points.astype(np.float32),
        model.normals.astype(np.float32),
        np.zeros((8, 4), np.float32),
        model.diameter,
        model.minimum,
        model.maximum,
        model.area,
        model.symmetries,
        "",
        "",
    )


def on_device(part: Part) -> DevicePart:
    """Put a part onto the device, without a network and without what it looks like."""
    points, normals = jnp.asarray(part.points), jnp.asarray(part.normals)
    arrays = PartArrays(points, normals, jnp.zeros((8, 4)), jnp.float32(part.diameter))
    surfels = Surfels(points, normals, jnp.float32(part.area))
    symmetries, reach = jnp.asarray(symmetry_transforms(part.symmetries)), jnp.float32(same_place(part))
    return DevicePart(arrays, surfels, symmetries, reach, jnp.eye(4)[None], jnp.zeros(1, bool))
