"""What a bin scene is: a bin, an object's poses in it, and a camera above. Plain data, lengths in one unit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera


@dataclass(frozen=True)
class Bin:
    """A box without a lid. Its frame: origin at the centre of the floor's upper side, z up, x along `length`.

    `length`, `width` and `height` are inner, `thickness` is that of floor and walls, which lie outside of them.
    """

    length: float
    width: float
    height: float
    thickness: float

    def __post_init__(self) -> None:
        sizes = (self.length, self.width, self.height, self.thickness)
        if not np.isfinite(sizes).all() or min(sizes) <= 0:
            raise InputError(f"bin: length, width, height and thickness are {sizes}, but must be above zero")


@dataclass(frozen=True, eq=False)
class Fixture:
    """A surface that is in a scene beside the copies, such as a container or other parts: a mesh at some poses."""

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    T_bin_fixture: Float[np.ndarray, "k 4 4"]


@dataclass(frozen=True, eq=False)
class BinScene:
    """Copies of one object at rest in a bin, seen by one camera. Frames: object, bin, camera.

    With fixtures, these are all that is there beside the copies, and the bin is no more than the space they lie in.
    """

    bin: Bin
    T_bin_object: Float[np.ndarray, "n 4 4"]
    camera: Camera
    T_camera_bin: Float[np.ndarray, "4 4"]
    fixtures: tuple[Fixture, ...] | None = None

    @property
    def T_camera_object(self) -> Float[np.ndarray, "n 4 4"]:
        """The poses of the copies in the camera frame."""
        return self.T_camera_bin @ self.T_bin_object
