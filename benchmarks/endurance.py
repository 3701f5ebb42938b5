"""Many detections in one process, with faults among them: does memory grow, do calls slow down, does a fault stay?

python -m benchmarks.endurance [--detections 10000] [--hours 1] [--json FILE]

Parts, sizes and sensors change from call to call. Some frames are all NaN, empty, truncated, or show another part: each
must be told by InputError, or by a result without an accepted pose, and with a reason or doubtful ones. What follows
must be equal to the bit to the same frame's first result.

Whether calls slow down is judged by the processor time that they take, all threads together: how long one waits for
them depends on what else the machine does meanwhile. Both are measured.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from benchmarks.command import run
from benchmarks.endurance_frames import Frame, bin_frames, faulty, parts_of, schedule, small_frames
from kmn_jax.detection import Detections, PoseEstimator
from kmn_jax.errors import InputError, require
from kmn_jax.objects import Part
from kmn_jax.report import environment, print_table, write_json
from kmn_jax.units import check_unit

WARM = 200  # detections before the level of memory is taken
_LEVEL = 100  # detections that the level is the median of
_MOST_GROWTH = 0.05
_BINS = 60  # of time, for the trend
_LEAST_TREND = 0.05  # of what a detection takes: less is no trend, whatever the noise
_SHUFFLES = 2000


@dataclass
class Log:
    """What was measured, a row a detection."""

    seconds: list[float] = field(default_factory=list)  # that one waits
    cpu_seconds: list[float] = field(default_factory=list)
    megabytes: list[float] = field(default_factory=list)
    frames: list[str] = field(default_factory=list)
    faults: Counter[str] = field(default_factory=Counter)
    told: Counter[str] = field(default_factory=Counter)
    untold: list[str] = field(default_factory=list)
    differing: list[str] = field(default_factory=list)


def main(detections: int = 10_000, hours: float = 1.0, seed: int = 0, json: Path | None = None) -> int:
    """Detect, and return 1 unless memory and latency are flat, all faults are told, and no frame differs.

    Args:
        detections: how many.
        hours: the run ends after so long, whatever was done.
        seed: number that the order of frames and faults follows from.
        json: where the verdict and what it is made of goes.
    """
    require(hours > 0, f"--hours is {hours}, but must be above 0")
    random, log = np.random.default_rng(seed), Log()
    estimator = PoseEstimator.from_pretrained()
    with tempfile.TemporaryDirectory(prefix="endurance-") as place:
        folder = Path(place)
        parts = parts_of(estimator)
        frames, bins = small_frames(parts, folder, random), bin_frames(folder)
        first = {frame.name: _detected(estimator, parts, frame) for frame in tqdm([*frames, *bins], desc="first")}
        empty = _empty(first)
        begin = time.perf_counter()
        for frame, fault in tqdm(schedule(frames, bins, detections, random), total=detections, unit="detection"):
            if time.perf_counter() - begin > 3600 * hours:
                break
            _step(estimator, parts, frame, fault, folder, first, log)
        duration = time.perf_counter() - begin
    found = verdict(log, detections)
    print_table(f"{len(log.seconds)} detections in {duration / 60:.1f} min, seed {seed}", [found])
    print(f"frames without a result, which get no faults: {', '.join(empty) or 'none'}")
    for line in (*log.untold[:20], *log.differing[:20]):
        print(line)
    curves: dict[str, list[float]] = {
        "seconds": log.seconds,
        "cpu_seconds": log.cpu_seconds,
        "megabytes": log.megabytes,
    }
    counts = {"faults": dict(log.faults), "told": dict(log.told)}
    facts = {"seed": seed, "duration": round(duration, 1), "empty": empty, "verdict": found, **counts}
    write_json(json, {**environment(), **facts, **_thinned(curves)})
    return 0 if found["holds"] else 1


def verdict(log: Log, wanted: int) -> dict[str, Any]:
    """Return the figures of a run, and whether all that is promised holds."""
    memory, warm = np.array(log.megabytes), min(WARM, len(log.megabytes) // 4)
    level = float(np.median(memory[warm : warm + _LEVEL]))
    growth = float(_smooth(memory[warm:]).max() / level - 1)
    frames = log.frames[warm:]
    drift, noise = trend(relative_seconds(log.cpu_seconds[warm:], frames))
    waiting = trend(relative_seconds(log.seconds[warm:], frames))
    holds = {
        "all were done": len(log.seconds) == wanted,
        "memory": growth <= _MOST_GROWTH,
        "latency": drift <= max(noise, _LEAST_TREND),
        "faults": not log.untold,
        "same bits": not log.differing,
    }
    return {
        "detections": len(log.seconds),
        "faults": sum(log.faults.values()),
        "untold": len(log.untold),
        "differing": len(log.differing),
        "level MB": round(level),
        "growth": round(growth, 4),
        "median ms": round(1e3 * float(np.median(log.seconds)), 1),
        "cpu ms": round(1e3 * float(np.median(log.cpu_seconds)), 1),
        "cpu drift": round(drift, 4),
        "cpu noise": round(noise, 4),
        "drift": round(waiting[0], 4),
        "noise": round(waiting[1], 4),
        "fails": ", ".join(name for name, held in holds.items() if not held) or "nothing",
        "holds": all(holds.values()),
    }


def relative_seconds(seconds: Sequence[float], frames: Sequence[str]) -> Float[np.ndarray, " n"]:
    """Return latencies over the median of their kind of frame: what is left is how the process does."""
    times, names = np.array(seconds), np.array(frames)
    medians = {name: float(np.median(times[names == name])) for name in set(frames)}
    return times / np.array([medians[name] for name in frames])


def trend(values: Float[np.ndarray, " n"], shuffles: int = _SHUFFLES) -> tuple[float, float]:
    """Return the change from begin to end by a robust slope, and what chance alone would give once in a hundred times.

    The slope is the median over all pairs of medians of equal stretches; chance is their order shuffled.
    """
    stretches = np.array([np.median(part) for part in np.array_split(values, min(_BINS, len(values)))])
    rows, columns = np.triu_indices(len(stretches), 1)

    def change(series: Float[np.ndarray, " b"]) -> float:
        return float(np.median((series[columns] - series[rows]) / (columns - rows)) * (len(series) - 1))

    random = np.random.default_rng(0)
    chance = [abs(change(random.permutation(stretches))) for _ in range(shuffles)]
    return change(stretches), float(np.quantile(chance, 0.99))


def _empty(first: dict[str, bytes | str]) -> list[str]:
    """Return the frames in which nothing is found without a fault. Raises InputError if all are."""
    empty = [name for name, found in first.items() if isinstance(found, str)]
    if len(empty) == len(first):
        raise InputError("nothing is found in any frame, so that no fault would be noticed")
    return empty


def _step(
    estimator: PoseEstimator,
    parts: dict[str, Part],
    frame: Frame,
    fault: str | None,
    folder: Path,
    first: dict[str, bytes | str],
    log: Log,
) -> None:
    number = len(log.seconds)
    if isinstance(first[frame.name], str):  # nothing is found in it anyway: any fault would pass for told
        fault = None
    given = frame if fault is None else faulty(frame, fault, folder, parts)
    start, cpu_start = time.perf_counter(), time.process_time()
    found = _detected(estimator, parts, given)
    log.seconds.append(time.perf_counter() - start)
    log.cpu_seconds.append(time.process_time() - cpu_start)
    log.megabytes.append(_megabytes())
    log.frames.append(frame.name if fault is None else f"{frame.name}, {fault}")
    if fault is None:
        if found != first[frame.name]:
            log.differing.append(f"detection {number}, {frame.name}: another result than at first")
        return
    log.faults[fault] += 1
    if isinstance(found, str):
        log.told[fault] += 1
    else:
        log.untold.append(f"detection {number}, {frame.name}, {fault}: accepted poses as if nothing were wrong")


def _detected(estimator: PoseEstimator, parts: dict[str, Part], frame: Frame) -> bytes | str:
    """Return the bits of what was accepted, or in words why nothing was."""
    try:
        found = estimator.detect(parts[frame.part], frame.scan, frame.camera, check_unit(frame.unit), frame.at)
    except InputError as error:
        return str(error)
    if any(pose.probability >= estimator.config.accepted for pose in found.poses):
        return _bits(found)
    assert found.poses or found.reason
    return found.reason or f"no pose above {max(pose.probability for pose in found.poses)!r}"


def _bits(found: Detections) -> bytes:
    numbers = [np.append(pose.T_scene_object.ravel(), (pose.probability, pose.num_inliers)) for pose in found.poses]
    assert np.isfinite(numbers).all()
    return np.array(numbers).tobytes()


def _megabytes() -> float:
    """Return the memory that the process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _smooth(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " b"]:
    return np.array([np.median(part) for part in np.array_split(values, min(_BINS, len(values)))])


def _thinned(curves: dict[str, list[float]]) -> dict[str, Any]:
    """Return medians of a hundred stretches: enough for a picture."""
    stretches = {name: np.array_split(np.array(values), min(100, len(values))) for name, values in curves.items()}
    return {name: [round(float(np.median(part)), 4) for part in parts] for name, parts in stretches.items()}


if __name__ == "__main__":
    run(main)
