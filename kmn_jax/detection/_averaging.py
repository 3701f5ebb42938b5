"""Depth images of noisy sensors, averaged over small windows: what tells poses apart does not drown in noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

from kmn_jax.geometry import Camera

# Lengths are in diameters of the object.
_NOISY = 0.005  # from such noise on averages are taken
_SIDE = 3  # pixels, of a window: wider ones seem to find more by stereo, and less far away
_WIDEST = 0.05  # side of a window at most
_QUANTILE = 0.68  # of the errors of an even surface: one deviation
_STEP = 3  # rows and columns from one that noise is measured along to the next


def noise_of(depth: Float[np.ndarray, "h w"]) -> float:
    """Return the standard deviation of a depth image's noise from pixel to pixel, in its unit; 0 if none is told.

    It is measured by how far pixels are off the middle between those on their two sides: most lie on even surfaces.
    """
    errors = []
    for lines in (depth[::_STEP], depth.T[::_STEP]):
        before, own, after = lines[:, :-2], lines[:, 1:-1], lines[:, 2:]
        there = (before > 0) & (own > 0) & (after > 0)
        errors.append(np.abs(before - 2 * own + after)[there])
    together = np.concatenate(errors)
    return float(np.quantile(together, _QUANTILE)) / 6**0.5 if len(together) else 0.0


def averaged(depth: Float32[np.ndarray, "h w"], camera: Camera, diameter: float) -> Float32[np.ndarray, "h w"]:
    """Return a depth image whose inverse depths are means over 3 x 3 pixels where it is noisy, else as it is.

    What was not measured, zero, stays so and counts for nothing. Noisy is a deviation of 0.5% of the diameter or more.
    Beside steps what is between their sides is returned, as many sensors do themselves: with only these pixels as noisy
    as before, fewer copies were found. An object less than 60 pixels wide would drown in its surroundings: its image is
    left alone. `depth` and `diameter` are in one unit.
    """
    from scipy.ndimage import uniform_filter

    there = depth > 0
    if not there.any() or noise_of(depth) < _NOISY * diameter:
        return depth
    pixels = camera.fx * diameter / float(np.median(depth[there]))  # that the diameter is wide
    if _WIDEST * pixels < _SIDE:
        return depth
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=there)
    total, count = (uniform_filter(values, _SIDE, mode="constant") for values in (inverse, there.astype(np.float32)))
    return np.divide(count, total, out=np.zeros_like(depth), where=there)


def onto(
    points: Float[np.ndarray, "n 3"],
    camera: Camera,
    depth: Float32[np.ndarray, "h w"],
    averages: Float32[np.ndarray, "h w"],
) -> Float[np.ndarray, "n 3"]:
    """Return the points of a depth image moved along their rays by as much as their pixels are; in the camera's frame.

    Points that are in no pixel, or in one without depth, stay where they are.
    """
    if averages is depth:
        return points
    x, y, z = points.T
    columns = np.round(camera.fx * x / z + camera.cx).astype(int)
    rows = np.round(camera.fy * y / z + camera.cy).astype(int)
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    pixel = np.where(inside, rows, 0), np.where(inside, columns, 0)
    factor = np.divide(averages[pixel], depth[pixel], out=np.ones_like(z), where=inside & (depth[pixel] > 0))
    return points * factor[:, None]
