"""How well a network tells the seed's instance and its keypoints: `python -m experiments.evaluate_network`.

Loss, segmentation accuracy and keypoint accuracy on training, validation and test objects, and for each test object:
the published Tables I and II beside ours. Training and validation crops are those of a pack, without noise; test crops
are of ray-cast depth images of objects that were never trained on: with what is around the parts, without the bin, and
as published, which is without the bin and of 20 keypoints, even if the network was trained with more.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from experiments.made_data import require_made
from kmn_jax.bop import NAMES_FILE
from kmn_jax.data import CropConfig, DevicePack, Pack, PipelineConfig, SampleBatches, stack_pack
from kmn_jax.errors import InputError
from kmn_jax.geometry import SmoothConfig
from kmn_jax.models import PRETRAINED, LossConfig, Model, load_model
from kmn_jax.released import RELEASED
from kmn_jax.report import check_target, print_table, write_json
from kmn_jax.train import (
    ExampleConfig,
    Samples,
    StepConfig,
    Sums,
    data_mesh,
    index_of,
    jit_eval_step,
    mean_metrics,
    put_batch,
    put_whole,
    rendered_frames,
    total_sums,
)

SHIPPED = PRETRAINED / f"{RELEASED}.safetensors"
_PUBLISHED_KEYPOINTS = 20
_TEST_SETS = (Path("outputs/test_sets/electronics"), Path("outputs/test_sets/industrial"))

# arXiv 2303.16102, Table I: the test split of the electronic components, trained on all objects or on a tenth of them.
PUBLISHED = (
    {"split": "published: test", "loss": 1.56, "segmentation": 0.95, "keypoints": 0.27},
    {"split": "published: test, a tenth of the objects", "loss": 1.65, "segmentation": 0.94, "keypoints": 0.24},
)


@dataclass(frozen=True)
class Options:
    """What is evaluated, on how much."""

    model: tyro.conf.Positional[Path] = SHIPPED  # a file of weights, or the folder of a run
    pack: Path = Path(
        "outputs/packs/electronics"
    )  # of training and validation objects; none if there is no such folder
    training_objects: int = 200  # spread evenly over the pack's
    crops: int = 20  # of each training and validation object
    test_sets: tuple[Path, ...] = _TEST_SETS  # BOP datasets with a split `test`
    crops_a_frame: int = 5  # of each test image
    json: Path | None = None  # file to write the numbers to


class Evaluator:
    """One network, compiled once: sums of losses and accuracies of batches of one object's crops each."""

    def __init__(self, model: Model, crops: CropConfig, loss: LossConfig, crops_at_once: int | None) -> None:
        self.network, self._loss = model.config, loss
        self.examples = ExampleConfig(crops=crops).plain()
        self._graphdef, self._at_once = model.graphdef, crops_at_once
        self._mesh = data_mesh(jax.devices()[:1])
        self._parameters = put_whole(model.parameters, self._mesh)

    def rows(self, pack: DevicePack, names: Sequence[str], batches: Iterator[Samples]) -> dict[str, Sums]:
        """Return the sums of each object. Every batch holds crops of one of them."""
        pack = put_whole(pack, self._mesh)
        found: dict[str, list[Sums]] = {name: [] for name in names}
        for samples in batches:
            index = index_of(samples)
            config = StepConfig(self.network, self.examples, self._loss, len(index.object), self._at_once, 0.0, 0)
            step = jit_eval_step(self._graphdef, config, self._mesh)
            sums = step(self._parameters, pack, put_batch(samples, self._mesh))
            found[names[int(index.object[0])]].append(jax.device_get(sums))
        return {name: total_sums(parts) for name, parts in found.items() if parts}


def pack_rows(evaluator: Evaluator, folder: Path, split: str, most: int | None, crops: int) -> dict[str, Sums]:
    """Evaluate a split of a pack, or so many of its objects, spread evenly."""
    pack = Pack(folder)
    names = pack.names(split)
    count = min(most or len(names), len(names))
    stacked = stack_pack(pack, [names[row * len(names) // count] for row in range(count)])
    pipeline = PipelineConfig(batch_size=crops, crops_per_object=crops, samples_per_object=crops)
    batches = SampleBatches(pipeline, count, np.asarray(stacked.arrays.num_drops), ordered=True)
    return evaluator.rows(stacked.arrays, stacked.names, (batches[number] for number in range(len(batches))))


def test_rows(evaluator: Evaluator, folder: Path, crops: int, with_bin: bool) -> dict[str, Sums]:
    """Evaluate the test images of a BOP dataset, with or without the points that are on no part."""
    shown = replace(evaluator.examples.crops, include_bin=with_bin)
    frames = rendered_frames(folder, "test", evaluator.network, shown, report)
    pipeline = PipelineConfig(batch_size=crops, crops_per_object=crops, samples_per_object=crops)
    batches = SampleBatches(pipeline, frames.num_frames, 1, ordered=True)
    path = folder / "models" / NAMES_FILE
    names = {f"{int(key):06d}": name for key, name in json.loads(path.read_text()).items()} if path.exists() else {}
    read = (frames.read(batches[number]) for number in range(len(batches)))
    return evaluator.rows(frames.pack, [names.get(name, name) for name in frames.names], read)


def row(name: str, sums: Sums, objects: int = 1) -> dict[str, Any]:
    """Return a row of the table."""
    means = mean_metrics(sums)
    return {
        "split": name,
        "objects": objects,
        "crops": int(sums.num_crops),
        "loss": float(means.loss),
        "segmentation": float(means.segmentation_accuracy),
        "keypoints": float(means.keypoint_accuracy),
    }


def report(problem: str) -> None:
    """Tell what was left out."""
    print(f"left out: {problem}", file=sys.stderr)


def evaluate(options: Options) -> dict[str, Any]:
    """Evaluate, print the tables, and return them with what they were made by."""
    check_target(options.json)
    path = options.model / "model.safetensors" if options.model.is_dir() else options.model
    digest = _digest(path)
    model = load_model(path)
    if _digest(path) != digest:
        raise InputError(f"{path} changed while it was read: evaluate it again")
    crops, loss = _settings(path.parent / "config.json", model)
    at_once = 1 if jax.default_backend() == "cpu" else None
    evaluator, published = (Evaluator(one, crops, loss, at_once) for one in (model, _of_published_keypoints(model)))
    splits: list[dict[str, Any]] = []
    details: dict[str, list[dict[str, Any]]] = {}
    if not options.pack.exists() and not options.test_sets:
        raise InputError(f"there is nothing to evaluate on: {options.pack} does not exist, and no test sets are given")
    if options.pack.exists():
        for split, most in (("train", options.training_objects), ("validation", None), ("test", None)):
            if not Pack(options.pack).names(split):
                continue
            found = pack_rows(evaluator, options.pack, split, most, options.crops)
            splits.append(
                row(f"{split}, {options.pack.name}, training renderer", total_sums(list(found.values())), len(found))
            )
    for folder in options.test_sets:
        for title, by, with_bin in _kinds_of_crops(evaluator, published):
            found = test_rows(by, folder, options.crops_a_frame, with_bin)
            splits.append(row(f"test, {folder.name}, {title}", total_sums(list(found.values())), len(found)))
            details.setdefault(folder.name, [row(name, sums) for name, sums in found.items()])
    print_table("Loss and accuracies (Table I)", [*splits, *PUBLISHED])
    for name, rows in details.items():
        print_table(f"Each test object of {name} (Table II)", rows)
    return {
        "model": path.name,
        "sha256": digest,
        "options": {key: str(value) for key, value in asdict(options).items()},
        "splits": splits,
        "published": PUBLISHED,
        "objects": details,
    }


def _of_published_keypoints(model: Model) -> Model:
    """Return a network for as many keypoints as published, if it was made for more and has no parameters for each."""
    config = model.config
    if config.num_keypoints <= _PUBLISHED_KEYPOINTS or config.object_branch == "learned":
        return model
    return model.under(replace(config, num_keypoints=_PUBLISHED_KEYPOINTS))


def _kinds_of_crops(evaluator: Evaluator, published: Evaluator) -> Iterator[tuple[str, Evaluator, bool]]:
    """Yield how test crops are made: a title, the network, and whether they have points that are on no part."""
    yield "ray casting", evaluator, True
    yield "ray casting, without the bin", evaluator, False
    if published.network != evaluator.network:
        yield f"ray casting, without the bin, {published.network.num_keypoints} keypoints", published, False


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None


def _settings(path: Path, model: Model) -> tuple[CropConfig, LossConfig]:
    """Return the crops and the loss that a network was trained with: those of its run's config, else the usual ones.

    Without faults of a sensor, as images have those of their own.
    """
    if not path.exists():
        return CropConfig(num_points=model.config.num_scene_points), LossConfig()
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
        crops = config["examples"]["crops"] | {"faults": None}
        smooth = None if crops.get("smooth") is None else SmoothConfig(**crops["smooth"])
        return CropConfig(**crops | {"smooth": smooth}), LossConfig(**config["loss"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is not the config of a run ({error}): give the file of weights itself") from None


def main(arguments: list[str] | None = None) -> int:
    """Evaluate a network: 0 is success, 2 bad input, in one sentence on stderr."""
    try:
        options = tyro.cli(Options, args=arguments, prog="experiments.evaluate_network", description=__doc__)
        require_made(*options.test_sets)
        results = evaluate(options)
        write_json(options.json, results)
    except InputError as error:
        print(f"evaluate_network: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
