"""Where the camera above a bin is: near enough to be sharp, far enough that the whole bin is in the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera
from kmn_jax.simulate._bin_scene import Bin


@dataclass(frozen=True)
class CameraConfig:
    """How cameras are placed. Angles are in degrees; ranges are (least, most) and drawn from evenly.

    The focal length follows from the view: the bin's outermost corner lies at a share drawn from `fill` of the way
    from the picture's centre to its border.
    """

    width: int = 972
    height: int = 600
    distance: tuple[float, float] = (6.5, 9.0)  # from the point looked at, in diagonals of the object, ...
    clearance: float = 1.2  # ... and at least this in diagonals of the bin
    aim: float = 0.1  # how far from the bin's middle that point may be, as a share of its length, width and height
    tilt: float = 20.0  # at most, from the vertical, to any side
    least_tilt: float = 0.0
    roll: float = 15.0  # at most, either way, from the picture's rows along the bin's length
    fill: tuple[float, float] = (0.85, 0.98)

    def __post_init__(self) -> None:
        if self.width < 2 or self.height < 2:
            raise InputError(f"camera config: width = {self.width} and height = {self.height} must be 2 pixels or more")
        if not 0 < self.distance[0] <= self.distance[1] < np.inf:
            raise InputError(f"camera config: distance is {self.distance}, but must be a range above zero")
        if not 0 < self.fill[0] <= self.fill[1] <= 1:
            raise InputError(f"camera config: fill is {self.fill}, but must be a range above 0, up to 1")
        # Within these bounds every camera is above the rim and every corner in front of it.
        if not 1.1 <= self.clearance < np.inf or not 0 <= self.aim <= 0.25 or not 0 <= self.tilt <= 45:
            raise InputError(
                f"camera config: clearance = {self.clearance} must be at least 1.1, aim = {self.aim} between 0 and"
                f" 0.25, tilt = {self.tilt} between 0 and 45 degrees, or the camera may not see the whole bin"
            )
        if not 0 <= self.least_tilt <= self.tilt:
            raise InputError(f"camera config: least_tilt = {self.least_tilt} must be between 0 and tilt = {self.tilt}")
        if not 0 <= self.roll <= 180:
            raise InputError(f"camera config: roll = {self.roll} must be between 0 and 180 degrees")


def place_camera(
    bin: Bin, diagonal: float, config: CameraConfig, rng: np.random.Generator
) -> tuple[Camera, Float[np.ndarray, "4 4"]]:
    """Draw a camera above the bin, whose eight outer corners are in its picture; return it and T_camera_bin.

    `diagonal` is the object's, in the bin's unit. Generators in the same state give the same view.
    """
    if not 0 < diagonal < np.inf:
        raise InputError(f"diagonal is {diagonal}, but must be above zero and finite")
    inner = np.array([bin.length, bin.width, bin.height])
    outer = inner + bin.thickness * np.array([2, 2, 1])
    target = rng.uniform(-config.aim, config.aim, 3) * inner + [0, 0, bin.height / 2]
    distance = max(rng.uniform(*config.distance) * diagonal, config.clearance * float(np.linalg.norm(outer)))
    tilt, roll = np.radians([rng.uniform(config.least_tilt, config.tilt), rng.uniform(-config.roll, config.roll)])
    side = rng.uniform(0, 2 * np.pi)
    back = np.array([np.sin(tilt) * np.cos(side), np.sin(tilt) * np.sin(side), np.cos(tilt)])
    right = np.array([1.0, 0, 0]) - back[0] * back
    right /= np.linalg.norm(right)
    down = np.cross(-back, right)
    T_camera_bin = np.eye(4)
    T_camera_bin[0, :3] = np.cos(roll) * right - np.sin(roll) * down
    T_camera_bin[1, :3] = np.sin(roll) * right + np.cos(roll) * down
    T_camera_bin[2, :3] = -back
    T_camera_bin[:3, 3] = -T_camera_bin[:3, :3] @ (target + distance * back)
    low = np.array([-outer[0] / 2, -outer[1] / 2, -bin.thickness])
    corners = (low + outer * list(np.ndindex(2, 2, 2))) @ T_camera_bin[:3, :3].T + T_camera_bin[:3, 3]
    reach = np.abs(corners[:, :2] / corners[:, 2:]).max(axis=0)
    middle = np.array([config.width - 1, config.height - 1]) / 2
    focal = float((middle / reach).min()) * rng.uniform(*config.fill)
    return Camera(focal, focal, middle[0], middle[1], config.width, config.height), T_camera_bin
