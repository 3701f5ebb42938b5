"""What a search returns: plain records on the host, in the scene's frame and unit."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

SCHEMA_VERSION = 1  # of the JSON form, see docs/detect.md


@dataclass(frozen=True)
class CropPrediction:
    """What the network says of the n points around a seed."""

    points: Float[np.ndarray, "n 3"]  # in the scene's frame; float64 if its origin is far away
    on_object: Bool[np.ndarray, " n"]  # taken for the copy that the seed is on
    keypoint: Int[np.ndarray, " n"]  # the likeliest; means nothing where on_object is false


@dataclass(frozen=True)
class Detection:
    """One found copy of a part.

    The four shares are of the picture area that the part at this pose would cover if nothing hid it, and sum up to 1.
    """

    T_scene_object: Float[np.ndarray, "4 4"]  # float64, lengths in the scene's unit
    probability: float  # of being correct: ADI below a tenth of the diameter, see docs/detect.md
    num_inliers: int  # matches of scene points with keypoints that agree on the pose
    visible_fraction: float  # share that nothing measured hides
    runner_up_gap: float  # by how much the best other pose at this place is less probable
    explained: float  # share that was measured where the pose predicts it
    violated: float  # share that the sensor saw through
    occluded: float  # share that something measured hides
    unknown: float  # share of which nothing was measured
    seed: Float[np.ndarray, "3"]  # the scene point around which the pose was searched
    prediction: CropPrediction
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Timing:
    """Wall time by stage in seconds, compilation apart; `total` is their sum."""

    stages: dict[str, float]  # without what compiling took
    compile: float

    @property
    def total(self) -> float:
        """Seconds in all."""
        return self.compile + sum(self.stages.values())


@dataclass(frozen=True)
class Detections:
    """The copies of a part in a scene, in pick order: likely and unhidden ones first."""

    part: str  # the part's name
    unit: str  # of all lengths
    poses: tuple[Detection, ...]
    timing: Timing
    reason: str | None = None  # why there are no poses, in one sentence; None if there are
    warnings: tuple[str, ...] = field(default_factory=tuple)  # about the scene
    unexplained: float | None = None  # share of the foreground on no pose that counts as found; None: of places alone
    unexplained_points: Float[np.ndarray, "u 3"] | None = None  # those points, in the scene's frame
