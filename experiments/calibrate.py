"""Fit the probabilities of detections: `python -m experiments.calibrate [MODEL.safetensors]`.

Poses are searched in the validation bins (`python -m experiments.build_data validation-bins`), whose objects the
network was not trained with, and with `--worlds` and `--known-worlds` in the whole scans of world bins; in every second
image also a part that is not there. Of the known worlds two thirds of the scans are given as clouds, half of these cut
out around the copies, as scans often come. A model of the evidence is fitted to whether they are right. Each
object's probabilities are also predicted by a model that was fitted without it, which gives the reliability that is
printed. The model of poses as they are found is fitted first: it chooses which of them are refined, here as in
detection. Of refined poses detection reports one for each place: the one that a third model holds for the most
probable, which is fitted to whether all points are in their places (MSSD), and not their mean (ADI). Models are too
sure of themselves about kinds of objects that they were not fitted to: so the scales of the refined poses' models are
fitted to what detection would report by models that do not know the kind. From the same poses, of scans of which is
known where parts are, a fourth model learns what poses of one scene say about each other.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Bool, Float, Int
from tqdm import tqdm

from experiments.bins import THRESHOLD, TrueImage, WorldImage, bin_images, world_images
from experiments.fpfh import fpfh_poses
from experiments.reliability_picture import reliability_table, save_reliability
from experiments.test_sets import SPLIT
from kmn_jax.detection import (
    COMPANY,
    EVIDENCE,
    TREE_SETTINGS,
    Calibration,
    Candidates,
    DetectConfig,
    DevicePart,
    Probabilities,
    Scene,
    SearchConfig,
    chosen,
    company,
    device_part,
    expected_calibration_error,
    fit_calibration,
    fit_logistic,
    load_lightgbm,
    make_scene,
    probabilities_bytes,
    refined_candidates,
    search_at,
    seeds_over,
    vouched,
)
from kmn_jax.errors import InputError
from kmn_jax.files import write_whole
from kmn_jax.io import Scan
from kmn_jax.models import Model, load_model, load_pretrained
from kmn_jax.objects import Part, model_digest
from kmn_jax.report import check_target, print_table, write_json

_LOOSE = DetectConfig(reported=0.03)  # refines more than detection does, so that the fit sees what is just refused
_SCALE_RIDGE = 1e-4  # hardly any: it makes probabilities too modest
_COLUMNS = ("evidence", "error", "largest_error", "object", "search", "narrowed", "refined", "reported")  # of fits
_MARGINS = (0.1, 0.4)  # diameters: so much of what is around copies is left in scans that are cut out
_KINDS = 100  # more than the families of parts in a folder of world bins
SHIPPED = Path(__file__).parent.parent / "kmn_jax" / "pretrained" / "small.calibration.json"


@dataclass(frozen=True)
class Options:
    """What to fit, on what, and where to write it."""

    model: Annotated[Path | None, tyro.conf.Positional] = None  # .safetensors; the released model unless given
    method: Literal["kmn_jax", "FPFH"] = "kmn_jax"
    bins: Path = Path("outputs/validation_bins")  # folder with datasets in BOP format
    worlds: Path | None = None  # folder of world bins to fit on, too: outputs/worlds/validation
    known_worlds: Path | None = None  # the same, of parts that the network was trained with: no scale is fitted to it
    every: int = 1  # use every so many images of `bins`
    folds: int = 5
    members: int = 3  # fits, whose mean is the model of refined poses
    absent_weight: float = 3.0  # of refined poses of absent parts: real scenes hold much that is not the part
    output: Path = SHIPPED  # the calibration
    candidates: Path | None = None  # .npz file to write the candidates to, or to read them from if it exists
    json: Path | None = None
    picture: Path | None = None  # .png file for the reliability diagram


class Search(NamedTuple):
    """One image and the part that is searched in it."""

    image: TrueImage
    part: Part  # the image's own, or its stranger
    on_device: DevicePart
    scene: Scene
    row: int  # of all searches
    number: int  # that searches of one object, or of one family of parts, share
    is_known: bool  # whether the network was trained with such parts

    def columns(self, found: Candidates) -> dict[str, np.ndarray]:
        """Return evidence, errors and object of poses; those of a part that is not there have no finite errors."""
        poses = self.scene.T_scene_camera @ found.T_camera_object[found.usable]
        errors = [
            errors.min(axis=1, initial=np.inf)
            for errors in (self.image.errors(poses), self.image.largest_errors(poses))
        ]
        if self.part is not self.image.part:
            errors = [np.full_like(error, np.inf) for error in errors]
        return {
            "evidence": found.evidence[found.usable],
            "error": errors[0],
            "largest_error": errors[1],
            "object": np.full(len(poses), self.number),
            "search": np.full(len(poses), self.row),
            "narrowed": np.full(len(poses), self.scene.is_narrowed),
            "T_camera_object": found.T_camera_object[found.usable],  # to try other evidence on
        }


def collect(options: Options, model: Model) -> dict[str, np.ndarray]:
    """Return evidence, outcome, object and search of all poses, and whether they are refined, and what is judged.

    Images are read twice, as they do not all fit into memory.
    """
    config = DetectConfig().search_of(model.config)
    proposed, parts = [], []
    for search in _searches(options, model):
        found = _proposed(search, model, config, options.method)
        parts.append(search.columns(found))
        proposed.append(_with_poses(found))
    poses = _joined(parts)
    none = np.zeros(len(poses["error"]), dtype=bool)
    poses |= {"refined": none, "reported": none}
    chooser = _model(poses, options)
    finer, parts = [], []
    for search, found in zip(_searches(options, model), proposed, strict=True):
        choice = chosen(found, chooser, search.on_device, _LOOSE)
        rows = np.flatnonzero(choice.kept | choice.contenders)
        if len(rows):
            refined = refined_candidates(search.on_device, search.scene, found, rows, 0, config)
            parts.append(search.columns(refined))
            finer.append((_without_crops(refined), search.on_device, search.number, search.is_known))
    fine = _joined(parts)
    fine["refined"] = np.ones(len(fine["error"]), dtype=bool)
    others, exact = (
        {name: fitted for names, fitted in held_out_models(rows, options) for name in names}
        for rows in (fine, by_largest_error(fine))
    )
    reported = [
        chosen(refined, others[number], on_device, DetectConfig(), exact[number]).kept[refined.usable] & (not is_known)
        for refined, on_device, number, is_known in finer
    ]
    return _joined([poses, fine | {"reported": np.concatenate(reported)}])


def by_largest_error(poses: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return poses that are right if all of their points are."""
    return poses | {"error": poses["largest_error"]}


def _joined(columns: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([part[name] for part in columns]) for name in columns[0]}


def _searches(options: Options, model: Model) -> Iterator[Search]:
    """Yield all images with their parts, and every second one with a part that is not there."""
    searches = count()
    for row, (number, image, scene, is_known) in enumerate(_images(options, model)):
        for part in (image.part, image.stranger if row % 2 == 0 else None):
            if part is not None:
                yield Search(image, part, device_part(model, part), scene, next(searches), number, is_known)


def _images(options: Options, model: Model) -> Iterator[tuple[int, TrueImage, Scene, bool]]:
    """Yield all images with their scenes.

    Also yield a number that those of one object share, or of one family of parts, and whether the network knows it.
    """
    folders = sorted(path for path in options.bins.glob("*") if (path / SPLIT).is_dir())
    if not folders:
        raise InputError(f"{options.bins} holds no datasets: python -m experiments.build_data validation-bins")
    for number, folder in enumerate(folders, start=1):
        for image in tqdm(bin_images(folder, SPLIT, model, options.every), unit="image", desc=folder.name):
            yield 1000 * number + image.key.scene_id, image, image.scene, False
    for number, world in enumerate((options.worlds, options.known_worlds)):
        if world is None:
            continue
        is_known = number == 1
        for row, found in enumerate(tqdm(world_images(world, model), unit="image", desc=f"worlds {world.name}")):
            with suppress(InputError):  # a scan without foreground, as of an empty table
                scene = make_scene(as_given(found, row) if is_known else found.scan, found.part.diameter)
                yield _KINDS * number + found.kind, found, scene, is_known


def as_given(image: WorldImage, row: int) -> Scan:
    """Return a scan as users may have it: as a depth image, as a cloud, or, if there are any, cut out around copies."""
    if row % 3 == 0:
        return image.scan
    cut = None
    if row % 3 == 2:
        cut = image.cloud(np.random.default_rng(row).uniform(*_MARGINS))
    return cut if cut is not None and len(cut.points) else image.cloud()


def _proposed(search: Search, model: Model, config: SearchConfig, method: str) -> Candidates:
    """Return the poses in crops around the seeds of a detection's first round."""
    rows = seeds_over(search.scene, search.scene.foreground, search.image.part)
    if method == "FPFH":
        return fpfh_poses(search.part, search.on_device, search.scene, rows)
    return search_at(model, search.on_device, search.scene, rows, 0, config)


def _with_poses(found: Candidates) -> Candidates:
    """Return the candidates of those crops that have any, or of the first: what the network says of crops is large."""
    crops = np.unique(found.crop[found.usable]) if found.usable.any() else np.arange(1)
    rows = np.isin(found.crop, crops)
    return Candidates(
        found.T_camera_object[rows],
        found.usable[rows],
        found.evidence[rows],
        found.num_inliers[rows],
        np.searchsorted(crops, found.crop[rows]),
        jax.tree.map(lambda leaf: np.asarray(leaf)[crops], found.found),
        found.seed_rows[crops],
    )


def _without_crops(found: Candidates) -> Candidates:
    """Return candidates that can be chosen among, but not refined."""
    return found._replace(found=jax.tree.map(lambda leaf: leaf[:0], found.found))


def held_out_models(
    poses: dict[str, np.ndarray], options: Options
) -> Iterator[tuple[Int[np.ndarray, " o"], Calibration]]:
    """Yield some objects, and the model that is fitted to the poses of all others, until each had its turn."""
    for own in _folds(poses, options):
        others = ~np.isin(poses["object"], own)
        yield own, _model({column: values[others] for column, values in poses.items()}, options)


def _folds(poses: dict[str, np.ndarray], options: Options) -> list[Int[np.ndarray, " o"]]:
    """Return the objects of poses in groups, each of which has its turn as what is not fitted to."""
    names = np.unique(poses["object"])
    return [names[fold :: options.folds] for fold in range(min(options.folds, len(names)))]


def _model(poses: dict[str, np.ndarray], options: Options) -> Calibration:
    members = options.members if poses["refined"].all() else 1  # one is enough to choose what is refined
    right, weights = poses["error"] < THRESHOLD, _weights(poses, options)
    return fit_calibration(poses["evidence"], right, EVIDENCE, weights, members=members)


def _weights(poses: dict[str, np.ndarray], options: Options) -> Float[np.ndarray, " s"]:
    """Return how much poses count: refined ones of absent parts more than others, and all less if an object has many.

    What objects, or families of parts, have in common is to be learned, not what those few are like that have most.
    """
    absent = ~np.isfinite(poses["error"])
    _, which, counts = np.unique(poses["object"], return_inverse=True, return_counts=True)
    weights = np.where(absent & poses["refined"], options.absent_weight, 1.0) / np.sqrt(counts[which])
    return weights * (len(weights) / max(weights.sum(), 1e-9))


class Fitted(NamedTuple):
    """A model, and how well models predict the objects that they were not fitted to."""

    model: Calibration
    held_out: Float[np.ndarray, " s"]  # log odds of the poses by models that do not know their object
    results: dict[str, Any]


def fit(poses: dict[str, np.ndarray], options: Options) -> Fitted:
    """Fit a model of evidence.

    Where some poses are those that detection reports, the scale of the model is fitted to them, as models of other
    objects predict them, and they are what is judged.
    """
    right = poses["error"] < THRESHOLD
    held_out = np.zeros(len(right))
    for names, others in held_out_models(poses, options):
        own = np.isin(poses["object"], names)
        held_out[own] = others.logit(poses["evidence"][own])
    model = _model(poses, options)
    judged = np.ones_like(right)
    if poses["reported"].any():
        judged = poses["reported"]
        scale = fit_logistic(held_out[judged, None], right[judged], ("logit",), _SCALE_RIDGE)
        if scale.weights[0] <= 0:
            raise InputError("poses are right no more often where models of other objects say so: give more bins")
        model, held_out = model.scaled(scale.weights[0], scale.bias), scale.weights[0] * held_out + scale.bias
    return Fitted(model, held_out, _judged({name: values[judged] for name, values in poses.items()}, held_out[judged]))


def fit_together(poses: dict[str, np.ndarray], logits: Float[np.ndarray, " s"], options: Options) -> Fitted:
    """Fit the model of what reported poses of one narrowed search say about each other, given the log odds of each.

    What is judged are all reported poses, of which those of other searches, and those that are alone, keep their odds.
    Raises InputError if no two poses are reported of one such search.
    """
    logits = logits[poses["reported"]]
    poses = {name: values[poses["reported"]] for name, values in poses.items()}
    right, columns, together = poses["error"] < THRESHOLD, np.zeros((len(logits), 2)), poses["narrowed"].copy()
    for search in np.unique(poses["search"]):
        rows = np.flatnonzero(poses["search"] == search)
        columns[rows] = company(logits[rows])
        together[rows] &= len(rows) > 1
    if not together.any():
        raise InputError("in no image of the bins are two poses reported: give more bins")

    def model_of(rows: Bool[np.ndarray, " s"]) -> Calibration:
        return fit_logistic(columns[rows], right[rows], COMPANY, _SCALE_RIDGE)

    held_out = logits.copy()
    for names in _folds(poses, options):
        own = together & np.isin(poses["object"], names)
        if own.any():
            others = model_of(together & ~own)
            for search in np.unique(poses["search"][own]):
                rows = np.flatnonzero(poses["search"] == search)
                held_out[rows] = vouched(logits[rows], others)
    return Fitted(model_of(together), held_out, _judged(poses, held_out))


def _judged(poses: dict[str, np.ndarray], logits: Float[np.ndarray, " s"]) -> dict[str, Any]:
    """Return how well log odds predict which poses are right."""
    right, there = poses["error"] < THRESHOLD, np.isfinite(poses["error"])
    probability = 1 / (1 + np.exp(-logits))
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
    return {"summary": summary, "reliability": reliability_table(probability, right)}


def _made_of(options: Options, model: Model) -> str:
    """Say what candidates are made of."""
    folders = [str(folder) for folder in (options.bins, options.worlds, options.known_worlds)]
    settings = DetectConfig().search_of(model.config)
    fits = options.folds, options.members, options.absent_weight, TREE_SETTINGS  # which decide what is reported
    return repr((options.method, folders, options.every, fits, model_digest(model), EVIDENCE, settings, _MARGINS))


def calibrate(options: Options) -> dict[str, Any]:
    """Fit, write and print. Raises InputError if there is nothing to fit to."""
    for target in (options.json, options.picture):
        check_target(target)
    load_lightgbm()  # before an hour of searching, not after
    network = load_pretrained() if options.model is None else load_model(options.model)
    made_of = _made_of(options, network)
    if options.candidates is not None and options.candidates.exists():
        with np.load(options.candidates) as stored:
            poses = dict(stored)
        if str(poses.pop("made_of", "")) != made_of or not set(_COLUMNS) <= set(poses):
            raise InputError(f"{options.candidates} holds poses of other bins, weights or settings: remove it")
        poses = {name: poses[name] for name in _COLUMNS}
    else:
        poses = collect(options, network)
        if options.candidates is not None:
            np.savez(options.candidates, allow_pickle=False, made_of=np.array(made_of), **poses)
    refined = {column: values[poses["refined"]] for column, values in poses.items()}
    found = {column: values[~poses["refined"]] for column, values in poses.items()}
    fitted = {
        name: fit(rows, options)
        for name, rows in (("found", found), ("refined", refined), ("exact", by_largest_error(refined)))
    }
    fitted["together"] = fit_together(refined, fitted["refined"].held_out, options)
    results = {name: one.results for name, one in fitted.items()}
    for name, result in results.items():
        print_table(f"Reliability of poses as {name}, of objects that were not fitted to", result["reliability"])
        print_table(f"Poses as {name}", [result["summary"]])
    probabilities = Probabilities(**{name: one.model for name, one in fitted.items()})
    write_whole(options.output, probabilities_bytes(probabilities))
    write_json(options.json, results)
    save_reliability({f"poses as {name}": found["reliability"] for name, found in results.items()}, options.picture)
    return results


if __name__ == "__main__":
    try:
        calibrate(tyro.cli(Options))
    except InputError as problem:
        sys.exit(f"error: {problem}")
