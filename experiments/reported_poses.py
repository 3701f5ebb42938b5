"""Which refined poses detection would report, in images whose truth is known, by models that do not know the part."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float32, Int

from experiments.bins import THRESHOLD
from experiments.fits import FitOptions, by_largest_error, models_of_others, scale_of, told
from experiments.searches import Columns
from kmn_jax.detection import Calibration, Candidates, DetectConfig, DevicePart, averaged, chosen, in_unsure_places

CONFIG = DetectConfig()  # of the detection that probabilities are for


def with_reported(poses: Columns, searched: dict[int, DevicePart], fits: FitOptions) -> Columns:
    """Return poses with what detection refines and reports, by models that do not know the image's object.

    It is chosen twice: by models as they come, and by these on the scale of what was chosen, as detection's are; where
    all of that is right, or none, once.
    """
    none = np.zeros(len(poses["error"]), dtype=bool)  # it is not known yet, or that of other evidence
    fine = {name: values[poses["refined"]] for name, values in (poses | {"reported": none}).items()}
    of_mean, exact = (models_of_others(rows, fits) for rows in (fine, by_largest_error(fine)))
    models = {number: (averaged([of_mean[number], exact[number]]), exact[number]) for number in exact}
    first = poses | _chosen_of_all(poses, searched, models)
    told_of = told({name: values[first["reported"]] for name, values in first.items()})
    if len(np.unique(told_of["error"] < THRESHOLD)) < 2:
        return first
    logits = np.zeros(len(told_of["error"]))
    for number in np.unique(told_of["object"]):
        own = told_of["object"] == number
        logits[own] = models[int(number)][0].logit(told_of["evidence"][own])
    scale = scale_of(told_of, logits, fits)
    scaled = {number: (model.scaled(*scale), own_exact) for number, (model, own_exact) in models.items()}
    return poses | _chosen_of_all(poses, searched, scaled)


def _chosen_of_all(
    poses: Columns, searched: dict[int, DevicePart], models: dict[int, tuple[Calibration, Calibration]]
) -> Columns:
    """Return among which poses detection chooses, and which it reports, by models for each object."""
    due, reported = (np.zeros(len(poses["error"]), dtype=bool) for _ in range(2))
    for row, on_device in searched.items():
        rows = np.flatnonzero((poses["search"] == row) & (poses["turn"] >= 0))
        if len(rows):
            found = _choosable(poses["T_camera_object"][rows], poses["evidence"][rows])
            of_others = models[int(poses["object"][rows[0]])]
            reported[rows], due[rows] = _chosen_in_turns(found, poses["turn"][rows], *of_others, on_device)
    return {"due": due, "reported": reported}


def _chosen_in_turns(
    found: Candidates, turns: Int[np.ndarray, " s"], model: Calibration, exact: Calibration, on_device: DevicePart
) -> tuple[Bool[np.ndarray, " s"], Bool[np.ndarray, " s"]]:
    """Return which refined poses detection reports, and among which it chooses.

    Once some pose is sure, later turns come to places where one stands that is not. Poses say nothing of each other
    yet, so that turns come somewhat sooner; nor is known what would become of unsure ones that are refined once more.
    """

    def kept_of(rows: Bool[np.ndarray, " s"]) -> Bool[np.ndarray, " s"]:
        return np.asarray(chosen(found._replace(usable=rows), model, on_device, CONFIG, exact).kept)

    due = turns == 0
    kept = kept_of(due)
    for turn in range(1, 1 + turns.max()):
        sure = kept & (model.probability(found.evidence) >= CONFIG.sure)
        if not sure.any():
            break
        poses = found.T_camera_object
        more = (turns == turn) & in_unsure_places(poses, poses[kept & ~sure], poses[sure], on_device)
        if more.any():
            due |= more
            kept = kept_of(due)
    return kept, due


def _choosable(poses: Float32[np.ndarray, "s 4 4"], evidence: Float32[np.ndarray, "s f"]) -> Candidates:
    """Return candidates that can be chosen among, and nothing else."""
    none = np.zeros(len(poses), dtype=np.int32)
    return Candidates(poses, np.ones(len(poses), dtype=bool), evidence, none, none, cast(Any, None), none)
