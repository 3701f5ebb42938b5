"""The scan as its sensor saw it: points in a frame whose origin is the sensor, and a depth image in that frame."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, Float32, Int

from kmn_jax.detection._scan_crop import padded_points
from kmn_jax.detection._verify import depth_buffer
from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera, intrinsics
from kmn_jax.io import Scan

_SIDE = 1024  # pixels along both sides of an image that is made of a cloud: one size, so one compilation
_SAMPLE = 2000  # points whose spacing is measured
_NEAREST = 1e-3  # of the distance of the cloud: a sensor nearer than that to a point lies in the cloud


@dataclass(frozen=True)
class View:
    """Points and depth in the sensor's frame, z forward, lengths in the scan's unit."""

    T_scene_view: Float[np.ndarray, "4 4"]
    points: Float32[np.ndarray, "n 3"]
    depth: Float32[np.ndarray, "h w"]  # zero where nothing was measured
    camera: Camera
    rows: Int[np.ndarray, " n"]  # of the scan's points that are seen: all but those behind the sensor


def view_of(scan: Scan, sensor: Float[np.ndarray, "3"] | None = None) -> View:
    """Return a scan as seen from its sensor, by default from the origin.

    A depth image is its own view. Of a cloud an image is made whose pixels are about as fine as its points. Raises
    InputError if the sensor's place lies among the points.
    """
    if scan.depth is not None and scan.camera is not None:
        return View(np.eye(4), scan.points, scan.depth, scan.camera, np.arange(len(scan.points)))
    place = np.zeros(3) if sensor is None else np.asarray(sensor, dtype=np.float64)
    offsets = scan.points.astype(np.float64) - place
    distances = np.linalg.norm(offsets, axis=1)
    typical = float(np.median(distances))
    rotation = _towards(offsets.mean(axis=0), typical)
    points = offsets @ rotation.T
    if distances.min() <= _NEAREST * typical or (points[:, 2] <= 0).mean() > 0.01:
        where = "the origin" if sensor is None else f"{tuple(float(x) for x in place)}"
        raise InputError(f"the sensor cannot have been at {where}, among the points: say where it was")
    rows = np.flatnonzero(points[:, 2] > 0)
    points = points[rows].astype(np.float32)
    camera = _fine_camera(points)
    T_scene_view = np.eye(4)
    T_scene_view[:3, :3], T_scene_view[:3, 3] = rotation.T, place
    padded, mask = padded_points(points)
    depth = _depth_buffer(padded, mask, intrinsics(camera), shape=(camera.height, camera.width))
    return View(T_scene_view, points, np.asarray(depth), camera, rows)


def _towards(direction: Float[np.ndarray, "3"], typical: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation that makes a direction the z axis, the identity if it nearly is."""
    length = float(np.linalg.norm(direction))
    if length < _NEAREST * typical:
        return np.eye(3)  # all around: refused by what follows
    z = direction / length
    if z[2] > np.cos(np.radians(30)):
        return np.eye(3)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _fine_camera(points: Float32[np.ndarray, "n 3"]) -> Camera:
    """Return a camera that sees all points, with pixels as wide as points are apart if it has enough of them."""
    from scipy.spatial import cKDTree

    directions = points[:, :2] / points[:, 2:]
    low, high = np.percentile(directions, 0.1, axis=0), np.percentile(directions, 99.9, axis=0)
    chosen = np.random.default_rng(0).permutation(len(points))[:_SAMPLE]
    spacing = 0.0
    if len(points) > 1:
        apart = cKDTree(directions).query(directions[chosen], k=2)[0][:, 1]
        spacing = float(np.percentile(apart, 75))
    extent = max(float((high - low).max()), 1e-3)  # also of a single point
    focal = 1 / max(spacing, extent / (_SIDE - 2))
    return Camera(focal, focal, float(1 - low[0] * focal), float(1 - low[1] * focal), _SIDE, _SIDE)


_depth_buffer = jax.jit(depth_buffer, static_argnames="shape")
