"""Points and depth as pixels: what a camera sees of them, how depth is shaded, and colours that are told apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from kmn_jax.geometry import Camera

_LIGHT = np.array([-0.40, -0.50, -0.77])  # from the upper left behind the sensor, in the view's frame
_AMBIENT = 0.25
_COVER = 0.85  # radius of discs that leave no gaps, of the distance to the third neighbour
_LARGEST_DISC = 200  # pixels from the centre to the rim: larger ones are as good as at the camera


@dataclass(frozen=True)
class Canvas:
    """A raster over a part of a camera's image: `scale` of its pixels for one of the camera's."""

    camera: Camera
    left: float  # of the raster's corner, in the camera's pixels
    top: float
    scale: float
    width: int
    height: int

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top in the camera's pixels."""
        return self.left, self.left + self.width / self.scale, self.top + self.height / self.scale, self.top

    def seen(
        self, points: Float[np.ndarray, "n 3"], size: int
    ) -> tuple[Int[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
        """Return the point seen at each pixel, -1 for none, and its depth; points are squares of `size` pixels."""
        owner, rows, columns = self._squares(points, np.full(len(points), size // 2))
        return self._nearest(owner, rows, columns, points[owner, 2].astype(np.float64))

    def seen_discs(
        self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], radii: Float[np.ndarray, " n"]
    ) -> tuple[Int[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
        """Return the disc seen at each pixel, -1 for none, and its depth; only those that face the camera are seen."""
        camera = self.camera
        reach = radii * max(camera.fx, camera.fy) * self.scale / np.maximum(points[:, 2], 1e-9)
        rows = np.flatnonzero(((points * normals).sum(axis=1) < 0) & (points[:, 2] > radii) & (reach < _LARGEST_DISC))
        owner, row, column = self._squares(points[rows], np.ceil(reach[rows]).astype(np.int64))
        owner = rows[owner]
        x = ((column + 0.5) / self.scale + self.left - camera.cx) / camera.fx
        y = ((row + 0.5) / self.scale + self.top - camera.cy) / camera.fy
        point, normal = points[owner], normals[owner]
        # Where the ray (x, y, 1) of a pixel meets the plane of the disc.
        across = normal[:, 0] * x + normal[:, 1] * y + normal[:, 2]
        z = (point * normal).sum(axis=1) / np.where(across < -1e-3, across, -np.inf)
        aside = (x * z - point[:, 0]) ** 2 + (y * z - point[:, 1]) ** 2 + (z - point[:, 2]) ** 2
        within = (aside <= radii[owner] ** 2) & (z > 0)
        return self._nearest(owner[within], row[within], column[within], z[within])

    def _squares(
        self, points: Float[np.ndarray, "n 3"], reach: Int[np.ndarray, " n"]
    ) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
        """Return the pixels up to `reach` around those of points: the point, the row and the column of each."""
        place = (image_places(self.camera, points) - [self.left, self.top]) * self.scale
        column, row = np.clip(np.floor(place), -1e6, 1e6).astype(np.int64).T
        found = []
        for size in np.unique(reach):
            rows_of = np.flatnonzero((reach == size) & (points[:, 2] > 0))
            steps = np.arange(-size, size + 1)
            shape = (len(rows_of), len(steps), len(steps))
            rows = np.broadcast_to(row[rows_of, None, None] + steps[:, None], shape)
            columns = np.broadcast_to(column[rows_of, None, None] + steps, shape)
            inside = (rows >= 0) & (rows < self.height) & (columns >= 0) & (columns < self.width)
            owner = np.broadcast_to(rows_of[:, None, None], shape)
            found.append((owner[inside], rows[inside], columns[inside]))
        if not found:
            return (np.zeros(0, dtype=np.int64),) * 3
        owner, rows, columns = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
        return owner, rows, columns

    def _nearest(
        self,
        owner: Int[np.ndarray, " p"],
        rows: Int[np.ndarray, " p"],
        columns: Int[np.ndarray, " p"],
        z: Float[np.ndarray, " p"],
    ) -> tuple[Int[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
        flat = rows * self.width + columns
        depth = np.full(self.height * self.width, np.inf)
        np.minimum.at(depth, flat, z)
        index = np.full(self.height * self.width, -1)
        first = z == depth[flat]
        index[flat[first]] = owner[first]
        return index.reshape(self.height, self.width), depth.reshape(self.height, self.width)

    def measured(self, depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "r c"]:
        """Return the camera's depth at each pixel of the raster."""
        rows = np.round(self.top + (np.arange(self.height) + 0.5) / self.scale).astype(int)
        columns = np.round(self.left + (np.arange(self.width) + 0.5) / self.scale).astype(int)
        height, width = depth.shape
        inside = ((rows >= 0) & (rows < height))[:, None] & (columns >= 0) & (columns < width)
        return np.where(inside, depth[np.ix_(rows.clip(0, height - 1), columns.clip(0, width - 1))], np.float32(0))


def image_places(camera: Camera, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Return the column and row at which a camera sees points; far outside of the image if they are behind it."""
    z = np.where(points[:, 2] > 0, points[:, 2], 1e-9)
    return points[:, :2] / z[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def brightness(normals: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s"]:
    """Return how bright surfaces of unit normals in a view's frame are, in [0, 1]."""
    lit = np.clip(normals @ (_LIGHT / np.linalg.norm(_LIGHT)), 0, 1)
    return np.minimum(_AMBIENT + (1 - _AMBIENT) * lit, 1)


def filled(depth: Float32[np.ndarray, "h w"], rounds: int = 2) -> Float32[np.ndarray, "h w"]:
    """Return a depth image in which pixels that were not measured have the mean of at least three neighbours."""
    for _ in range(rounds):
        count, total = np.zeros_like(depth), np.zeros_like(depth)
        for around in _neighbors(depth):
            count += around > 0
            total += around
        depth = np.where((depth <= 0) & (count >= 3), total / np.maximum(count, 1), depth)
    return depth


class Relief(NamedTuple):
    """A depth image made for looking at: of fewer pixels, its small holes filled, with its brightness."""

    step: int  # every so manieth pixel of a row and of a column is taken
    depth: Float32[np.ndarray, "h w"]
    shade: Float32[np.ndarray, "h w"]  # in [0, 1], NaN where nothing was measured


def relief_of(depth: Float32[np.ndarray, "h w"], camera: Camera, tolerance: float, side: int = 1100) -> Relief:
    """Return the relief of a depth image, at most `side` pixels wide and high; see `relief` for the tolerance."""
    step = max(1, -(-max(depth.shape) // side))
    fewer = filled(depth[::step, ::step])
    shade = relief(fewer, camera.fx / step, camera.fy / step, tolerance)
    return Relief(step, fewer, np.where(fewer > 0, shade, np.float32(np.nan)))


def relief(depth: Float32[np.ndarray, "h w"], fx: float, fy: float, tolerance: float) -> Float32[np.ndarray, "h w"]:
    """Return the brightness of a depth image's surface, in [0, 1]; depth is smoothed where it differs less."""
    for _ in range(3):
        count, total = np.ones_like(depth), depth.copy()
        for around in _neighbors(depth):
            near = (around > 0) & (np.abs(around - depth) < tolerance)
            count += near
            total += np.where(near, around, 0)
        depth = total / count
    # The surface is z(u, v), whose normal comes from the slopes; perspective within two pixels is neglected.
    z = np.maximum(depth, np.float32(1e-9))
    down, right = (_slope(depth, axis) for axis in (0, 1))
    normals = np.stack([right * np.float32(fx) / z, down * np.float32(fy) / z, -np.ones_like(z)], axis=-1)
    return brightness(normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)


def surface_discs(
    points: Float32[np.ndarray, "m 3"], normals: Float32[np.ndarray, "m 3"], most: int = 4096
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Return centres, normals and radii of discs that cover a surface: on the first `most` of evenly spread points."""
    from scipy.spatial import cKDTree

    centers, normals_there = (array[:most].astype(np.float64) for array in (points, normals))
    count = min(4, len(centers))
    apart, _ = cKDTree(centers).query(centers, k=count)
    reach = _COVER * apart.reshape(len(centers), count)[:, -1]
    return centers, normals_there, np.minimum(reach, 2 * np.median(reach))


def distinct_colors(count: int) -> Float[np.ndarray, "n 3"]:
    """Return sRGB colours in [0, 1] that are told apart well, on grey too; the first ones best of all.

    Each is the one furthest from all before it in CIE L*a*b*, of those that are neither grey nor very dark or light.
    """
    levels = np.linspace(0, 1, 14)
    colors = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
    linear = np.where(colors > 0.04045, ((colors + 0.055) / 1.055) ** 2.4, colors / 12.92)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.cbrt(np.maximum(linear @ to_xyz.T / [0.9505, 1.0, 1.089], 0.0089)).T
    lab = np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    vivid = (chroma > 40) & (chroma < 95) & (lab[:, 0] > 38) & (lab[:, 0] < 84)
    colors, lab = colors[vivid], lab[vivid]
    chosen = [int(((colors - [0.12, 0.47, 0.90]) ** 2).sum(axis=1).argmin())]
    apart = np.full(len(lab), np.inf)
    while len(chosen) < count:
        apart = np.minimum(apart, ((lab - lab[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(apart.argmax()))
    return colors[chosen[:count]]


def depth_colors(depth: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Return colours from yellow, near, by green to violet, far, over the range of most depths."""
    near, far = np.percentile(depth, [0.5, 99.5])
    share = (depth - near) / max(float(far - near), 1e-9 * float(far))
    stops = np.array(
        [[0.99, 0.91, 0.14], [0.37, 0.79, 0.38], [0.13, 0.57, 0.55], [0.23, 0.32, 0.55], [0.27, 0.0, 0.33]]
    )
    places = np.linspace(0, 1, len(stops))
    return np.stack([np.interp(share, places, channel) for channel in stops.T], axis=1)


def as_bytes(colors: Float[np.ndarray, "*s c"]) -> UInt8[np.ndarray, "*s c"]:
    """Return colours in [0, 1] as bytes."""
    return np.round(255 * colors.clip(0, 1)).astype(np.uint8)


def _slope(depth: Float32[np.ndarray, "h w"], axis: int) -> Float32[np.ndarray, "h w"]:
    """Return the central difference, zero at the border and beside what was not measured."""
    depth = np.moveaxis(depth, axis, 0)
    result = np.zeros_like(depth)
    both = (depth[2:] > 0) & (depth[:-2] > 0)
    result[1:-1] = np.where(both, (depth[2:] - depth[:-2]) / 2, 0)
    return np.moveaxis(result, 0, axis)


def _neighbors(depth: Float32[np.ndarray, "h w"]) -> Iterator[Float32[np.ndarray, "h w"]]:
    """Yield the eight neighbours of each pixel, zero outside of the image."""
    height, width = depth.shape
    padded = np.pad(depth, 1)
    for row, column in ((row, column) for row in range(3) for column in range(3) if (row, column) != (1, 1)):
        yield padded[row : row + height, column : column + width]
