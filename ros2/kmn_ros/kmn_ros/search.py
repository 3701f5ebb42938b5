"""The search that the node runs: a part, what is known of the background, and scans one after the other."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from kmn_jax import Detections, ForegroundOptions, InputError, PoseEstimator, Scan
from kmn_jax.detection import OrientedBox
from kmn_jax.errors import number_list
from kmn_jax.io import in_other_unit, read_pose


@dataclass(frozen=True)
class Settings:
    """The node's parameters: names, types and defaults; an empty text is none."""

    part: str = ""  # CAD file or object card
    part_unit: str = ""  # of its numbers: mm, cm, m or in; by default what its format states, else mm
    input: str = "depth"  # or cloud
    depth_unit: float = 0.0  # metres of one step of the depth image; 0: as its encoding has it
    on_demand: bool = False  # search when the service is called, not every scan
    wait: float = 5.0  # seconds in which a service waits for a scan
    min_probability: float = 0.8  # of poses that are published
    roi: str = ""  # as in kmn detect --roi, in metres, in the scans' frame
    plane: str = "auto"  # or always, never
    frame: str = ""  # that scans are in, in place of the one in their headers
    object_frame: str = ""  # of transforms, before _1, _2 and so on; by default the part's name
    base_frame: str = ""  # the robot's frame, in which poses are published if base_camera is given
    base_camera: str = ""  # file of the camera's pose there, as in kmn detect --base-camera; metres unless it says

    def __post_init__(self) -> None:
        if not self.part:
            raise InputError("no part is given: set the parameter part to a CAD file or an object card")
        if self.input not in ("depth", "cloud"):
            raise InputError(f"input is {self.input!r}, but must be depth or cloud")
        if not 0 <= self.depth_unit < 1:
            raise InputError(f"depth_unit is {self.depth_unit}, but must be how many metres one step is, such as 0.001")
        if not 0 <= self.min_probability <= 1:
            raise InputError(f"min_probability is {self.min_probability}, but must be between 0 and 1")
        if not 0 < self.wait <= 600:
            raise InputError(f"wait is {self.wait}, but must be above 0 and at most 600 seconds")
        if bool(self.base_frame) != bool(self.base_camera):
            raise InputError("base_frame and base_camera go together: give both or none")

    @classmethod
    def names(cls) -> dict[str, Any]:
        """Return the default of each parameter by its name."""
        return {field.name: field.default for field in fields(cls)}


class PartSearch:
    """Searches scans for one part."""

    def __init__(self, settings: Settings, estimator: PoseEstimator | None = None) -> None:
        """Prepare the part. Raises InputError if a setting cannot be used."""
        self.settings = settings
        self._estimator = estimator or PoseEstimator.from_pretrained()
        unit: Any = settings.part_unit or None
        self.part = self._estimator.prepare(Path(settings.part), unit)
        plane: Any = settings.plane
        region: Any = tuple(number_list(settings.roi, "roi", 6, 9)) if settings.roi else None
        if region is not None and len(region) == 9:
            region = OrientedBox.of_numbers(region)
        self._options = ForegroundOptions(None, region, plane)
        self._base = None
        if settings.base_camera:
            pose, unit = read_pose(settings.base_camera, "T_base_camera")
            self._base = in_other_unit(pose, unit or "m", "m")

    def take_background(self, empty: Scan | None) -> None:
        """Take a scan for that of the empty bin from then on; None forgets it."""
        self._options = ForegroundOptions(empty, self._options.roi, self._options.remove_plane)

    def __call__(self, scan: Scan) -> Detections:
        """Return the copies of the part. Raises InputError if the scan cannot be used."""
        return self._estimator.detect(self.part, scan, background=self._options, T_base_camera=self._base)
