"""A scan that is ready to be searched: in its sensor's frame, with a depth image, thinned out, with its foreground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from kmn_jax.detection._averaging import averaged, onto
from kmn_jax.detection._depth_agreement import DepthImage, depth_buffer
from kmn_jax.detection._foreground import ForegroundOptions, foreground
from kmn_jax.detection._frames import MOST_BEHIND, into, placed
from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera, PaddedCloud, intrinsics, pad_cloud
from kmn_jax.io import FAR, Scan, SceneSize

MOST_POINTS = 131_072  # of a scan that are searched: more are thinned out at random, fewer are padded
# Depth images are padded to so many pixels, or else to a multiple of the step: one size compiles nothing for the next.
_IMAGE_SHAPE, _IMAGE_STEP = (1024, 1280), 1024
_SIDE = 1024  # pixels along both sides of an image that is made of a cloud: one size, so one compilation
_SAMPLE = 2000  # points whose spacing is measured
_NEAREST = 1e-3  # of the distance of the cloud: a sensor nearer than that to a point lies in the cloud
_FARTHEST = 1e4  # diameters of an object, from the sensor: beyond, float32 does not hold its surface


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan as searches take it. The camera is the sensor, z forward; lengths are in `unit`."""

    unit: str
    T_scene_camera: Float[np.ndarray, "4 4"]  # the scene's frame is that of the scan's file
    camera: Camera
    depth: Float32[np.ndarray, "h w"]  # zero where nothing was measured; made of the points if the scan is a cloud
    points: Float32[np.ndarray, "r 3"]  # in the camera's frame: all that were seen, or a random part of them
    foreground: Bool[np.ndarray, " r"]  # which of them may show objects
    cloud: PaddedCloud  # the points again, on the device
    image: DepthImage  # the depth again, padded, on the device
    warnings: tuple[str, ...] = ()
    is_narrowed: bool = False  # whether it was told where parts may be: by an empty bin, a region, or the truth
    doubt: str | None = None  # about its unit, told if nothing is found
    size: SceneSize | None = None  # that a part's unit is doubted by
    has_unit_of_part: bool = False  # for want of its own
    truth: tuple[Float[np.ndarray, "4 4"], ...] | None = None  # T_scene_object of all copies, if a dataset says
    bop_ids: tuple[int, int, int] = (0, 0, 1)  # scene, image and object, of an image of a BOP dataset
    T_scene_sensor: Float[np.ndarray, "4 4"] | None = None  # of the camera as its user knows it, if that is known
    is_opengl: bool = False  # whether its frame seems to be one of OpenGL
    source: str | None = None  # the file
    empty: Float32[np.ndarray, "e 3"] | None = None  # points of the empty bin in the camera's frame, if there is one

    def placed(self, points: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 3"]:
        """Return points of the camera's frame in the scene's: in float32, or float64 if that lies far away."""
        far = np.abs(self.T_scene_camera[:3, 3]).max() > FAR * np.abs(self.points).max()
        return placed(self.T_scene_camera, points).astype(np.float64 if far else np.float32)


def make_scene(
    scan: Scan,
    diameter: float,
    *,
    sensor: Float[np.ndarray, "3"] | None = None,
    background: ForegroundOptions | None = None,
    inside: Bool[np.ndarray, " n"] | None = None,
    keep: Float[np.ndarray, "k 3"] | None = None,
) -> Scene:
    """Make a scan ready for searches of objects of about a diameter.

    `sensor` is where it was measured from, by default the origin; a depth image is in its sensor's frame, and is
    `averaged` where it is noisy, and so are its points. Foreground is what `background` leaves, or the points that are
    `inside` of a known region. However a scan is thinned out, the points nearest to places `keep` stay. Places and
    sensor are in the scan's frame. The same arguments give the same scene. Raises InputError if the sensor's place lies
    among the points, or if no foreground is left.
    """
    if sensor is not None and scan.camera is not None:
        raise InputError("a depth image is in the frame of its sensor: leave the sensor's place out")
    view = _seen(scan, sensor)
    distance = float(np.median(view.points[:, 2]))
    if distance > _FARTHEST * diameter:
        raise InputError(
            f"the scan lies {distance:.3g} {scan.unit} from its sensor, {distance / diameter:.2g} times the object's"
            " diameter: say where in its frame the sensor was (--sensor), and in which unit"
        )
    is_image = scan.depth is not None and scan.camera is not None
    if is_image:
        averages = averaged(view.depth, view.camera, diameter)
        view = view._replace(points=onto(view.points, view.camera, view.depth, averages), depth=averages)
    seen = Scan(view.points, None, view.depth if is_image else None, scan.camera if is_image else None, scan.unit)
    warnings: tuple[str, ...] = ()
    if inside is None:
        front, warnings = foreground(seen, diameter, background or ForegroundOptions(), view.T_scene_camera)
    else:
        front = inside[view.rows]
    if not front.any():
        raise InputError("no point of the scan is left as foreground: check background, region and units")
    rows = _thinned(front)
    if keep is not None:
        kept = np.unique([nearest_row(view.points, place) for place in into(view.T_scene_camera, keep)])
        rows = np.union1d(rows[~np.isin(rows, kept)][: max(0, MOST_POINTS - len(kept))], kept)
    points = view.points[rows]
    wanted = (
        least if size <= least else size + -size % _IMAGE_STEP
        for size, least in zip(view.depth.shape, _IMAGE_SHAPE, strict=True)
    )
    padded = np.pad(view.depth, [(0, size - own) for size, own in zip(wanted, view.depth.shape, strict=True)])
    return Scene(
        scan.unit,
        view.T_scene_camera,
        view.camera,
        view.depth,
        points,
        front[rows],
        pad_cloud(points, MOST_POINTS),
        DepthImage(jnp.asarray(padded), intrinsics(view.camera)),
        warnings,
        inside is not None or (background is not None and (background.background or background.roi) is not None),
    )


def nearest_row(points: Float32[np.ndarray, "n 3"], place: Float[np.ndarray, "3"]) -> int:
    """Return the row of the point that is nearest to a place."""
    return int(((points - place) ** 2).sum(axis=1).argmin())


class _Seen(NamedTuple):
    """A scan as its sensor saw it."""

    T_scene_camera: Float[np.ndarray, "4 4"]
    points: Float32[np.ndarray, "n 3"]
    depth: Float32[np.ndarray, "h w"]
    camera: Camera
    rows: Int[np.ndarray, " n"]  # of the scan's points: all but those behind the sensor


def _seen(scan: Scan, sensor: Float[np.ndarray, "3"] | None) -> _Seen:
    """Return a scan in its sensor's frame: a depth image as it is, a cloud with an image about as fine as its points.

    Raises InputError if the sensor's place lies among the points.
    """
    if scan.depth is not None and scan.camera is not None:
        return _Seen(np.eye(4), scan.points, scan.depth, scan.camera, np.arange(len(scan.points)))
    place = np.zeros(3) if sensor is None else np.asarray(sensor, dtype=np.float64)
    offsets = scan.points.astype(np.float64) - place
    distances = np.linalg.norm(offsets, axis=1)
    typical = float(np.median(distances))
    rotation = _towards(offsets.mean(axis=0), typical)
    points = offsets @ rotation.T
    if distances.min() <= _NEAREST * typical or (points[:, 2] <= 0).mean() > MOST_BEHIND:
        where = "the origin" if sensor is None else f"{tuple(float(x) for x in place)}"
        raise InputError(f"the sensor cannot have been at {where}, among the points: say where it was")
    rows = np.flatnonzero(points[:, 2] > 0)
    points = points[rows].astype(np.float32)
    camera = _fine_camera(points)
    T_scene_camera = np.eye(4)
    T_scene_camera[:3, :3], T_scene_camera[:3, 3] = rotation.T, place
    return _Seen(T_scene_camera, points, _depth_of(points, camera), camera, rows)


def _depth_of(points: Float32[np.ndarray, "n 3"], camera: Camera) -> Float32[np.ndarray, "h w"]:
    """Return the depth image of a cloud, made of pieces of one size."""
    nearest = np.full((camera.height, camera.width), np.inf, dtype=np.float32)
    for start in range(0, len(points), MOST_POINTS):
        piece = pad_cloud(points[start : start + MOST_POINTS], MOST_POINTS)
        depth = np.asarray(_depth_buffer(*piece, intrinsics(camera), shape=nearest.shape))
        nearest = np.where(depth > 0, np.minimum(depth, nearest), nearest)
    return np.where(np.isfinite(nearest), nearest, np.float32(0))


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


def _thinned(front: Bool[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
    """Return a random part of the rows, in their order; all if they are few."""
    total = len(front)
    if total <= MOST_POINTS:
        return np.arange(total)
    kept = np.random.default_rng(0).choice(total, MOST_POINTS, replace=False)
    kept.sort()
    if not front[kept].any():  # then the foreground is small: it stays whole
        half = MOST_POINTS // 2
        kept = np.union1d(kept[:half], np.flatnonzero(front)[:half])
    return kept


_depth_buffer = jax.jit(depth_buffer, static_argnames="shape")
