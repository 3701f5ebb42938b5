"""Where the camera was in the frame of a scan, and results in a robot's frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from kmn_jax.detection._frames import MOST_BEHIND, into
from kmn_jax.detection._result import Detections
from kmn_jax.errors import InputError
from kmn_jax.io import Scan, pose_matrix
from kmn_jax.typing import ArrayInput

_OPENGL = (
    "all points lie at negative z, as in frames of OpenGL (y up, z backwards)",
    "negate y and z of all points, or give T_scene_camera = diag(1, -1, -1, 1) in Python",
)


_OFF_CENTRE = 0.15  # of an image's width or height: so far from its middle, no lens is mounted
_WIDEST = 130.0  # degrees that the widest depth cameras see, along the diagonal
_STRAY = 1  # per cent of the points
_SAMPLE = 20_000  # points that tell how wide a scan is


class ScanFrame(NamedTuple):
    """What is known of the camera in the frame of a scan."""

    T_scene_sensor: Float[np.ndarray, "4 4"] | None  # of the camera as its user knows it; None if only its place is
    sensor: Float[np.ndarray, "3"] | None  # its place; None: the origin
    warnings: tuple[str, ...]
    is_opengl: bool = False


def scan_frame(scan: Scan, sensor: Float[np.ndarray, "3"] | None, T_scene_camera: ArrayInput | None) -> ScanFrame:
    """Return where a scan's camera was: at the origin unless a place or a pose is given.

    It warns of what camera and points can hardly be to each other. Raises InputError for both at once, for a depth
    image with either, and if points lie behind the camera.
    """
    if T_scene_camera is None:
        backwards = scan.camera is None and sensor is None and bool((scan.points[:, 2] < 0).all())
        note = f"{_OPENGL[0]}: poses are given in that frame; for those in the camera's usual frame, {_OPENGL[1]}"
        notes = (*((note,) if backwards else ()), *_questions(scan, sensor))
        return ScanFrame(np.eye(4) if sensor is None else None, sensor, notes, backwards)
    if sensor is not None:
        raise InputError("T_scene_camera says where the sensor was: leave sensor out")
    if scan.camera is not None:
        raise InputError("a depth image is in the frame of its camera: leave T_scene_camera out")
    pose = pose_matrix(T_scene_camera, "T_scene_camera")
    behind = float((into(pose, scan.points)[:, 2] <= 0).mean())
    if behind > MOST_BEHIND:
        raise InputError(
            f"{behind:.0%} of the points lie behind the camera of T_scene_camera: give the camera's pose in the frame"
            " of the points, z forward (its inverse, or axes of OpenGL, look like this)"
        )
    return ScanFrame(pose, pose[:3, 3], tuple(_questions(scan, pose[:3, 3])))


def _questions(scan: Scan, sensor: Float[np.ndarray, "3"] | None) -> Iterator[str]:
    """Ask of a camera that is known whether it is this image's, of one that is not whether it can have been there."""
    if scan.camera is not None:
        camera = scan.camera
        off = np.abs([camera.cx / camera.width - 0.5, camera.cy / camera.height - 0.5])
        if off.max() > _OFF_CENTRE:
            yield (
                f"the camera's cx, cy = {camera.cx:g}, {camera.cy:g} lie far from the middle of the image of"
                f" {camera.width} x {camera.height} pixels: are fx, fy, cx and cy those of an image of this size, and"
                " of this piece of it if it was cut out?"
            )
        return
    some = scan.points[:: 1 + len(scan.points) // _SAMPLE]
    offsets = some - (np.zeros(3) if sensor is None else sensor)
    directions = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    # From the direction that is farthest from the middle one to that which is farthest from it, but for strays.
    order = (directions @ directions.mean(axis=0)).argsort()
    outermost = directions[order[len(order) * _STRAY // 100]]
    cosine = np.percentile(directions @ outermost, _STRAY)
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    if angle > _WIDEST:
        where = "the origin, where the sensor is taken to have been" if sensor is None else "the sensor's place"
        yield (
            f"as seen from {where}, the points fill an angle of {angle:.0f} degrees, more than sensors see: say"
            " where in the frame of the points it was (--sensor, in Python sensor=)"
        )


def base_from_scene(
    T_base_camera: ArrayInput | None, T_scene_sensor: Float[np.ndarray, "4 4"] | None, is_opengl: bool
) -> Float[np.ndarray, "4 4"] | None:
    """Return the pose of a scan's frame in the robot's; None without `T_base_camera`.

    Raises InputError if it is not known how the camera lies in the scan's frame.
    """
    if T_base_camera is None:
        return None
    pose = pose_matrix(T_base_camera, "T_base_camera")
    if T_scene_sensor is None:
        raise InputError(
            "T_base_camera needs the camera's axes in the scan's frame, too: give T_scene_camera in place of the"
            " sensor's place, or a scan in the camera's frame"
        )
    if is_opengl:
        raise InputError(f"{_OPENGL[0]}, to which T_base_camera cannot be applied: {_OPENGL[1]}")
    return pose @ np.linalg.inv(T_scene_sensor)


def in_base(found: Detections, T_base_scene: Float[np.ndarray, "4 4"], question: str | None = None) -> Detections:
    """Return a result with the poses of its copies in the robot's frame, too, and a warning if there is a question."""
    poses = tuple(replace(pose, T_base_object=T_base_scene @ pose.T_scene_object) for pose in found.poses)
    return replace(found, poses=poses, warnings=(*found.warnings, *filter(None, (question,))))
