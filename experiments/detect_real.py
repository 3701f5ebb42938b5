"""Detection in real scans with poses that were fitted by hand: `python -m experiments.detect_real FOLDER`.

The folder holds `real_motors` (camera.json, depth.png, motor.stl, truth.json) and `real_more` (clouds, CAD files and
truth.json), which are not part of this repository. The whole scan is given and nothing else. A copy is listed if some
pose of the result is right (ADI below a tenth of the diameter), accepted if one of those that are accepted is. What is
accepted and lies on no copy, on none that could not be fitted either, is wrong.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro
from jaxtyping import Bool, Float

from experiments.bins import THRESHOLD, TrueImage
from kmn_jax.bop import FrameKey
from kmn_jax.detection import PoseEstimator
from kmn_jax.errors import InputError
from kmn_jax.io import Scan, read_scan
from kmn_jax.programs import call_in_place
from kmn_jax.released import RELEASED
from kmn_jax.report import check_target, print_table, write_json
from kmn_jax.units import check_unit

_FORWARDS = np.diag([1.0, -1.0, -1.0, 1.0])  # from a frame whose z points backwards


@dataclass(frozen=True)
class Options:
    """What to detect in, by what."""

    folder: Annotated[Path, tyro.conf.Positional]
    weights: str = RELEASED
    json: Path | None = None


class RealScan(NamedTuple):
    """A scan, the CAD file of what is in it, and where the copies are."""

    name: str
    cad: Path
    cad_unit: str
    scan: Scan
    poses: Float[np.ndarray, "i 4 4"]  # T_scene_object, in the scan's unit
    certain: Bool[np.ndarray, " i"]
    unfitted: Float[np.ndarray, "u 3"]  # points on copies whose poses are not known


def real_scans(folder: Path) -> Iterator[RealScan]:
    """Yield the scans of a folder. Raises InputError if they are not there."""
    try:
        motors = json.loads((folder / "real_motors" / "truth.json").read_text(encoding="utf-8"))
        more = json.loads((folder / "real_more" / "truth.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{folder} holds no real scans with poses: {error}") from None
    own = folder / "real_motors"
    scan = read_scan(own / "depth.png", "mm", own / "camera.json")
    yield RealScan("motors", own / "motor.stl", "mm", scan, *_truth(motors, np.eye(4)))
    own = folder / "real_more"
    for kind in more.values():
        unit = {1.0: "m", 0.001: "mm"}[kind["scale_cad_to_scene"]]
        for name, truth in kind["scenes"].items():
            scan, turn = read_scan(own / name, "m"), np.eye(4)
            if np.median(scan.points[:, 2]) < 0:
                turn = _FORWARDS
                scan = Scan(scan.points @ turn[:3, :3].astype(np.float32), None, None, None, "m")
            yield RealScan(name, own / kind["cad"], unit, scan, *_truth(truth, turn))


def _truth(
    stored: dict[str, Any], turn: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "i 4 4"], Bool[np.ndarray, " i"], Float[np.ndarray, "u 3"]]:
    poses = np.array([turn @ np.array(pose["T_scene_object"]) for pose in stored["poses"]])
    certain = np.array([pose["certain"] for pose in stored["poses"]])
    return poses, certain, np.array(stored.get("unfitted_visible", [])).reshape(-1, 3) @ turn[:3, :3].T


def detect_in(estimator: PoseEstimator, real: RealScan) -> dict[str, Any]:
    """Return what is found of a scan's copies."""
    part = estimator.prepare(real.cad, check_unit(real.cad_unit))
    result = estimator.detect(part, real.scan)
    inside = part.in_unit(real.scan.unit)
    image = TrueImage(FrameKey(0, 0), inside, (), real.poses, np.ones(len(real.poses)))
    accepted = np.array([pose.probability >= estimator.config.accepted for pose in result.poses], dtype=bool)
    errors = image.errors(np.array([pose.T_scene_object for pose in result.poses]).reshape(-1, 4, 4))
    right = errors < THRESHOLD
    center = np.append((inside.minimum + inside.maximum) / 2, 1)
    centers = np.array([(pose.T_scene_object @ center)[:3] for pose in result.poses]).reshape(-1, 3)
    apart = np.linalg.norm(centers[:, None] - real.unfitted[None], axis=2)
    known = right.any(axis=1) | (apart < inside.diameter / 2).any(axis=1)
    return {
        "scan": real.name,
        "copies": int(real.certain.sum()),
        "listed": int((right.any(axis=0) & real.certain).sum()),
        "accepted": int((right[accepted].any(axis=0) & real.certain).sum()),
        "accepted, wrong": int((accepted & ~known).sum()),
        "most probable wrong": max(
            (pose.probability for pose, of in zip(result.poses, known, strict=True) if not of), default=0.0
        ),
        "seconds": result.timing.total,
    }


def run(options: Options) -> list[dict[str, Any]]:
    """Detect, print and return the numbers."""
    check_target(options.json)
    estimator = PoseEstimator.from_pretrained(options.weights)
    rows = [detect_in(estimator, real) for real in real_scans(options.folder)]
    print_table("Detection in real scans", rows)
    write_json(options.json, {"scans": rows})
    return rows


if __name__ == "__main__":
    call_in_place()
    try:
        run(tyro.cli(Options))
    except InputError as problem:
        sys.exit(f"error: {problem}")
