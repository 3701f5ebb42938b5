"""Fit the probabilities of detections: `python -m experiments.calibrate [MODEL.safetensors]`.

Poses are searched in the validation bins (`python -m experiments.build_data validation-bins`), whose objects the
network was not trained with, and with `--worlds` in the whole scans of world bins; in every second one also a part that
is not there. A small model of the evidence is fitted to whether they are right. Each object's probabilities are also
predicted by a model that was fitted without it, which gives the reliability that is printed. The model of poses as
they are found is fitted first: it chooses which of them are refined, here as in detection. Of refined poses detection
reports one for each place. Models are too sure of themselves about kinds of objects that they were not fitted to: so
the scale of the refined poses' model is fitted to what detection would report by models that do not know the kind.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import tyro
from jaxtyping import Float, Int
from tqdm import tqdm

from experiments.bins import THRESHOLD, TrueImage, bin_images, world_images
from experiments.fpfh import fpfh_poses
from experiments.reliability_picture import reliability_table, save_reliability
from experiments.test_sets import SPLIT
from kmn_jax.detection import (
    EVIDENCE,
    Calibration,
    Candidates,
    DetectConfig,
    DevicePart,
    Probabilities,
    Scene,
    SearchConfig,
    chosen,
    device_part,
    expected_calibration_error,
    fit_calibration,
    make_scene,
    probabilities_bytes,
    refined_candidates,
    search_at,
    seeds_over,
)
from kmn_jax.errors import InputError
from kmn_jax.files import write_whole
from kmn_jax.models import Model, load_model, load_pretrained
from kmn_jax.objects import Part
from kmn_jax.report import check_target, print_table, write_json

_LOOSE = DetectConfig(reported=0.03)  # refines more than detection does, so that the fit sees what is just refused
SHIPPED = Path(__file__).parent.parent / "kmn_jax" / "pretrained" / "small.calibration.json"


@dataclass(frozen=True)
class Options:
    """What to fit, on what, and where to write it."""

    model: Annotated[Path | None, tyro.conf.Positional] = None  # .safetensors; the released model unless given
    method: Literal["kmn_jax", "FPFH"] = "kmn_jax"
    bins: Path = Path("outputs/validation_bins")  # folder with datasets in BOP format
    worlds: Path | None = None  # folder of world bins to fit on, too: outputs/worlds/validation
    every: int = 1  # use every so many images of `bins`
    folds: int = 5
    absent_weight: float = 3.0  # of refined poses of absent parts: real scenes hold much that is not the part
    output: Path = SHIPPED  # the calibration
    candidates: Path | None = None  # .npz file to write the candidates to, or to read them from if it exists
    json: Path | None = None
    picture: Path | None = None  # .png file for the reliability diagram


class Search(NamedTuple):
    """What was found of one part in one image."""

    image: TrueImage
    part: Part  # the image's own, or its stranger
    on_device: DevicePart
    scene: Scene
    number: int  # that searches of one object, or of one family of parts, share
    found: Candidates

    def columns(self, found: Candidates) -> dict[str, np.ndarray]:
        """Return evidence, error and object of poses; those of a part that is not there have no finite error."""
        error = self.image.errors(found.T_camera_object[found.usable]).min(axis=1, initial=np.inf)
        return {
            "evidence": found.evidence[found.usable],
            "error": error if self.part is self.image.part else np.full_like(error, np.inf),
            "object": np.full(len(error), self.number),
        }


def collect(options: Options) -> dict[str, np.ndarray]:
    """Return evidence, outcome and object of all poses, and whether they are refined."""
    model = load_pretrained() if options.model is None else load_model(options.model)
    config = DetectConfig().search_of(model.config)
    searches = list(_searches(options, model, config))
    found = _joined([search.columns(search.found) for search in searches])
    chooser = fit_calibration(found["evidence"], found["error"] < THRESHOLD, EVIDENCE)
    pairs = [
        (search, refined)
        for search in tqdm(searches, unit="search", desc="refinement")
        if (refined := _refined(search, chooser, config)) is not None
    ]
    fine = _joined([search.columns(refined) for search, refined in pairs])
    fine["refined"] = np.ones(len(fine["error"]), dtype=bool)
    others = {name: fitted for names, fitted in held_out_models(fine, options) for name in names}
    kept = []
    for search, refined in pairs:
        choice = chosen(refined, others[search.number], search.on_device, DetectConfig())
        kept.append(choice.kept[refined.usable])
    none = np.zeros(len(found["error"]), dtype=bool)
    found |= {"refined": none, "reported": none}
    return _joined([found, fine | {"reported": np.concatenate(kept)}])


def _joined(columns: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([part[name] for part in columns]) for name in columns[0]}


def _searches(options: Options, model: Model, config: SearchConfig) -> Iterator[Search]:
    """Search all images for their parts, and every second one for a part that is not there."""
    for count, (number, image, scene) in enumerate(_images(options, model)):
        rows = seeds_over(scene, scene.foreground, image.part)
        for part in (image.part, image.stranger if count % 2 == 0 else None):
            if part is None:
                continue
            on_device = device_part(model, part)
            if options.method == "FPFH":
                found = fpfh_poses(part, on_device, scene, rows)
            else:
                found = search_at(model, on_device, scene, rows, 0, config)
            yield Search(image, part, on_device, scene, number, found)


def _images(options: Options, model: Model) -> Iterator[tuple[int, TrueImage, Scene]]:
    """Yield all images with their scenes, and a number that those of one object share, or of one family of parts."""
    folders = sorted(path for path in options.bins.glob("*") if (path / SPLIT).is_dir())
    if not folders:
        raise InputError(f"{options.bins} holds no datasets: python -m experiments.build_data validation-bins")
    for number, folder in enumerate(folders, start=1):
        for image in tqdm(bin_images(folder, SPLIT, model, options.every), unit="image", desc=folder.name):
            yield 1000 * number + image.key.scene_id, image, image.scene
    if options.worlds is not None:
        for found in tqdm(world_images(options.worlds, model), unit="image", desc="worlds"):
            with suppress(InputError):  # a scan without foreground, as of an empty table
                yield found.kind, found, make_scene(found.scan, found.part.diameter)


def _refined(search: Search, chooser: Calibration, config: SearchConfig) -> Candidates | None:
    """Return the refined forms of what a model chooses among the poses of a search; None if it chooses nothing."""
    choice = chosen(search.found, chooser, search.on_device, _LOOSE)
    rows = np.flatnonzero(choice.kept | choice.contenders)
    return refined_candidates(search.on_device, search.scene, search.found, rows, 0, config) if len(rows) else None


def held_out_models(
    poses: dict[str, np.ndarray], options: Options
) -> Iterator[tuple[Int[np.ndarray, " o"], Calibration]]:
    """Yield some objects, and the model that is fitted to the poses of all others, until each had its turn."""
    names = np.unique(poses["object"])
    for fold in range(options.folds):
        own = names[fold :: options.folds]
        others = ~np.isin(poses["object"], own)
        if len(own):
            yield own, _model({column: values[others] for column, values in poses.items()}, options)


def _model(poses: dict[str, np.ndarray], options: Options) -> Calibration:
    return fit_calibration(poses["evidence"], poses["error"] < THRESHOLD, EVIDENCE, _weights(poses, options))


def _weights(poses: dict[str, np.ndarray], options: Options) -> Float[np.ndarray, " s"]:
    """Return how much poses count: refined ones of absent parts more than others."""
    absent = ~np.isfinite(poses["error"])
    return np.where(absent & poses["refined"], options.absent_weight, 1.0)


def fit(poses: dict[str, np.ndarray], options: Options) -> tuple[Calibration, dict[str, Any]]:
    """Return the model of all poses, and how well models predict the objects that they were not fitted to.

    Where some poses are those that detection reports, the scale of the model is fitted to them, as models of other
    objects predict them, and they are what is judged.
    """
    right, there = poses["error"] < THRESHOLD, np.isfinite(poses["error"])
    held_out = np.zeros(len(right))
    for names, others in held_out_models(poses, options):
        own = np.isin(poses["object"], names)
        held_out[own] = others.logit(poses["evidence"][own])
    model = _model(poses, options)
    judged = np.ones_like(right)
    if poses["reported"].any():
        judged = poses["reported"]
        scale = fit_calibration(held_out[judged, None], right[judged], ("logit",), hidden_units=0)
        model, held_out = model.scaled(scale.weights[0], scale.bias), scale.weights[0] * held_out + scale.bias
    probability, right, there = 1 / (1 + np.exp(-held_out[judged])), right[judged], there[judged]
    accepted = probability >= DetectConfig().accepted
    present = accepted & there
    summary = {
        "objects": len(np.unique(poses["object"])),
        "poses": len(right),
        "right": float(right.mean()),
        "expected calibration error": expected_calibration_error(probability, right),
        "right among accepted": float(right[accepted].mean()) if accepted.any() else None,
        "right among accepted where the part is": float(right[present].mean()) if present.any() else None,
        "accepted among right": float(accepted[right].mean()),
    }
    return model, {"summary": summary, "reliability": reliability_table(probability, right)}


def calibrate(options: Options) -> dict[str, Any]:
    """Fit, write and print. Raises InputError if there is nothing to fit to."""
    for target in (options.json, options.picture):
        check_target(target)
    if options.candidates is not None and options.candidates.exists():
        with np.load(options.candidates) as stored:
            poses = dict(stored)
        if poses["evidence"].shape[1] != len(EVIDENCE):
            raise InputError(f"{options.candidates} holds other evidence than is gathered now: remove it")
    else:
        poses = collect(options)
        if options.candidates is not None:
            np.savez(options.candidates, allow_pickle=False, **poses)
    models, results = [], {}
    for name, own in (("found", ~poses["refined"]), ("refined", poses["refined"])):
        model, results[name] = fit({column: values[own] for column, values in poses.items()}, options)
        models.append(model)
        print_table(f"Reliability of poses as {name}, of objects that were not fitted to", results[name]["reliability"])
        print_table(f"Poses as {name}", [results[name]["summary"]])
    write_whole(options.output, probabilities_bytes(Probabilities(*models)))
    write_json(options.json, results)
    save_reliability({f"poses as {name}": found["reliability"] for name, found in results.items()}, options.picture)
    return results


if __name__ == "__main__":
    try:
        calibrate(tyro.cli(Options))
    except InputError as problem:
        sys.exit(f"error: {problem}")
