"""Whole bins from a scan to ranked poses by the released network: seconds warm, by stage, and the first time.

python -m benchmarks.detection [--folders outputs/test_sets/electronics ...] [--fewest 20] [--json FILE]

Each image of a BOP dataset is searched as a depth image that nobody has searched before, nothing of it is kept between
repeats: once as it is, and once with the inside of the bin as foreground, as with an empty bin for background.
"""

from __future__ import annotations

import time
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.command import run
from experiments.bins import bin_images
from kmn_jax.detection import PoseEstimator, Scene
from kmn_jax.errors import InputError
from kmn_jax.geometry import measured_points
from kmn_jax.io import Scan
from kmn_jax.objects import Part
from kmn_jax.programs import call_in_place
from kmn_jax.released import RELEASED
from kmn_jax.report import print_table, write_json


def main(
    folders: tuple[Path, ...] = (Path("experiments/assets/small_test_set"),),
    split: str = "test",
    fewest: int = 8,
    repeats: int = 3,
    cards: Path | None = None,
    weights: str = RELEASED,
    json: Path | None = None,
) -> None:
    """Time all images.

    Args:
        folders: datasets in BOP format, with a bin in each image.
        split: the datasets' part to read.
        fewest: copies in a bin; bins of fewer are left out.
        repeats: timed searches of each, after a first one.
        cards: a folder for each dataset with cards of its objects, made by `kmn prepare`, where Open3D is missing.
        weights: released network, or a .safetensors file.
        json: where results go.
    """
    estimator = PoseEstimator.from_pretrained(weights)
    rows = []
    opened = []
    for folder in folders:
        images = bin_images(folder, split, estimator.model, cards=cards and cards / folder.name)
        opened.append((folder, chain(list(islice(images, 1)), images)))  # its first, which tells what is wrong with it
    for folder, images in opened:
        for image in tqdm(images, unit="image", desc=folder.name):
            if len(image.truth) < fewest:
                continue
            scene = image.scene
            scan = Scan(measured_points(scene.depth, scene.camera), None, scene.depth, scene.camera, "mm")
            for name, given in (("whole scan", scan), ("inside of the bin", image.scene)):
                facts = {"bins": folder.name, "foreground": name, "copies": len(image.truth)}
                rows.append(facts | _row(estimator, image.part, given, repeats))
    if not rows:
        raise InputError(f"no image of {', '.join(map(str, folders))} has {fewest} copies: choose a smaller --fewest")
    print_table("Whole bins", rows)
    write_json(json, {"bins": rows})


def _row(estimator: PoseEstimator, part: Part, given: Scan | Scene, repeats: int) -> dict[str, Any]:
    seconds, stages = [], []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        found = estimator.detect(part, given)
        seconds.append(time.perf_counter() - start)
        stages.append(found.timing.stages)
    likely = sum(pose.probability >= estimator.config.accepted for pose in found.poses)
    names = [name for name in stages[-1] if name != "report"]
    return {
        "part": part.name,
        "found": likely,
        "first s": seconds[0],
        "warm s": float(np.median(seconds[1:])),
        **{name: float(np.median([one[name] for one in stages[1:]])) for name in names},
    }


if __name__ == "__main__":
    call_in_place()
    run(main)
