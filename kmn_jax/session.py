"""What `kmn detect` and `kmn view` are asked for, and the search of it in this process."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro

from kmn_jax.errors import InputError, number_list, require
from kmn_jax.released import RELEASED

if TYPE_CHECKING:
    from jaxtyping import Float

    from kmn_jax.detection import Detections, Scene
    from kmn_jax.units import Unit

_FIRST = "kmn: the first search compiles what all later ones use, which takes up to a minute"

Units = Literal["auto", "mm", "cm", "m", "in"]


@dataclass(frozen=True)
class Request:
    """What to look for, and where."""

    object: Path
    """CAD file (STL, OBJ, PLY, GLB, STEP), cloud of the whole surface, or object card (.kmn)."""
    scene: Path
    """Cloud (PLY, PCD, XYZ, NPY, NPZ), depth image (PNG, TIFF, EXR, NPY, NPZ) or depth image of a BOP dataset."""
    camera: Path | None = None
    """JSON with fx, fy, cx, cy, or cam_K, and perhaps depth_scale; depth images outside of BOP datasets need it."""
    at: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """X,Y,Z: the pose of the copy at this point of the scene only; may be given several times."""
    units: Units = "auto"
    """Unit of the scene's lengths; auto: that of the object, or what the format says."""
    object_units: Units = "auto"
    """Unit of the object's numbers; auto: what the format says, else millimetres. Cards, STEP and GLB files state
    theirs, and are converted."""
    random_seed: int = 0
    """Number that all randomness starts from: the same inputs and number give the same poses."""
    background: Path | None = None
    """Scan of the empty bin, of the scene's format and unit: what is near to it is not searched."""
    roi: str | None = None
    """XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX, or for a turned box its centre X,Y,Z, size X,Y,Z and rotation vector in degrees
    RX,RY,RZ: only points inside of this box of the scene's frame are searched."""
    plane: Literal["auto", "always", "never"] = "auto"
    """Whether to leave out the largest plane, what is behind it, and a bin's walls; auto: if larger than the object."""
    effort: Literal["fast", "usual", "thorough"] = "usual"
    """fast: seven tenths of the time, and fewer copies; thorough: some three times, and perhaps a few more."""
    sensor: str | None = None
    """X,Y,Z of the sensor in the scene's frame; the origin unless given."""
    base_camera: Path | None = None
    """JSON with T_base_camera (4 x 4), or xyz and the quaternion xyzw, and perhaps unit, else the scene's: the camera's
    pose in the robot's frame, in which poses are then told, too."""
    grasps: Path | None = None
    """File of the object's grasps, see docs/grasps.md: poses then carry those that are free."""
    weights: str = RELEASED
    """Released network, or a .safetensors file."""

    @property
    def files(self) -> tuple[Path | None, ...]:
        """Return the files to read, but for weights."""
        return (self.object, self.scene, self.camera, self.background, self.base_camera, self.grasps)


class Session:
    """An estimator with the part and the scan of a request."""

    def __init__(self, request: Request) -> None:
        from kmn_jax.detection import (
            Clock,
            ForegroundOptions,
            OrientedBox,
            PoseEstimator,
            config_of,
            find_poses_in_crop,
            prepare_kept,
        )
        from kmn_jax.io import read_pose
        from kmn_jax.objects import load_grasps
        from kmn_jax.programs import ended_by_interrupt

        places = [number_list(text, "--at", 3) for text in request.at]
        region: Any = None if request.roi is None else tuple(number_list(request.roi, "--roi", 6, 9))
        if region is not None and len(region) == 9:
            region = OrientedBox.of_numbers(region)
        sensor = None if request.sensor is None else np.array(number_list(request.sensor, "--sensor", 3))
        self.places = np.array(places) if places else None
        self._base = None if request.base_camera is None else read_pose(request.base_camera, "T_base_camera")
        if self._base is not None and sensor is not None:
            raise InputError("--base-camera is for scans in the camera's frame: leave --sensor out")
        self._grasps = None if request.grasps is None else load_grasps(request.grasps)
        self._request, self._clock = request, Clock()
        with self._clock("part"), ended_by_interrupt():
            self.estimator = PoseEstimator.from_pretrained(request.weights, config_of(request.effort))
            if find_poses_in_crop.is_to_be_made:
                print(_FIRST, file=sys.stderr, flush=True)
            self.part = prepare_kept(self.estimator, request.object, unit_of(request.object_units))
        with self._clock("scene"):
            empty = None
            if request.background is not None:
                empty = self.estimator.read(request.background, self.part, request.units, request.camera)
            self._known: Any = {
                "unit": request.units,
                "camera": request.camera,
                "sensor": sensor,
                "at": self.places,
                "background": ForegroundOptions(empty, region, request.plane),
            }
            self.scene = self.estimator.scene(request.scene, self.part, **self._known)

    def go_on(self, path: Path) -> tuple[Scene, Detections]:
        """Search another scan of the same kind."""
        with self._clock("scene"):
            scene = self.estimator.scene(path, self.part, **self._known)
        require(scene.unit == self.scene.unit, f"{path} is in {scene.unit}, but the one before in {self.scene.unit}")
        self.scene = scene
        return scene, self.detect(self.places)

    def detect(self, places: Float[np.ndarray, "k 3"] | None, top: int | None = None) -> Detections:
        """Search the scan, or places of it only."""
        from kmn_jax.detection import Clock
        from kmn_jax.io import in_other_unit
        from kmn_jax.programs import ended_by_interrupt

        clock, self._clock = self._clock, Clock()
        base = None
        if self._base is not None:
            pose, unit = self._base
            base = in_other_unit(pose, unit or self.scene.unit, self.scene.unit)
        with ended_by_interrupt():
            return self.estimator.detect(
                self.part,
                self.scene,
                at=places,
                T_base_camera=base,
                grasps=self._grasps,
                random_seed=self._request.random_seed,
                top=top,
                clock=clock,
            )


def unit_of(units: Units) -> Unit | None:
    """Return a unit, None where it is not said."""
    return None if units == "auto" else units
