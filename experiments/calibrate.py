"""Fit the probabilities of detections: `python -m experiments.calibrate [MODEL.safetensors]`.

Poses are searched in the validation bins (`python -m experiments.build_data validation-bins`), whose objects the
network was not trained with; in some of them also a part that is not there. A logistic model of the evidence is fitted
to whether they are right. Each object's probabilities are also predicted by a model that was fitted without it, which
gives the reliability that is printed.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from tqdm import tqdm

from experiments.bins import THRESHOLD, bin_images
from experiments.fpfh import SOLVERS
from experiments.test_sets import SPLIT
from kmn_jax.checks import InputError
from kmn_jax.estimator.calibrate import (
    calibration_bytes,
    expected_calibration_error,
    fit_calibration,
    reliability,
)
from kmn_jax.estimator.candidates import (
    CandidateConfig,
    Candidates,
    Seeds,
    Solver,
    find_candidates,
    improved,
    join,
    seeds_over,
)
from kmn_jax.estimator.evidence import EVIDENCE
from kmn_jax.estimator.part import Part
from kmn_jax.estimator.scene import Scene
from kmn_jax.estimator.select import SelectConfig, select
from kmn_jax.files import write_whole
from kmn_jax.models import Model, load_model, load_pretrained
from kmn_jax.report import check_target, print_table, write_json

STRANGERS = 2  # in every so many images, a part that is not there is searched as well
SHIPPED = Path(__file__).parent.parent / "kmn_jax" / "pretrained" / "small.calibration.json"


@dataclass(frozen=True)
class Options:
    """What to fit, on what, and where to write it."""

    model: Annotated[Path | None, tyro.conf.Positional] = None  # .safetensors; the released model unless given
    method: Literal["kmn_jax", "FPFH"] = "kmn_jax"
    bins: Path = Path("outputs/validation_bins")  # folder with datasets in BOP format
    every: int = 1  # use every so many images
    folds: int = 5
    output: Path = SHIPPED  # the calibration
    candidates: Path | None = None  # .npz file to write the candidates to, or to read them from if it exists
    json: Path | None = None


def collect(options: Options) -> dict[str, np.ndarray]:
    """Return evidence, outcome and object of all candidates."""
    model = load_pretrained() if options.model is None else load_model(options.model)
    config = CandidateConfig()
    columns: dict[str, list[np.ndarray]] = {"evidence": [], "right": [], "object": [], "error": []}
    folders = sorted(path for path in options.bins.glob("*") if (path / SPLIT).is_dir())
    if not folders:
        raise InputError(f"{options.bins} holds no datasets: python -m experiments.build_data validation-bins")
    for number, folder in enumerate(folders):
        images = bin_images(folder, SPLIT, model, options.every)
        for row, image in enumerate(tqdm(images, unit="image", desc=folder.name)):
            seeds = seeds_over(image.scene, image.scene.foreground, image.part, config)
            parts = [image.part] if row % STRANGERS or image.stranger is None else [image.part, image.stranger]
            for part in parts:
                found = _candidates(model, part, image.scene, seeds, config, SOLVERS[options.method])
                error = image.errors(found.T_view_object[found.usable]).min(axis=1, initial=np.inf)
                if part is not image.part:
                    error = np.full_like(error, np.inf)
                columns["evidence"].append(found.evidence[found.usable])
                columns["error"].append(error)
                columns["right"].append(error < THRESHOLD)
                columns["object"].append(np.full(len(error), 1000 * number + image.key.scene_id))
    return {name: np.concatenate(parts) for name, parts in columns.items()}


def _candidates(
    model: Model, part: Part, scene: Scene, seeds: Seeds, config: CandidateConfig, solver: Solver | None
) -> Candidates:
    """Return the poses around seeds, and the improved forms of those that the depth image speaks for."""
    found = find_candidates(model, part, scene, seeds, 0, config, solver)
    explained, violated = (found.evidence[:, EVIDENCE.index(name)] for name in ("explained", "violated"))
    score = np.maximum(explained - violated, 0).astype(np.float64)
    chosen = select(found.T_view_object, score, found.usable & (score > 0), part, SelectConfig())
    rows = np.flatnonzero(chosen.kept)
    if not len(rows):
        return found
    return join([found, improved(model, part, scene, found, rows, 0, config)])


def calibrate(options: Options) -> dict[str, Any]:
    """Fit, write and print. Raises InputError if there is nothing to fit to."""
    check_target(options.json)
    if options.candidates is not None and options.candidates.exists():
        with np.load(options.candidates) as stored:
            found = dict(stored)
    else:
        found = collect(options)
        if options.candidates is not None:
            np.savez(options.candidates, allow_pickle=False, **found)
    evidence, right, objects = found["evidence"], found["right"].astype(bool), found["object"]
    held_out = np.zeros(len(right))
    names = np.unique(objects)
    for fold in range(options.folds):
        own = np.isin(objects, names[fold :: options.folds])
        held_out[own] = fit_calibration(evidence[~own], right[~own], EVIDENCE).probability(evidence[own])
    calibration = fit_calibration(evidence, right, EVIDENCE)
    write_whole(options.output, calibration_bytes(calibration))
    accepted = held_out >= 0.5
    table = [
        {"probability": mean, "share right": share, "candidates": count}
        for mean, share, count in reliability(held_out, right)
    ]
    summary = {
        "objects": len(names),
        "candidates": len(right),
        "right": float(right.mean()),
        "expected calibration error": expected_calibration_error(held_out, right),
        "right among accepted": float(right[accepted].mean()) if accepted.any() else None,
        "accepted among right": float(accepted[right].mean()),
    }
    weights = dict(zip(EVIDENCE, calibration.weights, strict=True)) | {"bias": calibration.bias}
    print_table("Reliability, of objects that were not fitted to", table)
    print_table("Summary", [summary])
    results = {"summary": summary, "reliability": table, "weights": weights}
    write_json(options.json, results)
    return results


if __name__ == "__main__":
    try:
        calibrate(tyro.cli(Options))
    except InputError as problem:
        sys.exit(f"error: {problem}")
