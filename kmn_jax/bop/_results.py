"""Estimated poses as a BOP result file, the table that benchmarks take."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from kmn_jax.bop._files import millimetres
from kmn_jax.errors import InputError, rigid_pose
from kmn_jax.files import write_whole

_HEADER = "scene_id,im_id,obj_id,score,R,t,time"
_SAME_TIME = 1e-3  # seconds; the tolerance of the benchmark's own check


@dataclass(frozen=True, eq=False)
class BopEstimate:
    """One estimated pose."""

    scene_id: int
    image_id: int
    object_id: int
    score: float  # higher is better
    T_camera_object: Float[np.ndarray, "4 4"]
    seconds: float = -1.0  # for the whole image, the same in all its rows; -1 = not measured


def write_results(path: str | Path, estimates: Iterable[BopEstimate], unit: str) -> None:
    """Write estimates, whose lengths are in `unit`, as rows in the given order, with all digits and in millimetres.

    Raises InputError, and writes nothing, for a pose that is not rigid, a score or time that is not finite, and for
    images with more than one time.
    """
    factor, lines, times = millimetres(unit), [_HEADER], dict[tuple[int, int], float]()
    for index, estimate in enumerate(estimates):
        name, score, seconds = f"estimate {index}", float(estimate.score), float(estimate.seconds)
        rigid_pose(estimate.T_camera_object, f"{name}: T_camera_object")
        if not math.isfinite(score) or not math.isfinite(seconds):
            raise InputError(f"{name}: score is {score:g} and time {seconds:g} s, but both must be finite")
        time = times.setdefault((estimate.scene_id, estimate.image_id), seconds)
        if abs(time - seconds) > _SAME_TIME:
            raise InputError(
                f"{name}: time is {seconds:g} s, but {time:g} s before in image {estimate.image_id} of scene"
                f" {estimate.scene_id}: all rows of an image need the same"
            )
        pose = np.asarray(estimate.T_camera_object, dtype=np.float64)
        rotation, translation = (
            " ".join(map(repr, numbers.tolist())) for numbers in (pose[:3, :3].ravel(), pose[:3, 3] * factor)
        )
        ids = f"{int(estimate.scene_id)},{int(estimate.image_id)},{int(estimate.object_id)}"
        lines.append(f"{ids},{score!r},{rotation},{translation},{seconds!r}")
    write_whole(path, ("\n".join(lines) + "\n").encode())
