"""A scan that is made up, of a part that is made up: searching it compiles all programs that searches need."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

from kmn_jax.geometry import Camera, measured_points
from kmn_jax.io import Scan

# A bracket of three blocks (mm): centres and sizes. No turn of it looks like another.
_CENTERS = np.array([[0.0, 0, 0], [-22, 0, 15], [18, 9, 11]])
_SIZES = np.array([[60.0, 30, 10], [16, 30, 22], [12, 12, 14]])
_CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)  # the commonest size, and a size that is thinned out
_FLOOR = 600.0  # mm from the camera
_PLACES = ((-120, -70, 20), (-10, -80, 140), (105, -60, 75), (-90, 60, 250), (40, 70, 310))  # x, y, degrees

PLACE = (*_PLACES[0][:2], _FLOOR - 10)  # a point of the first one's upper side


def bracket() -> tuple[Float[np.ndarray, "v 3"], np.ndarray]:
    """Return the part's vertices (mm) and triangles."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    one = np.array([triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))])
    vertices = np.concatenate([center + corners * size for center, size in zip(_CENTERS, _SIZES, strict=True)])
    return vertices, np.concatenate([one + 8 * block for block in range(len(_SIZES))])


def brackets_on_a_floor() -> Scan:
    """Return the depth image of five brackets that lie on a floor, seen from above."""
    rows, columns = np.mgrid[: _CAMERA.height, : _CAMERA.width].astype(np.float32)
    rays = np.stack([(columns - _CAMERA.cx) / _CAMERA.fx, (rows - _CAMERA.cy) / _CAMERA.fy, np.ones_like(rows)], -1)
    depth = np.full(rows.shape, _FLOOR, dtype=np.float32)
    for x, y, degrees in _PLACES:
        turn = np.radians(degrees)
        # Upright: the part's z axis points to the camera.
        axes = np.array([[np.cos(turn), np.sin(turn), 0], [np.sin(turn), -np.cos(turn), 0], [0, 0, -1.0]])
        place = np.array([x, y, _FLOOR - 5])
        for center, size in zip(_CENTERS, _SIZES, strict=True):
            depth = np.minimum(depth, _block_depth(rays, place + axes @ center, axes, size))
    return Scan(measured_points(depth, _CAMERA), None, depth, _CAMERA, "mm")


def _block_depth(
    rays: Float32[np.ndarray, "h w 3"], center: Float[np.ndarray, "3"], axes: Float[np.ndarray, "3 3"], size: np.ndarray
) -> Float32[np.ndarray, "h w"]:
    """Return where rays, of length 1 along z, enter a block; infinite where they miss it."""
    start = -center @ axes
    with np.errstate(divide="ignore"):
        inverse = 1 / (rays @ axes.astype(np.float32))
    one, other = ((sign * size / 2 - start).astype(np.float32) * inverse for sign in (-1, 1))
    near, far = np.minimum(one, other).max(axis=-1), np.maximum(one, other).min(axis=-1)
    return np.where(near < far, near, np.float32(np.inf))
