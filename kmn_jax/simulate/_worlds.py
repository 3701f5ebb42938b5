"""Scenes made inside of a training step, from nothing but surfels: piles, rows and flat parts in all kinds of worlds.

No physics: copies are let down one after the other, as they were turned, until they touch what lies below, by a map of
heights. What a crop shows of a pile hardly depends on how its parts came to rest, but on what lies around and behind.
Scenes are as large as a crop needs, around one copy. Lengths are in diameters of the object until the scene is done.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.errors import InputError
from kmn_jax.geometry import random_rotation
from kmn_jax.simulate._containers import Container, container_surfels, hidden_by_container
from kmn_jax.simulate._splat import (
    BIN,
    FOREIGN,
    PlacedSurfels,
    Surfels,
    VisiblePoints,
    draw_discs,
    facing,
    place_surfels,
    unhidden,
    visible_points_of,
)
from kmn_jax.typing import Pose, PRNGKey, Scalar

_CELLS = 64  # along both sides of the map of heights, ...
_REACH = 2.3  # ... which goes so far to each side
_MAPPED = 1024  # surfels of a part that the map knows
_AROUND = 2.0  # how far from the copy in the middle background is made
_SLIVERS = 8  # normals of a part, of which one is turned down when it lies flat


@dataclass(frozen=True)
class WorldConfig:
    """How worlds are drawn; shares are of the scenes."""

    slots: int = 9  # parts at most
    background_points: int = 16_384
    resolution: int = 512  # of the z-buffer
    tables: float = 0.25  # without walls
    trays: float = 0.15  # of low walls, in which parts touch
    dividers: float = 0.2  # of the bins
    neighbours: float = 0.3  # bins beside bins
    rows: float = 0.12  # all parts turned alike, side by side
    foreign: float = 0.3  # with parts of another kind among the copies
    removed: float = 0.2  # the background is known and was removed, ...
    half_removed: float = 0.2  # ... or not all of it, and some of the parts too
    distance: tuple[float, float] = (3.0, 30.0)  # of the camera
    tilt: float = 50.0  # degrees from the vertical, at most

    def __post_init__(self) -> None:
        if self.slots < 1 or self.background_points < 1 or self.resolution < 2:
            raise InputError("slots and background_points must be 1 or more, resolution 2 or more")
        for sum_of in (("tables", "trays"), ("dividers",), ("neighbours",), ("rows",), ("foreign",)):
            _check_shares(self, sum_of)
        _check_shares(self, ("removed", "half_removed"))
        if not 2 <= self.distance[0] <= self.distance[1] < math.inf or not 0 <= self.tilt <= 60:
            raise InputError(f"distance = {self.distance} must be a range from 2 on, and tilt = {self.tilt} up to 60")


class World(NamedTuple):
    """What a camera sees of a scene, and where the copies are; the unit is that of the surfels."""

    visible: VisiblePoints
    T_camera_object: Float[Array, "c 4 4"]
    centre: Float[Array, "3"]  # of the copy around which the scene was made, in the camera's frame


def make_world(key: PRNGKey, part: Surfels, other: Surfels, diameter: Scalar, config: WorldConfig) -> World:
    """Draw a world of copies of a part, in some of them among parts of another kind.

    Args:
        key: of all randomness.
        part: surfels in its own frame.
        other: as many, of the other kind, in its own frame; they are scaled to about the part's size.
        diameter: of the part.
        config: how worlds are drawn.
    """
    keys = jax.random.split(key, 10)
    is_foreign = _foreign_slots(keys[0], config)
    shapes = _shapes(keys[1], part, other, diameter, is_foreign)
    container = _draw_container(keys[2], config)
    shift = jax.random.uniform(keys[3], (2,), minval=-1.0) * jnp.maximum(container.half - 0.5, 0)
    rotations, places, there = _arranged(keys[4], shapes, container, shift, config)
    T_world_object = jnp.tile(jnp.eye(4), (config.slots, 1, 1))
    T_world_object = T_world_object.at[:, :3, :3].set(rotations).at[:, :3, 3].set(places)
    low, high = shapes.points.min(axis=1), shapes.points.max(axis=1)
    centre = (rotations[0] * ((low + high) / 2)[0][None]).sum(axis=1) + places[0]

    T_camera_world = _draw_camera(keys[5], centre, config)
    placed = place_surfels(shapes, T_camera_world @ T_world_object, there)
    spacing = jnp.repeat(jnp.sqrt(shapes.area / shapes.points.shape[1]), shapes.points.shape[1])
    drawn = facing(placed)
    buffer = draw_discs(placed, drawn, spacing, config.resolution)

    # The container's frame is the world's, moved sideways.
    offset = jnp.concatenate([shift, jnp.zeros(1)])
    points, normals, real, area = container_surfels(container, centre - offset, _AROUND, config.background_points)
    T_camera_container = T_camera_world.at[:3, 3].add((T_camera_world[:3, :3] * offset[None]).sum(axis=1))
    background = place_surfels(
        Surfels(points, normals, area * config.background_points), T_camera_container[None], jnp.ones(1, dtype=bool)
    )
    background = background._replace(real=background.real & real)
    eye = -(T_camera_container[:3, :3] * T_camera_container[:3, 3:]).sum(axis=0)
    removal = _draw_removal(keys[6], centre - offset, config)

    def seen(rows: PlacedSurfels, spacing: Array, is_background: bool) -> Bool[Array, " r"]:
        rotation, translation = T_camera_container[:3, :3], T_camera_container[:3, 3]
        away = [rows.points[i] - translation[i] for i in range(3)]
        x, y, z = (sum((rotation[j, i] * away[j] for j in range(1, 3)), rotation[0, i] * away[0]) for i in range(3))
        over = ~hidden_by_container(container, eye, x, y, z)
        left = _left(removal, container, x, y, z, is_background)
        return facing(rows) & unhidden(rows, buffer, spacing) & over & left

    visible = visible_points_of(
        config.slots,
        (placed, seen(placed, spacing, False)),
        (background, seen(background, spacing.min(), True)),
    )
    own = jnp.concatenate([is_foreign, jnp.zeros(1, dtype=bool)])[visible.instance]  # BIN is the last one
    fraction = jnp.where(is_foreign, 0, visible.visible_fraction)
    poses = T_camera_world @ T_world_object
    visible = visible._replace(
        points=visible.points * diameter,
        instance=jnp.where(own & (visible.instance != BIN), FOREIGN, visible.instance),
        visible_fraction=fraction,
    )
    return World(
        visible,
        poses.at[:, :3, 3].multiply(diameter),
        ((T_camera_world[:3, :3] * centre[None]).sum(axis=1) + T_camera_world[:3, 3]) * diameter,
    )


def _foreign_slots(key: PRNGKey, config: WorldConfig) -> Bool[Array, " c"]:
    some_key, share_key, slot_key = jax.random.split(key, 3)
    share = 0.2 + 0.6 * jax.random.uniform(share_key)
    chosen = jax.random.uniform(slot_key, (config.slots,)) < share
    # The first slot, in the middle, is foreign now and then only: else there is little to learn from the scene.
    chosen = chosen & ((jnp.arange(config.slots) > 0) | (jax.random.uniform(jax.random.fold_in(slot_key, 1)) < 0.2))
    return chosen & (jax.random.uniform(some_key) < config.foreign)


def _shapes(key: PRNGKey, part: Surfels, other: Surfels, diameter: Scalar, is_foreign: Bool[Array, " c"]) -> Surfels:
    """Return the surfels of each slot, in diameters."""
    reach = jnp.sqrt(((other.points - other.points.mean(axis=0)[None]) ** 2).sum(axis=1).max())
    size = 0.5 * 3 ** jax.random.uniform(key) / jnp.maximum(2 * reach, 1e-12)
    which = is_foreign[:, None, None]
    return Surfels(
        jnp.where(which, other.points[None] * size, part.points[None] / diameter),
        jnp.where(which, other.normals[None], part.normals[None]),
        jnp.where(is_foreign, other.area * size**2, part.area / diameter**2),
    )


def _draw_container(key: PRNGKey, config: WorldConfig) -> Container:
    keys = jax.random.split(key, 12)
    share = [jax.random.uniform(key) for key in keys]
    table, tray = share[0] < config.tables, share[0] >= 1 - config.trays
    height = jnp.where(table, 0, jnp.where(tray, 0.08 + 0.3 * share[1], 0.3 + 1.4 * share[1]))
    split = (share[2] < config.dividers) & ~table
    half = 0.6 * 4 ** jax.random.uniform(keys[3], (2,))
    walls = jnp.stack([share[4] < 0.7, share[4] > 0.5]) & split
    return Container(
        half=half,
        height=height,
        slope=jnp.where(share[5] < 0.4, 0, 0.7 * (share[5] - 0.4)),
        rim=0.01 * 60 ** share[6],
        lift=jnp.where(table, 0, 0.02 + 0.3 * share[7]),
        divider=half * jax.random.uniform(keys[8], (2,), minval=-0.8, maxval=0.8),
        divider_height=jnp.where(walls, height * (0.3 + 0.6 * share[9]), 0),
        divider_width=0.02 + 0.15 * share[10] ** 2,
        gap=jnp.where(share[11] < config.neighbours, 0.5 * share[11] / max(config.neighbours, 1e-6), jnp.inf),
    )


def _arranged(
    key: PRNGKey, shapes: Surfels, container: Container, shift: Float[Array, "2"], config: WorldConfig
) -> tuple[Float[Array, "c 3 3"], Float[Array, "c 3"], Bool[Array, " c"]]:
    """Turn the parts and let them down, the one in the middle anywhere in the order; tell which slots are filled."""
    keys = jax.random.split(key, 10)
    slots = config.slots
    in_rows = jax.random.uniform(keys[0]) < config.rows
    lying = jnp.clip(2 * jax.random.uniform(keys[1]) - 0.5, 0, 1)  # share of the parts that lie on a face
    free = jax.vmap(random_rotation)(jax.random.split(keys[2], slots))
    flat = jax.vmap(_lying)(jax.random.split(keys[3], slots), shapes.normals)
    rotations = jnp.where((jax.random.uniform(keys[4], (slots,)) < lying)[:, None, None], flat, free)
    turn = jnp.where(jax.random.uniform(keys[5]) < 0.7, flat[0], free[0])
    rotations = jnp.where(in_rows, turn[None], rotations)

    mapped = shapes.points[:, :_MAPPED]
    columns = [
        sum(
            (rotations[:, i, j, None] * mapped[:, :, j] for j in range(1, 3)),
            rotations[:, i, 0, None] * mapped[:, :, 0],
        )
        for i in range(3)
    ]
    low = jnp.stack([column.min(axis=1) for column in columns], axis=1)
    high = jnp.stack([column.max(axis=1) for column in columns], axis=1)
    middle, extent = (low + high) / 2, high - low
    spread = 0.25 + 1.0 * jax.random.uniform(keys[6])
    centres = jnp.clip(spread * jax.random.normal(keys[7], (slots, 2)), -1.6, 1.6).at[0].multiply(0.1)
    pitch = extent[0, :2] * (1 + 0.15 * jax.random.uniform(keys[8]) ** 2)
    grid = jnp.stack([jnp.array([0, 1, -1, 0, 0, 1, 1, -1, -1]), jnp.array([0, 0, 0, 1, -1, 1, -1, 1, -1])], axis=1)
    grid = jnp.resize(grid, (slots, 2)).astype(jnp.float32)
    centres = jnp.where(in_rows, centres[:1] + grid * pitch[None], centres)
    # Between the walls, as far as a part fits there.
    room = jnp.where(container.height > 0, container.half, jnp.inf)
    least = jnp.minimum((shift - room)[None] + extent[:, :2] / 2, shift[None])
    most = jnp.maximum((shift + room)[None] - extent[:, :2] / 2, shift[None])
    centres = jnp.clip(centres, least, most)
    count = jax.random.randint(keys[9], (), 1, slots + 1)
    order = jax.random.permutation(jax.random.fold_in(keys[9], 1), slots)
    filled = (jnp.arange(slots) < count) | in_rows
    places = centres - middle[:, :2]
    cells = [
        jnp.clip(((column + place[:, None] + _REACH) * (_CELLS / (2 * _REACH))).astype(jnp.int32), 0, _CELLS - 1)
        for column, place in zip(columns[:2], places.T, strict=True)
    ]
    cell = cells[0] * _CELLS + cells[1]

    def lower(heights: Float[Array, " cells"], slot: Int[Array, ""]) -> tuple[Float[Array, " cells"], Scalar]:
        z = columns[2][slot]
        under = jnp.full(_CELLS**2, jnp.inf).at[cell[slot]].min(z)
        over = jnp.full(_CELLS**2, -jnp.inf).at[cell[slot]].max(z)
        rise = jnp.where(filled[slot], (heights - under).max(), 0)
        return jnp.where(filled[slot], jnp.maximum(heights, over + rise), heights), rise

    rises = jax.lax.scan(lower, jnp.zeros(_CELLS**2), order)[1]
    z = jnp.zeros(slots).at[order].set(rises)
    return rotations, jnp.concatenate([places, z[:, None]], axis=1), filled


def _lying(key: PRNGKey, normals: Float[Array, "m 3"]) -> Float[Array, "3 3"]:
    """Return a rotation that turns one of a part's sides down: the larger a flat side, the more likely."""
    row_key, turn_key = jax.random.split(key)
    rows = jax.random.randint(row_key, (_SLIVERS,), 0, normals.shape[0])
    chosen = normals[rows]
    alike = jnp.matmul(chosen, normals.T, precision=jax.lax.Precision.HIGHEST) > 0.99
    down = chosen[alike.sum(axis=1).argmax()]
    # Householder reflections of down to -z and then of one horizontal direction make a rotation.
    axis = down + jnp.array([0.0, 0.0, 1.0])
    square = (axis**2).sum()
    reflected = jnp.eye(3) - jnp.where(square > 1e-6, 2 / jnp.maximum(square, 1e-6), 0) * axis[:, None] * axis[None]
    reflected = jnp.where(square > 1e-6, reflected, jnp.diag(jnp.array([1.0, 1.0, -1.0])))
    angle = 2 * jnp.pi * jax.random.uniform(turn_key)
    cos, sin, zero = jnp.cos(angle), jnp.sin(angle), jnp.zeros(())
    mirror = jnp.stack([jnp.stack([cos, sin, zero]), jnp.stack([sin, -cos, zero]), jnp.stack([zero, zero, zero + 1])])
    return jnp.matmul(mirror, reflected, precision=jax.lax.Precision.HIGHEST)


def _draw_camera(key: PRNGKey, target: Float[Array, "3"], config: WorldConfig) -> Pose:
    keys = jax.random.split(key, 5)
    least, most = config.distance
    distance = least * (most / least) ** jax.random.uniform(keys[0])
    # Small tilts are the rule.
    tilt = math.radians(config.tilt) * jax.random.uniform(keys[1]) ** 1.5
    side = 2 * jnp.pi * jax.random.uniform(keys[2])
    back = jnp.stack([jnp.sin(tilt) * jnp.cos(side), jnp.sin(tilt) * jnp.sin(side), jnp.cos(tilt)])
    roll = 2 * jnp.pi * jax.random.uniform(keys[3])
    level = jnp.stack([-jnp.sin(side), jnp.cos(side), jnp.zeros(())])
    other = jnp.cross(back, level)
    right = jnp.cos(roll) * level + jnp.sin(roll) * other
    down = jnp.cross(-back, right)
    rotation = jnp.stack([right, down, -back])
    # The place that the camera looks at lies aside.
    aside = 0.25 * distance * jax.random.uniform(keys[4], (2,), minval=-1.0)
    translation = -(rotation * (target + distance * back)[None]).sum(axis=1)
    return jnp.eye(4).at[:3, :3].set(rotation).at[:2, 3].set(translation[:2] + aside).at[2, 3].set(translation[2])


class _Removal(NamedTuple):
    """How the background of a scene was taken away: wholly, or badly, or not at all."""

    whole: Bool[Array, ""]
    bad: Bool[Array, ""]
    margin: Scalar  # nearer to floor and walls, points of the parts go too where it was done badly, ...
    patches: Float[Array, "p 3"]  # ... and background stays in these balls
    radii: Float[Array, " p"]


def _draw_removal(key: PRNGKey, centre: Float[Array, "3"], config: WorldConfig) -> _Removal:
    keys = jax.random.split(key, 4)
    place = jax.random.uniform(keys[0])
    whole = place < config.removed
    return _Removal(
        whole,
        ~whole & (place < config.removed + config.half_removed),
        0.004 * 10 ** jax.random.uniform(keys[1]),
        centre[None] + 0.7 * jax.random.normal(keys[2], (3, 3)),
        0.5 * jax.random.uniform(keys[3], (3,)),
    )


def _left(removal: _Removal, container: Container, x: Array, y: Array, z: Array, background: bool) -> Bool[Array, " r"]:
    """Tell which points, of the background or of parts, are left."""
    if background:
        left = jnp.zeros_like(x, dtype=bool)
        for patch, radius in zip(removal.patches, removal.radii, strict=True):
            left = left | ((x - patch[0]) ** 2 + (y - patch[1]) ** 2 + (z - patch[2]) ** 2 < radius**2)
        return ~(removal.whole | (removal.bad & ~left))
    wide = container.half[None] + container.slope * jnp.clip(z, 0)[:, None] - removal.margin
    at_wall = (container.height > 0) & ((jnp.abs(x) > wide[:, 0]) | (jnp.abs(y) > wide[:, 1]))
    return ~(removal.bad & ((z < removal.margin) | at_wall))


def _check_shares(config: WorldConfig, names: tuple[str, ...]) -> None:
    values = [getattr(config, name) for name in names]
    if min(values) < 0 or sum(values) > 1:
        raise InputError(f"world config: {' + '.join(names)} is {sum(values)}, but shares must be from 0 to 1")
