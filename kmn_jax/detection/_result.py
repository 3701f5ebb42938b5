"""What a search returns: plain records on the host, in the scene's frame and unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

SCHEMA_VERSION = 1  # of the JSON form, see docs/detect.md
_SHOWN = 12  # poses in what is printed of a result: it should fit on a screen
_RUNS = 8  # of ranks that a warning is told with


@dataclass(frozen=True, eq=False)
class CropPrediction:
    """What the network says of the n points around a seed."""

    points: Float[np.ndarray, "n 3"]  # in the scene's frame; float64 if its origin is far away
    on_object: Bool[np.ndarray, " n"]  # taken for the copy that the seed is on
    keypoint: Int[np.ndarray, " n"]  # the likeliest; means nothing where on_object is false


@dataclass(frozen=True, eq=False)
class Pick:
    """A grasp of a found copy at which the gripper touches nothing that was measured."""

    name: str  # of the grasp, by its file
    width: float  # between the fingers
    T_scene_grasp: Float[np.ndarray, "4 4"]
    T_base_grasp: Float[np.ndarray, "4 4"] | None = None  # in the robot's frame, if that is known

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values, see docs/grasps.md."""
        return {
            "name": self.name,
            "width": self.width,
            "T_scene_grasp": self.T_scene_grasp.tolist(),
            "T_base_grasp": None if self.T_base_grasp is None else self.T_base_grasp.tolist(),
        }


@dataclass(frozen=True, eq=False, repr=False)
class Detection:
    """One found copy of a part.

    The four shares are of the picture area that the part at this pose would cover if nothing hid it, and sum up to 1.
    """

    T_scene_object: Float[np.ndarray, "4 4"]  # float64, lengths in the scene's unit
    probability: float  # of being correct: ADI below a tenth of the diameter, see docs/detect.md
    num_inliers: int  # matches of scene points with keypoints that agree on the pose
    visible_fraction: float  # share that nothing measured hides
    runner_up_gap: float  # by how much the best other pose at this place has less probably all points in theirs
    explained: float  # share that was measured where the pose predicts it
    violated: float  # share that the sensor saw through
    occluded: float  # share that something measured hides
    unknown: float  # share of which nothing was measured
    seed: Float[np.ndarray, "3"]  # the scene point around which the pose was searched
    prediction: CropPrediction
    warnings: tuple[str, ...] = ()
    T_base_object: Float[np.ndarray, "4 4"] | None = None  # in the robot's frame, if T_base_camera was given
    grasps: tuple[Pick, ...] | None = None  # in their file's order; None if no grasps were given

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values, see docs/detect.md."""
        return {
            "T_scene_object": self.T_scene_object.tolist(),
            "probability": self.probability,
            "inliers": self.num_inliers,  # as it is called by those who read version 1 of the schema
            "num_inliers": self.num_inliers,
            "visible_fraction": self.visible_fraction,
            "runner_up_gap": self.runner_up_gap,
            "explained": self.explained,
            "violated": self.violated,
            "occluded": self.occluded,
            "unknown": self.unknown,
            "seed": self.seed.tolist(),
            "warnings": list(self.warnings),
            "T_base_object": None if self.T_base_object is None else self.T_base_object.tolist(),
            "grasps": None if self.grasps is None else [pick.to_dict() for pick in self.grasps],
        }

    def __repr__(self) -> str:
        x, y, z = self.T_scene_object[:3, 3]
        grasps = "" if self.grasps is None else f", grasps {len(self.grasps)}"
        return (
            f"Detection(probability {self.probability:.2f}, visible {self.visible_fraction:.2f},"
            f" at {x:.4g}, {y:.4g}, {z:.4g}{grasps})"
        )


@dataclass(frozen=True)
class Timing:
    """Wall time by stage in seconds, compilation apart; `total` is their sum."""

    stages: dict[str, float]  # without what compiling took
    compile: float

    @property
    def total(self) -> float:
        """Seconds in all."""
        return self.compile + sum(self.stages.values())

    def and_then(self, later: Timing) -> Timing:
        """Return both together."""
        return Timing({**self.stages, **later.stages}, self.compile + later.compile)


@dataclass(frozen=True, eq=False, repr=False)
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
    settings: Mapping[str, Any] = field(default_factory=dict)  # what it was made with, see `to_dict`

    @property
    def best(self) -> Detection | None:
        """The pose to pick first, None if nothing was found."""
        return self.poses[0] if self.poses else None

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values, those of `kmn detect --json`: see docs/detect.md.

        `object` is the part's name, where the command writes its file; `scene` is None of arrays.
        """
        return {
            "version": SCHEMA_VERSION,
            "unit": self.unit,
            "object": self.part,
            "scene": None,
            "poses": [pose.to_dict() for pose in self.poses],
            "timing": {
                "total_s": self.timing.total,
                "compile_s": self.timing.compile,
                **{f"{stage}_s": seconds for stage, seconds in self.timing.stages.items()},
            },
            "reason": self.reason,
            "unexplained": self.unexplained,
            "warnings": list(self.warnings),
            **self.settings,
        }

    def __repr__(self) -> str:
        lines = [f"Detections({self.part}: {len(self.poses)} poses, lengths in {self.unit})"]
        lines += [f"{rank:4d}. {pose!r}" for rank, pose in enumerate(self.poses[:_SHOWN], start=1)]
        lines += [f"      and {len(self.poses) - _SHOWN} more"] if len(self.poses) > _SHOWN else []
        lines += [f"      nothing found, because {self.reason}"] if not self.poses else []
        return "\n".join([*lines, *(f"      note: {note}" for note in (*self.warnings, *pose_notes(self)))])


def pose_notes(found: Detections) -> list[str]:
    """Return what poses are warned of, each warning once, after the ranks of its poses."""
    return [_note(text, ranks) for text, ranks in _warned(found).items()]


def warnings_once(found: Detections) -> tuple[list[str], list[list[str]]]:
    """Return the warnings of the whole, each once, and those that only one pose has, by pose.

    What several poses are warned of is one line of the first list.
    """
    warned = _warned(found)
    several = [_note(text, ranks) for text, ranks in warned.items() if len(ranks) > 1]
    own = [[text for text, ranks in warned.items() if ranks == [rank]] for rank in range(1, len(found.poses) + 1)]
    return [*dict.fromkeys(found.warnings), *several], own


def _warned(found: Detections) -> dict[str, list[int]]:
    """Return the ranks of the poses that have each warning, but for those of the whole."""
    ranks: dict[str, list[int]] = {}
    for rank, pose in enumerate(found.poses, start=1):
        for text in dict.fromkeys(pose.warnings):
            if text not in found.warnings:
                ranks.setdefault(text, []).append(rank)
    return ranks


def _note(text: str, ranks: Sequence[int]) -> str:
    """Return a warning after ascending ranks, with a range for three or more in a row; of many, the first ones."""
    runs: list[list[int]] = []
    for rank in ranks:
        if runs and rank == runs[-1][-1] + 1:
            runs[-1].append(rank)
        else:
            runs.append([rank])
    shown, more = runs[:_RUNS], sum(map(len, runs[_RUNS:]))
    those = ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in shown)
    return f"pose{'s' if len(ranks) > 1 else ''} {those}{f' and {more} more' if more else ''}: {text}"
