"""Which points of a bin a camera sees, inside jit: from stored bits, or by splatting surfels into a z-buffer.

Surfels are the points and normals of an object's surface; a scene is one object's surfels under the poses of its
copies. All of it is one scene at a time, in arrays of a fixed size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8

from kmn_jax.errors import InputError
from kmn_jax.geometry import Intrinsics, inverse
from kmn_jax.typing import Mask, Normals, Points, Pose, Scalar

BIN = -1  # the instance of points on the bin, and of all else that is no part
FOREIGN = -2  # that of points on parts of another kind

# Of the plastic number, in units of 2**-32: the two-dimensional sequence that spreads most evenly (Roberts, "R2").
_STEPS = (3242174889, 2447445414)

# In the surfels' mean spacing. These agree best with ray casting on piles of electronic components and mechanical
# parts, see benchmarks/scenes.py. Discs reach beyond the edge of a surface. So that they do not hide the face next to
# it, whether a point is hidden is asked for a place above it, along its normal.
_PIXEL = 0.75  # side of a pixel at the surfels' mean depth, more if the scene is too large for the buffer
_DISC_RADIUS = 0.9
_STEEPEST = 1.5  # a disc's depth departs from its centre's by at most this
_LIFT = 0.6  # how far above a point its visibility is tested
_TOLERANCE = 0.4  # how far behind the buffer that place may lie


class Surfels(NamedTuple):
    """Evenly spread points of a surface with their normals, in the frame of its object."""

    points: Points
    normals: Normals  # unit, outwards
    area: Scalar  # of the whole surface, in the square of the points' unit


class BinInView(NamedTuple):
    """The bin in front of a camera: inner length, width and height, and the pose of its frame."""

    size: Float[Array, " 3"]
    T_camera_bin: Pose


class VisiblePoints(NamedTuple):
    """Surface points in the camera frame and which of them the camera sees, r = copies x surfels + bin surfels."""

    points: Float[Array, "r 3"]  # finite everywhere
    normals: Float[Array, "r 3"]  # unit, outwards; zero where padded
    picture_area: Float[Array, " r"]  # that the surface around a point covers at focal length 1; 0 if facing away
    instance: Int[Array, " r"]  # index of the copy, or BIN
    mask: Bool[Array, " r"]  # true where the camera sees the point
    # Per copy: the visible share of the picture area that its surface facing the camera would cover unhidden.
    visible_fraction: Float[Array, " c"]


@dataclass(frozen=True)
class SplatConfig:
    """Choose how finely splatting draws."""

    resolution: int = 512  # pixels of the z-buffer along each side
    num_bin_surfels: int = 16384  # points made on the bin's floor and walls if there is a bin

    def __post_init__(self) -> None:
        if self.resolution < 2 or self.num_bin_surfels < 1:
            raise InputError(f"resolution = {self.resolution} and num_bin_surfels = {self.num_bin_surfels} are too few")


def evenly_spread(count: int) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return points of the unit square that follow a fixed rule and spread evenly, however many are taken."""
    # Exact in integers, which wrap around where a fraction starts again.
    index = jnp.arange(1, count + 1, dtype=jnp.uint32)
    first, second = (((index * jnp.uint32(step)) >> 8).astype(jnp.float32) / 2**24 for step in _STEPS)
    return first, second


@partial(jax.jit, static_argnames="count")
def bin_surfels(size: Float[Array, " 3"], count: int) -> Surfels:
    """Return points on the floor and the inner walls of a bin of inner length, width and height, in its frame.

    They follow a fixed rule and spread evenly over all five faces, so they need not be stored. The normals
    point into the bin.
    """
    length, width, height = size
    floor, perimeter = length * width, 2 * (length + width)
    area = floor + perimeter * height
    fractions = evenly_spread(count)
    along = fractions[0] * area
    on_floor = along < floor
    # The floor, and then the walls unrolled from one corner: +x, +y, -x, -y.
    turn = jnp.where(on_floor, 0, (along - floor) / height)
    corners = jnp.cumsum(jnp.stack([jnp.zeros_like(length), length, width, length]))
    wall = (turn[:, None] >= corners[None, 1:]).sum(axis=1, dtype=jnp.int32)
    rest = turn - corners[wall]
    half_length, half_width = length / 2, width / 2
    x = jnp.select(
        [wall == 0, wall == 1, wall == 2], [rest - half_length, half_length, half_length - rest], -half_length
    )
    y = jnp.select([wall == 0, wall == 1, wall == 2], [-half_width, rest - half_width, half_width], half_width - rest)
    x = jnp.where(on_floor, fractions[0] * area / width - half_length, x)
    y = jnp.where(on_floor, fractions[1] * width - half_width, y)
    z = jnp.where(on_floor, 0, fractions[1] * height)
    inwards = jnp.array([[0, 1, 0], [-1, 0, 0], [0, -1, 0], [1, 0, 0]], dtype=jnp.float32)
    normals = jnp.where(on_floor[:, None], jnp.array([[0, 0, 1]], dtype=jnp.float32), inwards[wall])
    return Surfels(jnp.stack([x, y, z], axis=1), normals, area)


def visible_from_bits(
    surfels: Surfels,
    T_camera_object: Float[Array, "c 4 4"],
    copies: Bool[Array, " c"],
    bits: UInt8[Array, "c m8"],
    bin_in_view: BinInView | None = None,
    bin_bits: UInt8[Array, " b8"] | None = None,
    bin_splits: int = 1,
) -> VisiblePoints:
    """Return the points that visibility bits name, 8 surfels a byte, the lowest bit first.

    `copies` is false for padding, whose poses and bits may hold anything. With a bin and its bits there are 8 bin
    surfels, those of `bin_surfels`, for each of their bytes. They are few for so large a surface; `bin_splits` cuts the
    square that each stands for into so many rows and columns of points, which are all visible or none. Raises
    InputError if bits and surfels differ in number, or if only one of bin and bin bits is given.
    """
    m = surfels.points.shape[0]
    if 8 * bits.shape[1] != m:
        raise InputError(f"{8 * bits.shape[1]} bits a copy do not fit {m} surfels")
    if (bin_in_view is None) != (bin_bits is None):
        raise InputError("bin_in_view and bin_bits belong together: give both or none")
    visible = jnp.unpackbits(bits, axis=1, bitorder="little").reshape(-1) > 0
    placed = place_surfels(surfels, T_camera_object, copies)
    if bin_in_view is None or bin_bits is None:
        return visible_points_of(len(copies), (placed, visible))
    on_bin = _place_bin(bin_in_view, 8 * bin_bits.shape[0], bin_splits)
    bin_visible = jnp.tile(jnp.unpackbits(bin_bits, bitorder="little") > 0, bin_splits**2)
    return visible_points_of(len(copies), (placed, visible), (on_bin, bin_visible))


def visible_by_splatting(
    surfels: Surfels,
    T_camera_object: Float[Array, "c 4 4"],
    copies: Bool[Array, " c"],
    camera: Intrinsics,
    bin_in_view: BinInView | None = None,
    config: SplatConfig = SplatConfig(),
) -> VisiblePoints:
    """Return the points that a camera sees, for any camera in front of the objects.

    Surfels that face the camera are drawn as discs of their tangent plane into a z-buffer over the part of the image
    that holds them. A point is visible if it faces the camera, lies inside the image and is not hidden by the buffer.
    Copies are padded as in `visible_from_bits`. What the bin's walls hide from a camera above the rim is exact; a
    camera below it sees only what rises above it.
    """
    spacing = jnp.sqrt(surfels.area / surfels.points.shape[0])
    placed = place_surfels(surfels, T_camera_object, copies)
    drawn = facing(placed) & _in_image(placed, camera)
    buffer = draw_discs(placed, drawn, spacing, config.resolution)
    visible = drawn & unhidden(placed, buffer, spacing)
    if bin_in_view is None:
        return visible_points_of(len(copies), (placed, visible))
    on_bin = _place_bin(bin_in_view, config.num_bin_surfels)
    bin_visible = facing(on_bin) & _in_image(on_bin, camera) & unhidden(on_bin, buffer, spacing)
    parts = ((rows, seen & _over_rim(rows, bin_in_view)) for rows, seen in ((placed, visible), (on_bin, bin_visible)))
    return visible_points_of(len(copies), *parts)


def picture_by_splatting(
    surfels: Surfels,
    T_camera_object: Pose,
    points: Points,
    camera: Intrinsics,
    config: SplatConfig = SplatConfig(),
) -> tuple[VisiblePoints, Float[Array, " p"]]:
    """Return what a camera sees of one object alone, and its depth in the directions of points, infinite beside it."""
    spacing = jnp.sqrt(surfels.area / surfels.points.shape[0])
    placed = place_surfels(surfels, T_camera_object[None], jnp.ones(1, dtype=bool))
    drawn = facing(placed) & _in_image(placed, camera)
    buffer = draw_discs(placed, drawn, spacing, config.resolution)
    x, y, z = points.T
    visible = visible_points_of(1, (placed, drawn & unhidden(placed, buffer, spacing)))
    return visible, jnp.where(z > 0, _depth_towards((x, y, z), buffer), jnp.inf)


class PlacedSurfels(NamedTuple):
    """Surfels in the camera frame, one array per coordinate: sums over an axis of 3 are slow on CPUs."""

    points: tuple[Float[Array, " r"], Float[Array, " r"], Float[Array, " r"]]
    normals: tuple[Float[Array, " r"], Float[Array, " r"], Float[Array, " r"]]
    plane: Float[Array, " r"]  # points . normals, below zero where the surface faces the camera
    area: Float[Array, "*rows"]  # of one surfel, or of each
    real: Mask


class DepthBuffer(NamedTuple):
    """Depths over the part of the picture that surfels take."""

    depth: Float[Array, " pixels"]  # infinite where nothing was drawn
    low: tuple[Scalar, Scalar]  # x / z and y / z at the centre of the first pixel
    pitch: tuple[Scalar, Scalar]  # from pixel to pixel


def place_surfels(surfels: Surfels, T_camera_object: Float[Array, "c 4 4"], copies: Bool[Array, " c"]) -> PlacedSurfels:
    """Return the surfels of all copies in the camera frame; those of each, if they have a leading axis for copies."""
    m = surfels.points.shape[-2]
    pose = jnp.where(copies[:, None, None], T_camera_object.astype(jnp.float32), jnp.eye(4, dtype=jnp.float32)[None])

    def rotated(vectors: Float[Array, "*c m 3"]) -> list[Float[Array, " r"]]:
        # Not as a product of matrices: what follows is computed with it in one go.
        columns = jnp.moveaxis(vectors, -1, 0)
        columns = columns[:, None, :] if vectors.ndim == 2 else columns
        rows = [
            sum((pose[:, i, j, None] * columns[j] for j in range(1, 3)), pose[:, i, 0, None] * columns[0])
            for i in range(3)
        ]
        return [row.reshape(-1) for row in rows]

    shift = [jnp.repeat(pose[:, i, 3], m) for i in range(3)]
    points = [row + offset for row, offset in zip(rotated(surfels.points), shift, strict=True)]
    normals = rotated(surfels.normals)
    x, y, z = points
    nx, ny, nz = normals
    plane = x * nx + y * ny + z * nz
    area = jnp.repeat(surfels.area, m) / m if surfels.area.ndim else surfels.area / m
    return PlacedSurfels((x, y, z), (nx, ny, nz), plane, area, jnp.repeat(copies, m))


def _place_bin(bin_in_view: BinInView, count: int, splits: int = 1) -> PlacedSurfels:
    surfels = bin_surfels(bin_in_view.size, count)
    if splits > 1:
        side = jnp.sqrt(surfels.area / count)
        # Floor normals are (0, 0, 1), those of walls horizontal: the axes' order turned gives two directions across.
        first = jnp.abs(jnp.roll(surfels.normals, 1, axis=1))
        second = jnp.abs(jnp.roll(surfels.normals, 2, axis=1))
        steps = [(2 * step + 1 - splits) / (2 * splits) for step in range(splits)]
        parts = [surfels.points + side * (u * first + v * second) for u in steps for v in steps]
        surfels = Surfels(jnp.concatenate(parts), jnp.tile(surfels.normals, (splits**2, 1)), surfels.area)
    return place_surfels(surfels, bin_in_view.T_camera_bin[None], jnp.ones(1, dtype=bool))


def facing(placed: PlacedSurfels) -> Mask:
    """Tell which surfels turn towards the camera and lie in front of it."""
    return placed.real & (placed.plane < 0) & (placed.points[2] > 0)


def _in_image(placed: PlacedSurfels, camera: Intrinsics) -> Mask:
    x, y, z = placed.points
    # Multiplied by z, which is above zero where it matters; the first pixel's centre is at (0, 0).
    column, row = camera.fx * x + (camera.cx + 0.5) * z, camera.fy * y + (camera.cy + 0.5) * z
    return (column >= 0) & (column < camera.width * z) & (row >= 0) & (row < camera.height * z)


def _over_rim(placed: PlacedSurfels, bin_in_view: BinInView) -> Mask:
    """Tell which points the bin's walls do not hide: the line of sight leaves the bin through its opening."""
    length, width, height = bin_in_view.size
    to_bin = inverse(bin_in_view.T_camera_bin)
    eye = to_bin[:3, 3]
    x, y, z = (
        sum((to_bin[i, j] * placed.points[j] for j in range(3)), jnp.broadcast_to(eye[i], placed.plane.shape))
        for i in range(3)
    )
    share = (height - z) / jnp.where(eye[2] > z, eye[2] - z, 1)
    across = (jnp.abs(x + share * (eye[0] - x)) <= length / 2) & (jnp.abs(y + share * (eye[1] - y)) <= width / 2)
    return (z >= height) | (across & (eye[2] > height))


def draw_discs(placed: PlacedSurfels, drawn: Mask, spacing: Float[Array, "*rows"], size: int) -> DepthBuffer:
    """Draw each surfel's disc at the four pixels around its projection and keep the least depth."""
    x, y, z = placed.points
    directions = [coordinate / jnp.where(drawn, z, 1) for coordinate in (x, y)]
    count = drawn.sum()
    some = count > 0
    low, high = (
        [jnp.where(some, bound(jnp.where(drawn, direction, worst)), 0) for direction in directions]
        for bound, worst in ((jnp.min, jnp.inf), (jnp.max, -jnp.inf))
    )
    mean_depth = jnp.where(some, jnp.where(drawn, z, 0).sum() / jnp.maximum(count, 1).astype(jnp.float32), 1)
    finest = _PIXEL * spacing.min() / mean_depth
    pitch = [jnp.maximum((end - begin) / (size - 1), finest) for begin, end in zip(low, high, strict=True)]
    buffer = DepthBuffer(jnp.full(size * size, jnp.inf, jnp.float32), (low[0], low[1]), (pitch[0], pitch[1]))
    columns, rows = _pixels(placed.points, buffer)
    nearest_column, nearest_row = jnp.round(columns), jnp.round(rows)
    first_column, first_row = jnp.floor(columns), jnp.floor(rows)

    # A loop, because its operands are stored once: XLA on CPUs would else compute them anew for each pixel.
    def draw_corner(depth: Float[Array, " pixels"], corner: Float[Array, " 2"]) -> tuple[Float[Array, " pixels"], None]:
        column, row = first_column + corner[0], first_row + corner[1]
        u, v, disc_depth = _plane_depth(placed, buffer, column, row, spacing)
        square_distance = (u * disc_depth - x) ** 2 + (v * disc_depth - y) ** 2 + (disc_depth - z) ** 2
        covered = (square_distance <= (_DISC_RADIUS * spacing) ** 2) | (
            (column == nearest_column) & (row == nearest_row)
        )
        covered = covered & drawn & (column < size) & (row < size)
        index = jnp.where(covered, row * size + column, size * size).astype(jnp.int32)
        return depth.at[index].min(disc_depth, mode="drop"), None

    corners = jnp.array([[0, 0], [0, 1], [1, 0], [1, 1]], dtype=jnp.float32)
    return buffer._replace(depth=jax.lax.scan(draw_corner, buffer.depth, corners)[0])


def unhidden(placed: PlacedSurfels, buffer: DepthBuffer, spacing: Float[Array, "*rows"]) -> Bool[Array, " r"]:
    """Tell which points that face the camera are, lifted off their surface, at most the tolerance behind the buffer."""
    lift = _LIFT * spacing
    x, y, z = (place + lift * normal for place, normal in zip(placed.points, placed.normals, strict=True))
    return z <= _depth_towards((x, y, z), buffer) + _TOLERANCE * spacing


def _depth_towards(
    points: tuple[Float[Array, " r"], Float[Array, " r"], Float[Array, " r"]], buffer: DepthBuffer
) -> Float[Array, " r"]:
    """Return the depth that was drawn in the directions of points, infinite outside of the buffer too."""
    size = math.isqrt(len(buffer.depth))
    columns, rows = (jnp.round(pixel) for pixel in _pixels(points, buffer))
    outside = (columns < 0) | (columns >= size) | (rows < 0) | (rows >= size)
    depth = buffer.depth[jnp.where(outside, 0, rows * size + columns).astype(jnp.int32)]
    return jnp.where(outside, jnp.inf, depth)


def _pixels(
    points: tuple[Float[Array, " r"], Float[Array, " r"], Float[Array, " r"]], buffer: DepthBuffer
) -> list[Float[Array, " r"]]:
    x, y, z = points
    safe = jnp.where(z > 0, z, 1)
    return [(c / safe - low) / pitch for c, low, pitch in zip((x, y), buffer.low, buffer.pitch, strict=True)]


def _plane_depth(
    placed: PlacedSurfels,
    buffer: DepthBuffer,
    columns: Float[Array, " r"],
    rows: Float[Array, " r"],
    spacing: Float[Array, "*rows"],
) -> tuple[Float[Array, " r"], Float[Array, " r"], Float[Array, " r"]]:
    """Return x / z and y / z at pixel centres, and the depth there of each surfel's plane, kept near its own."""
    nx, ny, nz = placed.normals
    z, reach = placed.points[2], _STEEPEST * spacing
    u, v = buffer.low[0] + columns * buffer.pitch[0], buffer.low[1] + rows * buffer.pitch[1]
    depth = placed.plane / jnp.minimum(u * nx + v * ny + nz, -1e-6)
    return u, v, jnp.clip(depth, z - reach, z + reach)


def visible_points_of(num_copies: int, *parts: tuple[PlacedSurfels, Bool[Array, " _"]]) -> VisiblePoints:
    """Join the surfels of the copies, and those of the bin if given, with which of them are visible."""
    points, normals = (
        jnp.stack([jnp.concatenate(column) for column in zip(*rows, strict=True)], axis=1)
        for rows in ([placed.points for placed, _ in parts], [placed.normals for placed, _ in parts])
    )
    areas = [_picture_area(placed) for placed, _ in parts]
    _, visible = parts[0]
    whole = areas[0].reshape(num_copies, -1).sum(axis=1)
    seen = jnp.where(visible, areas[0], 0).reshape(num_copies, -1).sum(axis=1)
    instances = [jnp.repeat(jnp.arange(num_copies, dtype=jnp.int32), visible.shape[0] // num_copies)]
    instances += [jnp.full(on_bin.shape, BIN, dtype=jnp.int32) for _, on_bin in parts[1:]]
    return VisiblePoints(
        points,
        normals,
        jnp.concatenate(areas),
        jnp.concatenate(instances),
        jnp.concatenate([visible & placed.real for placed, visible in parts]),
        seen / jnp.where(whole > 0, whole, 1),
    )


def _picture_area(placed: PlacedSurfels) -> Float[Array, " r"]:
    """Return area x cosine / distance^2, divided by the cosine cubed of the angle to the optical axis."""
    turned = facing(placed)
    depth = jnp.where(turned, placed.points[2], 1)
    return jnp.where(turned, -placed.plane / depth**3, 0) * placed.area
