"""Whole-bin detection on ray-cast bins: `python -m experiments.detect_bins`.

Precision and recall of the copies found in the held-out test sets, by the released network and by Open3D's FPFH +
RANSAC + ICP around seeds of the same kind (the first round's are the same, later ones depend on what was found):
verification, choice and order are the same, and each has probabilities fitted to its own poses in the validation bins.
A pose is right if its ADI to a copy is below a tenth of the diameter and no more probable pose took that copy; recall
counts the copies of which at least 30% is visible. Beside it stands by how much accepted right poses are off, with
symmetries taken out; MSSD recall, by accepted poses whose MSSD is below a tenth of the diameter; and BOP's average
precision of all poses, over MSSD thresholds from 0.05 to 0.5 diameters.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tqdm import tqdm

from experiments.bins import LEAST_VISIBLE, THRESHOLD, BinImage, TrueImage, bin_images
from experiments.calibrate import SHIPPED
from experiments.fpfh import fpfh_poses
from experiments.made_data import require_made
from experiments.reliability_picture import reliability_table, save_reliability
from experiments.test_sets import SPLIT
from kmn_jax.detection import (
    EVIDENCE,
    THOROUGH,
    Clock,
    DetectConfig,
    Detections,
    Probabilities,
    chance_calibration_error,
    choose_and_refine,
    detect,
    detections,
    device_part,
    expected_calibration_error,
    explore,
    load_probabilities,
)
from kmn_jax.errors import InputError
from kmn_jax.models import Model, load_model, load_pretrained
from kmn_jax.pose import LEFT_OUT, RIGHT, THRESHOLDS, WRONG, average_precision, match_copies
from kmn_jax.programs import call_in_place
from kmn_jax.report import check_target, print_table, write_json

CONFIG = DetectConfig()
FPFH_CALIBRATION = Path("outputs/fpfh.calibration.json")
METHODS = ("kmn_jax", "kmn_jax, thorough", "FPFH")
PRECISION = 0.95  # at which recalls are compared
_NOWHERE = (np.nan, np.nan, np.nan)


@dataclass(frozen=True)
class Options:
    """What to detect by what."""

    model: Path | None = None  # .safetensors; the released model unless given
    sets: tuple[Path, ...] = (Path("outputs/test_sets/electronics"), Path("outputs/test_sets/industrial"))
    every: int = 1  # use every so many images
    methods: tuple[str, ...] = METHODS
    calibration: Path = SHIPPED
    fpfh_calibration: Path = FPFH_CALIBRATION
    json: Path | None = None
    picture: Path | None = None  # .png file for the reliability diagram


@dataclass
class Tally:
    """Counts over images."""

    probability: list[float] = field(default_factory=list)
    right: list[bool] = field(default_factory=list)
    hit: list[bool] = field(default_factory=list)  # right, on a copy that counts
    copies: int = 0
    seconds: list[float] = field(default_factory=list)
    offsets: list[tuple[float, float, float]] = field(default_factory=list)  # degrees, mm, diameters; NaN: not right
    states: list[tuple[int, ...]] = field(default_factory=list)  # at each threshold of MSSD

    @classmethod
    def of(cls, image: TrueImage, found: Detections) -> Tally:
        """Count the poses of an image, from the most probable one on."""
        tally = cls()
        poses = sorted(found.poses, key=lambda pose: -pose.probability)
        visible = image.visible >= LEAST_VISIBLE
        taken = np.zeros(len(image.truth), dtype=bool)
        placed = np.array([pose.T_scene_object for pose in poses]).reshape(-1, 4, 4)
        errors = image.errors(placed) if poses else np.zeros((0, 0))
        largest = image.largest_errors(placed) if poses else np.zeros((0, len(image.truth)))
        states = [match_copies(largest, visible, threshold) for threshold in THRESHOLDS]
        tally.states += list(zip(*(one.tolist() for one in states), strict=True))
        for pose, error in zip(poses, errors, strict=True):
            free = np.where(taken, np.inf, error)
            right = bool(free.min(initial=np.inf) < THRESHOLD)
            tally.probability.append(pose.probability)
            tally.right.append(right)
            tally.hit.append(right and bool(visible[free.argmin()]))
            if right:
                copy = int(free.argmin())
                taken[copy] = True
                turn, shift = image.offset(pose.T_scene_object, copy)
            tally.offsets.append((turn, shift, shift / image.part.diameter) if right else _NOWHERE)
        tally.copies += int(visible.sum())
        tally.seconds.append(sum(found.timing.stages.values()))
        return tally

    def extend(self, other: Tally) -> None:
        """Count what another one counted."""
        self.probability += other.probability
        self.right += other.right
        self.hit += other.hit
        self.copies += other.copies
        self.seconds += other.seconds
        self.offsets += other.offsets
        self.states += other.states

    @classmethod
    def of_absent(cls, probability: list[float]) -> Tally:
        """Count poses of a part that is not there."""
        count = len(probability)
        wrong = [False] * count
        states = [(WRONG,) * len(THRESHOLDS)] * count
        return cls(probability, wrong, list(wrong), offsets=[_NOWHERE] * count, states=states)

    def num_found(self, accepted: float) -> int:
        """Return how many copies that count have a right pose of such a probability or a higher one."""
        return int((np.array(self.hit, dtype=bool) & (np.array(self.probability) >= accepted)).sum())

    def recall_at(self, precision: float) -> float:
        """Return the recall of poses down to the probability from which on such a share of them is right."""
        right, hit = np.array(self.right, dtype=bool), np.array(self.hit, dtype=bool)
        order = np.argsort(-np.array(self.probability), kind="stable")
        precise = np.flatnonzero(np.cumsum(right[order]) >= precision * np.arange(1, len(order) + 1))
        most = hit[order[: precise[-1] + 1]].sum() if len(precise) else 0
        return float(most) / max(self.copies, 1)

    def row(self, name: str, method: str, accepted: float) -> dict[str, Any]:
        """Return the numbers."""
        probability, right = np.array(self.probability), np.array(self.right, dtype=bool)
        chosen = probability >= accepted
        return {
            "bins": name,
            "method": method,
            "images": len(self.seconds),
            "copies": self.copies,
            "recall": self.num_found(accepted) / max(self.copies, 1),
            f"recall at precision {PRECISION}": self.recall_at(PRECISION),
            "accepted": int(chosen.sum()),
            "precision": float(right[chosen].mean()) if chosen.any() else None,
            "calibration error": expected_calibration_error(probability, right),
            "calibration error by chance": chance_calibration_error(probability),
            "median s": float(np.median(self.seconds)),
            **self._accuracy(probability, chosen, right),
        }

    def _accuracy(self, probability: np.ndarray, chosen: np.ndarray, right: np.ndarray) -> dict[str, Any]:
        """Return how exact accepted poses are that are right, and BOP's measures of all poses."""
        offsets = np.array(self.offsets).reshape(-1, 3)[chosen & right]
        states = np.array(self.states).reshape(-1, len(THRESHOLDS))
        row: dict[str, Any] = {}
        for column, name in enumerate(("turned, degrees", "shifted, mm", "shifted, diameters")):
            for share, text in ((50, "median"), (90, "90%")):
                values = offsets[:, column]
                row[f"{name}, {text}"] = float(np.percentile(values, share)) if len(values) else None
        hits = (states[chosen][:, THRESHOLDS.index(THRESHOLD)] == RIGHT).sum()
        row["MSSD recall"] = float(hits) / max(self.copies, 1)
        each = [
            average_precision(probability[state != LEFT_OUT], state[state != LEFT_OUT] == RIGHT, self.copies)
            for state in states.T
            if self.copies
        ]
        return row | {"average precision": float(np.mean(each)) if each else None}


def run(options: Options) -> dict[str, Any]:
    """Detect, print and return the numbers."""
    check_target(options.json, options.picture)
    unknown = [name for name in options.methods if name not in METHODS]
    if unknown:
        raise InputError(f"method {unknown[0]!r} is not known: choose among {', '.join(METHODS)}")
    fitted = {name: _fitted(name, options) for name in options.methods}
    require_made(*options.sets)
    model = load_pretrained() if options.model is None else load_model(options.model)
    tallies: dict[tuple[str, str], Tally] = defaultdict(Tally)
    for folder in options.sets:
        for image in tqdm(bin_images(folder, SPLIT, model, options.every), unit="image", desc=folder.name):
            for name in options.methods:
                found = _found(name, model, fitted[name], image)
                counted = Tally.of(image, found)
                for group in (folder.name, f"{folder.name}: {image.part.name}"):
                    tallies[group, name].extend(counted)
    rows = [tally.row(*key, CONFIG.accepted) for key, tally in tallies.items()]
    total = [row for row in rows if ":" not in row["bins"]]
    print_table("Whole-bin detection", total)
    print_table("By object", [row for row in rows if ":" in row["bins"]])
    curves = {}
    for name in options.methods:
        parts = [tallies[folder.name, name] for folder in options.sets]
        probability = np.concatenate([tally.probability for tally in parts])
        right = np.concatenate([tally.right for tally in parts]).astype(bool)
        curves[name] = reliability_table(probability, right)
        print_table(f"Reliability of {name}", curves[name])
    results = {"detection": rows, "reliability": curves}
    write_json(options.json, results)
    save_reliability(curves, options.picture)
    return results


def _fitted(name: str, options: Options) -> Probabilities:
    """Return the probabilities of a method. Raises InputError, which for FPFH says how they are made."""
    if name != "FPFH":
        return load_probabilities(options.calibration, EVIDENCE)
    path = options.fpfh_calibration
    made_by = f"python -m experiments.calibrate --method FPFH --output {path}, or leave FPFH out by --methods kmn_jax"
    if not path.exists():
        raise InputError(f"{path} has not been made yet: {made_by}")
    try:
        return load_probabilities(path, EVIDENCE)
    except InputError as problem:
        raise InputError(f"{problem}: {made_by}") from None


def _found(name: str, model: Model, fitted: Probabilities, image: BinImage) -> Detections:
    """Return what a method finds in an image."""
    if name != "FPFH":
        return detect(model, fitted, image.part, image.scene, 0, THOROUGH if "thorough" in name else CONFIG)
    on_device, clock = device_part(model, image.part), Clock()
    propose = partial(fpfh_poses, image.part, on_device, image.scene)
    candidates, warnings = explore(image.scene, image.part, propose, fitted.found, CONFIG, clock)
    given = on_device, image.scene, 0, CONFIG, CONFIG.search, clock
    candidates, choice, probability = choose_and_refine(candidates, fitted, *given)
    poses = detections(candidates, choice, probability, image.part, image.scene)
    return Detections(image.part.name, image.scene.unit, poses, clock.timing, None, warnings)


if __name__ == "__main__":
    call_in_place()
    try:
        run(tyro.cli(Options))
    except InputError as problem:
        sys.exit(f"error: {problem}")
