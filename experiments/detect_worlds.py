"""Detection in world bins, see `experiments/worlds.py`: `python -m experiments.detect_worlds`.

The whole scan is given and nothing else. A pose is right if its ADI to a copy is below a tenth of the diameter and no
more probable pose took that copy; recall counts the copies of which at least 30% is visible. In images without the
part, and with `--strangers` for parts of about the same size in all others where they cannot lie, whatever is accepted
is wrong. Ctrl+C ends it with the images so far.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from tqdm import tqdm

from experiments.bins import LEAST_VISIBLE, WorldImage, world_images
from experiments.calibrate import SHIPPED
from experiments.detect_bins import CONFIG, Tally
from experiments.reliability_picture import reliability_table, save_reliability
from experiments.worst_images import WorstImages
from kmn_jax.detection import (
    EVIDENCE,
    DetectConfig,
    Detections,
    Probabilities,
    Scene,
    Timing,
    detect,
    load_probabilities,
    make_scene,
)
from kmn_jax.errors import InputError
from kmn_jax.io import Scan
from kmn_jax.models import Model, load_model, load_pretrained
from kmn_jax.objects import Part
from kmn_jax.programs import call_in_place
from kmn_jax.report import check_target, print_table, write_json

_CERTAIN = 0.9
_LESS_PRECISE = 0.9
_STRANGERS = 2  # of an image, those that are nearest in size
_MARGIN = 0.2  # diameters, of cut-outs
_ALL = "all"
_BUT = ("time of flight", "touching rows")  # families with more than a millimetre of noise, and of one field of parts
_OTHERS = f"all but {' and '.join(_BUT)}"


@dataclass(frozen=True)
class Options:
    """What to detect by what."""

    folder: Path = Path("outputs/worlds/test")
    model: Path | None = None  # .safetensors; the released model unless given
    calibration: Path = SHIPPED
    every: int = 1  # use every so many images
    given: Literal["images", "clouds", "cut-outs"] = "images"  # cut-outs: clouds of what is near to copies alone
    strangers: bool = False  # also search images for parts that are known not to be there
    json: Path | None = None
    picture: Path | None = None  # .png file for the reliability diagrams
    worst: Path | None = None  # folder for pictures of the three worst images of each family


@dataclass
class WorldTally:
    """Counts over the images of a family of worlds."""

    found: Tally = field(default_factory=Tally)
    first_right: list[bool] = field(default_factory=list)  # of images with a visible copy
    absent: int = 0  # images that were searched for a part that is not there, ...
    wrong_where_absent: int = 0  # ... and what was accepted in them

    def add(self, image: WorldImage, found: Tally) -> None:
        """Count the poses of the part that an image was made for."""
        self.found.extend(found)
        if not len(image.truth):
            self._add_absent(found)
        elif (image.visible >= LEAST_VISIBLE).any():
            self.first_right.append(any(found.right[:1]))

    def add_stranger(self, found: Detections) -> None:
        """Count the poses of a part that is not there."""
        counted = Tally.of_absent([pose.probability for pose in found.poses])
        self.found.extend(counted)
        self._add_absent(counted)

    def _add_absent(self, found: Tally) -> None:
        self.absent += 1
        self.wrong_where_absent += sum(probability >= CONFIG.accepted for probability in found.probability)

    def row(self, name: str) -> dict[str, Any]:
        """Return the numbers."""
        row = self.found.row(name, "kmn_jax", CONFIG.accepted)
        del row["method"]
        probability, right = np.array(self.found.probability), np.array(self.found.right, dtype=bool)
        certain = probability >= _CERTAIN
        return row | {
            f"recall at precision {_LESS_PRECISE}": self.found.recall_at(_LESS_PRECISE),
            "first right": float(np.mean(self.first_right)) if self.first_right else None,
            f"right from {_CERTAIN} on": float(right[certain].mean()) if certain.any() else None,
            "searched in vain": self.absent,
            "accepted there": self.wrong_where_absent,
        }


def scan_of(image: WorldImage, given: Literal["images", "clouds", "cut-outs"]) -> Scan | None:
    """Return the scan of an image in a form, none if it has no point on a copy."""
    if given == "images":
        return image.scan
    scan = image.cloud(_MARGIN if given == "cut-outs" else None)
    return scan if len(scan.points) else None


def run(options: Options) -> dict[str, Any]:
    """Detect, print and return the numbers."""
    check_target(options.json, options.picture, options.worst and options.worst / "worst.png")
    model = load_pretrained() if options.model is None else load_model(options.model)
    fitted = load_probabilities(options.calibration, EVIDENCE)
    tallies: dict[str, WorldTally] = defaultdict(WorldTally)
    worst = WorstImages(CONFIG.accepted)
    stopped = True
    with suppress(KeyboardInterrupt):
        for image in tqdm(world_images(options.folder, model, options.every), unit="image"):
            scan = scan_of(image, options.given)
            if scan is None:
                continue
            scene, found = found_in(model, fitted, image.part, scan)
            counted = Tally.of(image, found)
            if options.worst is not None and scene is not None:
                worst.add(image, scene, found, counted)
            groups = [image.family, _ALL, *([] if image.family in _BUT else [_OTHERS])]
            for name in groups:
                tallies[name].add(image, counted)
            for stranger in image.strangers[:_STRANGERS] if options.strangers else ():
                _, found = found_in(model, fitted, stranger, scan)
                for name in groups:
                    tallies[name].add_stranger(found)
        stopped = False
    if _ALL not in tallies:
        raise InputError(f"no image of {options.folder} was searched: it holds none, or Ctrl+C came too soon")
    rows = [tally.row(name) for name, tally in tallies.items()]
    print_table("Detection in world bins", rows)
    curves = {
        name: reliability_table(np.array(tally.found.probability), np.array(tally.found.right, dtype=bool))
        for name, tally in tallies.items()
        if name != _OTHERS
    }
    print_table("Reliability over all", curves[_ALL])
    if stopped:
        print("stopped before the last image: families that come later are missing, also in what is told of all")
    results = {"detection": rows, "reliability": curves} | ({"stopped": True} if stopped else {})
    write_json(options.json, results)
    save_reliability(curves, options.picture)
    if options.worst is not None:
        for path in worst.save(options.worst):
            print(f"wrote {path}")
    return results


def found_in(
    model: Model, fitted: Probabilities, part: Part, scan: Scan, config: DetectConfig = CONFIG
) -> tuple[Scene | None, Detections]:
    """Return what is found in a whole scan; nothing where it is refused, as one that shows a plane alone."""
    try:
        scene = make_scene(scan, part.diameter)
    except InputError as error:
        return None, Detections(part.name, scan.unit, (), Timing({}, 0.0), str(error), ())
    return scene, detect(model, fitted, part, scene, 0, config)


if __name__ == "__main__":
    call_in_place()
    try:
        run(tyro.cli(Options))
    except InputError as problem:
        sys.exit(f"error: {problem}")
