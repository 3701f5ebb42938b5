"""How depth images and parts look: their brightness, a part's surface as hexagons, and colours that are told apart."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Shaped, UInt8

from kmn_jax.geometry import Camera
from kmn_jax.objects import Part

_LIGHT = np.array([-0.40, -0.50, -0.77])  # from the upper left behind the sensor, in the view's frame
_AMBIENT = 0.25
_COVER = 0.93  # radius of hexagons that leave no gaps, of the distance to the third neighbour
_NOISE = 0.03  # of the diameter: depth is smoothed by less before it is shaded
_MOST_PIXELS = 1100  # of a side of a shaded image


class Shaded(NamedTuple):
    """A depth image to look at, of fewer pixels and its small holes filled; NaN where nothing was measured."""

    step: int  # pixels of the depth image for one of these
    depth: Float32[np.ndarray, "h w"]
    brightness: Float32[np.ndarray, "h w"]  # in [0, 1]


def shaded(depth: Float32[np.ndarray, "h w"], camera: Camera, diameter: float) -> Shaded:
    """Return a depth image with its brightness; noise that is small beside a diameter does not show."""
    step = -(-max(depth.shape) // _MOST_PIXELS)
    depth = depth[::step, ::step]
    depth = np.where(depth > 0, depth, np.float32(np.nan))

    def around(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "3 3 h w"]:
        return np.lib.stride_tricks.sliding_window_view(np.pad(depth, 1, constant_values=np.nan), depth.shape)

    for _ in range(2):
        count = (~np.isnan(around(depth))).sum(axis=(0, 1), dtype=np.float32)
        mean = np.nansum(around(depth), axis=(0, 1)) / np.maximum(count, 1)
        depth = np.where(np.isnan(depth) & (count >= 3), mean, depth)
    smooth = depth
    for _ in range(3):
        near = np.abs(around(smooth) - smooth) < _NOISE * diameter
        count = near.sum(axis=(0, 1), dtype=np.float32)
        smooth = np.where(near, around(smooth), 0).sum(axis=(0, 1)) / np.where(count > 0, count, np.float32(np.nan))
    # The surface is z(u, v), whose normal comes from the slopes; perspective within two pixels is neglected.
    down, right = np.nan_to_num(np.gradient(smooth)) / smooth
    normals = np.stack([right * camera.fx / step, down * camera.fy / step, -np.ones_like(smooth)], axis=-1)
    bright = brightness(normals / np.linalg.norm(normals, axis=-1, keepdims=True))
    return Shaded(step, depth, bright.astype(np.float32))


def brightness(normals: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s"]:
    """Return how bright surfaces of unit normals in a view's frame are, in [0, 1]."""
    lit = np.clip(normals @ (_LIGHT / np.linalg.norm(_LIGHT)), 0, 1)
    return _AMBIENT + (1 - _AMBIENT) * lit


def surface_hexagons(part: Part, most: int = 4096) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 6 3"]]:
    """Return normals and corners of hexagons that cover a part's surface: around the first `most` of its points."""
    from scipy.spatial import cKDTree

    centers, normals = (array[:most].astype(np.float64) for array in (part.points, part.normals))
    radii = _COVER * cKDTree(centers).query(centers, k=4)[0][:, -1]
    radii = np.minimum(radii, 2 * np.median(radii))
    first = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    turns = np.radians(np.arange(0, 360, 60))[:, None]
    rims = np.cos(turns) * first[:, None] + np.sin(turns) * np.cross(normals, first)[:, None]
    return normals, centers[:, None] + radii[:, None, None] * rims


def image_places(camera: Camera, points: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 2"]:
    """Return the column and row at which a camera sees points; far outside of the image if they are behind it."""
    z = np.where(points[..., 2:] > 0, points[..., 2:], 1e-9)
    return points[..., :2] / z * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def values_at(image: Shaped[np.ndarray, "h w"], places: Float[np.ndarray, "n 2"]) -> Shaped[np.ndarray, " n"]:
    """Return the values of the pixels at columns and rows; outside of the image, of the nearest pixel."""
    height, width = image.shape
    column, row = np.clip(np.round(places), 0, [width - 1, height - 1]).astype(int).T
    return image[row, column]


def spacing(points: Float[np.ndarray, "n d"]) -> float:
    """Return how far points typically are from their nearest ones; 0 if there is but one."""
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return 0.0
    chosen = np.random.default_rng(0).permutation(len(points))[:2000]
    return float(np.percentile(cKDTree(points).query(points[chosen], k=2)[0][:, 1], 75))


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
    chosen = [int(((colors - [0.12, 0.47, 0.90]) ** 2).sum(axis=1).argmin())]  # blue
    apart = np.full(len(lab), np.inf)
    while len(chosen) < count:
        apart = np.minimum(apart, ((lab - lab[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(apart.argmax()))
    return colors[chosen[:count]]


def as_bytes(colors: Float[np.ndarray, "*s c"]) -> UInt8[np.ndarray, "*s c"]:
    """Return colours in [0, 1] as bytes."""
    return np.round(255 * colors.clip(0, 1)).astype(np.uint8)
