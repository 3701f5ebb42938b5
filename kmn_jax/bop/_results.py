"""Estimated poses as a BOP result file, the table that benchmarks take: written and read back."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from kmn_jax.bop._files import is_rotation, millimetres
from kmn_jax.errors import InputError
from kmn_jax.files import write_whole

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
_SAME_TIME = 1e-3  # seconds; the tolerance of the benchmark's own check


@dataclass(frozen=True)
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
    factor, lines, times = millimetres(unit), [HEADER], dict[tuple[int, int], float]()
    for index, estimate in enumerate(estimates):
        name, pose = f"estimate {index}", np.asarray(estimate.T_camera_object, dtype=np.float64)
        fault = _fault(estimate, pose, times)
        if fault:
            raise InputError(f"{name}: {fault}")
        if pose[3].tolist() != [0, 0, 0, 1]:
            raise InputError(f"{name}: the last row of T_camera_object must be 0 0 0 1")
        rotation, translation = (_joined(pose[:3, :3].ravel()), _joined(pose[:3, 3] * factor))
        ids = f"{int(estimate.scene_id)},{int(estimate.image_id)},{int(estimate.object_id)}"
        lines.append(f"{ids},{float(estimate.score)!r},{rotation},{translation},{float(estimate.seconds)!r}")
    write_whole(path, ("\n".join(lines) + "\n").encode())


def read_results(path: str | Path, unit: str) -> tuple[BopEstimate, ...]:
    """Read a result file, with or without its header, into estimates with lengths in `unit`.

    Raises InputError with the file and the line for a row that breaks the format.
    """
    path, factor = Path(path), 1 / millimetres(unit)
    try:
        lines = path.read_bytes().decode("utf-8-sig").splitlines()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file: {error}") from None
    if not lines:
        raise InputError(f"{path} is empty: a result file has at least the line {HEADER}")
    estimates, times = [], dict[tuple[int, int], float]()
    for number, line in enumerate(lines, start=1):
        if not line.strip() or (number == 1 and line.strip() == HEADER):
            continue
        try:
            estimate = _parse(line, factor)
            fault = _fault(estimate, estimate.T_camera_object, times)
        except ValueError as error:
            fault = str(error)
        if fault:
            raise InputError(f"{path}, line {number}: {fault}")
        estimates.append(estimate)
    return tuple(estimates)


def _parse(line: str, factor: float) -> BopEstimate:
    fields = [field.strip() for field in line.split(",")]
    if len(fields) != 7:
        raise ValueError(f"has {len(fields)} comma-separated fields, but must have the 7 of {HEADER}")
    scene_id, image_id, object_id = (
        _whole(name, field) for name, field in zip(("scene_id", "im_id", "obj_id"), fields[:3], strict=True)
    )
    pose = np.eye(4)
    pose[:3, :3] = np.reshape(_numbers("R", fields[4], 9), (3, 3))
    pose[:3, 3] = np.array(_numbers("t", fields[5], 3)) * factor
    (score,), (seconds,) = _numbers("score", fields[3], 1), _numbers("time", fields[6], 1)
    return BopEstimate(scene_id, image_id, object_id, score, pose, seconds)


def _whole(name: str, field: str) -> int:
    try:
        return int(field)
    except ValueError:
        raise ValueError(f"{name} is {field[:40]!r}, but must be a whole number") from None


def _numbers(name: str, field: str, count: int) -> list[float]:
    words = field.split()
    if len(words) != count:
        raise ValueError(f"{name} holds {len(words)} numbers, but must hold {count}, separated by spaces")
    try:
        return [float(word) for word in words]
    except ValueError:
        raise ValueError(f"{name} holds {field[:40]!r}, which is not a number") from None


def _fault(estimate: BopEstimate, pose: Float[np.ndarray, "4 4"], times: dict[tuple[int, int], float]) -> str | None:
    """Return what is wrong with an estimate, None if nothing is; `times` remembers the time of each image."""
    numbers: dict[str, Any] = {"R": pose[:3, :3], "t": pose[:3, 3], "score": estimate.score, "time": estimate.seconds}
    for name, values in numbers.items():
        if not np.isfinite(values).all():
            return f"{name} holds NaN or infinity"
    if not is_rotation(pose[:3, :3]):
        return "R is not a rotation: its rows must be orthonormal and right-handed"
    time = times.setdefault((estimate.scene_id, estimate.image_id), estimate.seconds)
    if not math.isclose(time, estimate.seconds, rel_tol=0, abs_tol=_SAME_TIME):
        image = f"image {estimate.image_id} of scene {estimate.scene_id}"
        return f"time is {estimate.seconds:g} s, but {time:g} s before in {image}: all rows of an image need the same"
    return None


def _joined(values: Float[np.ndarray, " n"]) -> str:
    return " ".join(repr(value) for value in values.tolist())
