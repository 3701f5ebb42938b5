"""What parts lie in or on, inside jit: a bin with slanted walls, rims and dividers, a tray, a table, a bin beside it.

Lengths are in diameters of the object. The frame of a container: origin at the middle of its floor, z up.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from kmn_jax.simulate._splat import evenly_spread
from kmn_jax.typing import Normals, Points, Scalar

_TABLE = 50.0  # half the side of the ground
_SLACK = 1e-3

_WHOLE, _BETWEEN, _OUTSIDE = 0, 1, 2  # what of a face is there: all, what lies between the walls, what lies outside


class Container(NamedTuple):
    """One container; without walls, a table."""

    half: Float[Array, "2"]  # of the floor's length and width
    height: Scalar  # of the walls; 0: there are none
    slope: Scalar  # by which walls lean outwards, as a share of their height
    rim: Scalar  # width of the walls' upper side
    lift: Scalar  # of the floor above the ground
    divider: Float[Array, "2"]  # where one is that cuts the length, and one that cuts the width
    divider_height: Float[Array, "2"]  # 0: there is none
    divider_width: Scalar
    gap: Scalar  # to the next container, towards +x; infinite: there is none

    @property
    def opening(self) -> Float[Array, "2"]:
        """Half the length and width between the walls at their upper end."""
        return self.half + self.slope * self.height

    @property
    def outer(self) -> Float[Array, "2"]:
        """Half the length and width with the rims."""
        return self.opening + self.rim


class _Face(NamedTuple):
    """A rectangle: one corner, two unit directions, their lengths, and the unit normal of its visible side."""

    corner: Float[Array, "3"]
    along: Float[Array, "3"]
    across: Float[Array, "3"]
    size: Float[Array, "2"]
    normal: Float[Array, "3"]


def container_surfels(
    container: Container, centre: Float[Array, "3"], radius: float, count: int
) -> tuple[Points, Normals, Bool[Array, " n"], Scalar]:
    """Return points on a container near a place, their normals, which of them are real, and the area of each.

    They are evenly spread over the parts of its faces that a box of half the side `radius` around the place may meet.
    """
    faces, rules = zip(*_faces(container), strict=True)
    stacked = _Face(*(jnp.stack(list(leaves)) for leaves in zip(*faces, strict=True)))
    away = centre[None] - stacked.corner
    middle = jnp.stack([(away * stacked.along).sum(axis=1), (away * stacked.across).sum(axis=1)], axis=1)
    low = jnp.clip(middle - radius, 0, stacked.size)
    high = jnp.clip(middle + radius, 0, stacked.size)
    near = jnp.abs((away * stacked.normal).sum(axis=1)) < radius
    areas = jnp.where(near, (high - low).prod(axis=1), 0)
    ends = jnp.cumsum(areas)
    first, second = evenly_spread(count)
    place = first * ends[-1]
    face = jnp.minimum((place[:, None] >= ends[None]).sum(axis=1), len(faces) - 1)
    begun = jnp.where(face > 0, ends[jnp.maximum(face - 1, 0)], 0)
    share = (place - begun) / jnp.where(areas[face] > 0, areas[face], 1)
    offsets = low[face] + jnp.stack([share, second], axis=1) * (high - low)[face]
    points = stacked.corner[face] + offsets[:, :1] * stacked.along[face] + offsets[:, 1:] * stacked.across[face]
    x, y, z = jnp.abs(points[:, 0]), jnp.abs(points[:, 1]), points[:, 2]
    wide = container.half[None] + container.slope * jnp.clip(z, 0, container.height)[:, None]
    between = (x <= wide[:, 0] + _SLACK) & (y <= wide[:, 1] + _SLACK)
    outside = (x > container.outer[0]) | (y > container.outer[1])
    rule = jnp.asarray(np.array(rules))[face]
    there = jnp.where(rule == _BETWEEN, between | (container.height <= 0), (rule == _WHOLE) | outside)
    real = (ends[-1] > 0) & there
    return points, stacked.normal[face], real, ends[-1] / count


def hidden_by_container(
    container: Container, eye: Float[Array, "3"], x: Float[Array, " r"], y: Float[Array, " r"], z: Float[Array, " r"]
) -> Bool[Array, " r"]:
    """Tell for which points (x, y, z) walls or dividers cross the line of sight from an eye above the rim."""
    rise = jnp.where(eye[2] > z, eye[2] - z, 1)

    def at_height(height: Scalar) -> tuple[Float[Array, " r"], Float[Array, " r"]]:
        share = jnp.clip((height - z) / rise, 0, 1)
        return x + share * (eye[0] - x), y + share * (eye[1] - y)

    opening, outer, height = container.opening, container.outer, container.height
    walls = height > 0
    inside = (jnp.abs(x) <= opening[0] + _SLACK) & (jnp.abs(y) <= opening[1] + _SLACK) & (z > -_SLACK)
    over_x, over_y = at_height(height)
    leaves = (jnp.abs(over_x) <= opening[0] + _SLACK) & (jnp.abs(over_y) <= opening[1] + _SLACK)
    hidden = walls & inside & (z < height) & ~leaves
    # Points outside, by the block that the container is: where the line of sight is, at three heights.
    for share in (0.02, 0.4, 0.98):
        level = share * (height + container.lift) - container.lift
        at_x, at_y = at_height(level)
        within = (jnp.abs(at_x) < outer[0] - _SLACK) & (jnp.abs(at_y) < outer[1] - _SLACK)
        hidden = hidden | (walls & ~inside & (z < level) & within)
    for axis, (here, there) in enumerate(((x, eye[0]), (y, eye[1]))):
        place, top = container.divider[axis], container.divider_height[axis]
        way = (place - here) / jnp.where(jnp.abs(there - here) > _SLACK, there - here, _SLACK)
        crossing = z + way * (eye[2] - z)
        beside = jnp.abs(here - place) > container.divider_width / 2 + _SLACK
        hidden = hidden | (inside & beside & (way > 0) & (way < 1) & (crossing < top))
    return hidden


def _faces(container: Container) -> list[tuple[_Face, int]]:
    """Return all faces, with what of them is there; those that the container lacks have no size."""
    half, opening, outer = container.half, container.opening, container.outer
    height, rim, lift, width = container.height, container.rim, container.lift, container.divider_width
    walls = (height > 0).astype(jnp.float32)
    zero, (x, y, z) = jnp.zeros(()), jnp.eye(3)
    floor = jnp.where(height > 0, half, _TABLE)
    result: list[tuple[_Face, int]] = []

    def add(corner: list[Array], along: Array, across: Array, sizes: list[Array], normal: Array, rule: int = 0) -> None:
        result.append((_Face(jnp.stack(corner), along, across, jnp.stack(sizes), normal), rule))

    add([-floor[0], -floor[1], zero], x, y, [2 * floor[0], 2 * floor[1]], z)
    ground = 2 * _TABLE * walls
    add([zero - _TABLE, zero - _TABLE, -lift], x, y, [ground, ground], z, _OUTSIDE)
    slant = jnp.sqrt(1 + container.slope**2)
    for axis, other in ((0, 1), (1, 0)):
        side, wide = (y, x)[axis], 2 * opening[other]

        def at(place: Array, start: Array, level: Array, axis: int = axis) -> list[Array]:
            return [place, -start, level] if axis == 0 else [-start, place, level]

        top, middle = container.divider_height[axis] * walls, container.divider[axis]
        for sign in (1.0, -1.0):
            out = sign * (x, y)[axis]
            up, inwards = (z + container.slope * out) / slant, (container.slope * z - out) / slant
            add(at(sign * half[axis], opening[other], zero), side, up, [wide, height * slant], inwards, _BETWEEN)
            outside = [2 * outer[other], walls * (height + lift)]
            add(at(sign * outer[axis], outer[other], -lift), side, z, outside, out)
            length = outer[other] if axis == 0 else opening[other]  # corners belong to the first two rims
            add(at(sign * opening[axis], length, height), side, out, [2 * length, walls * rim], z)
            add(at(middle + sign * width / 2, opening[other], zero), side, z, [wide, top], out, _BETWEEN)
        above = [wide, jnp.where(top > 0, width, 0)]
        add(at(middle - width / 2, opening[other], top), side, (x, y)[axis], above, z, _BETWEEN)
    # Of the next container, what is seen over the gap: its outer side, its rim, and the far wall from inside.
    there = jnp.where(jnp.isfinite(container.gap), walls, 0)
    begin = outer[0] + jnp.where(jnp.isfinite(container.gap), container.gap, 0)
    add([begin, -outer[1], -lift], y, z, [there * 2 * outer[1], height + lift], -x)
    add([begin, -outer[1], height], x, y, [rim, there * 2 * outer[1]], z)
    add([begin + rim + 2 * opening[0], -opening[1], zero], y, z, [there * 2 * opening[1], height], -x)
    return result
