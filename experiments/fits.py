"""Models of which poses are right, fitted to poses of many objects, and how well they predict objects left out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.bins import THRESHOLD
from experiments.reliability_picture import reliability_table
from experiments.two_at_once import side_by_side
from kmn_jax.detection import (
    COMPANY,
    EVIDENCE,
    Calibration,
    DetectConfig,
    averaged,
    company,
    expected_calibration_error,
    fit_calibration,
    fit_logistic,
    in_company,
    keeps_order,
)
from kmn_jax.errors import InputError, require

_SCALE_RIDGE = 1e-4  # hardly any: it makes probabilities too modest


@dataclass(frozen=True)
class FitOptions:
    """How models are fitted."""

    folds: int = 5
    members: int = 3  # fits, whose mean is the model of refined poses by one error
    absent_weight: float = 3.0  # of refined poses of absent parts: real scenes hold much that is not the part
    reported_weight: float = 8.0  # of poses that detection reports: what is said of them is what users are told
    in_vain: float | None = None  # tell as if this share of the searches was in vain; none: as many as there were

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        require(self.in_vain is None or 0 < self.in_vain < 1, f"in_vain = {self.in_vain} must be between 0 and 1")


def by_largest_error(poses: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return poses that are right if all of their points are."""
    return poses | {"error": poses["largest_error"]}


def told(poses: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return those poses of which it is known whether they are right."""
    known = ~np.isnan(poses["error"])
    return {column: values[known] for column, values in poses.items()}


def held_out_models(
    poses: dict[str, np.ndarray], options: FitOptions
) -> list[tuple[Int[np.ndarray, " o"], Calibration]]:
    """Return each object once, with others, and the model that is fitted to the poses of all but these."""

    def of_others(own: Int[np.ndarray, " o"]) -> Calibration:
        others = ~np.isin(poses["object"], own)
        return model_of({column: values[others] for column, values in poses.items()}, options)

    folds = _folds(poses, options)
    return list(zip(folds, side_by_side(of_others, folds), strict=True))


def models_of_others(poses: dict[str, np.ndarray], options: FitOptions) -> dict[int, Calibration]:
    """Return for each object a model that is fitted to poses of others."""
    return {int(name): fitted for names, fitted in held_out_models(poses, options) for name in names}


def _folds(poses: dict[str, np.ndarray], options: FitOptions) -> list[Int[np.ndarray, " o"]]:
    """Return the objects of poses in groups, each of which has its turn as what is not fitted to."""
    names = np.unique(poses["object"])
    return [names[fold :: options.folds] for fold in range(min(options.folds, len(names)))]


def model_of(poses: dict[str, np.ndarray], options: FitOptions) -> Calibration:
    """Return the model that is fitted to those poses that are `told`, of one member if any is as it was found."""
    members = options.members if poses["refined"].all() else 1  # one is enough to choose what is refined
    poses = told(poses)
    right, weights = poses["error"] < THRESHOLD, weights_of(poses, options)
    return fit_calibration(poses["evidence"], right, EVIDENCE, weights, members=members)


def weights_of(poses: dict[str, np.ndarray], options: FitOptions) -> Float[np.ndarray, " s"]:
    """Return how much poses count: refined ones of absent parts, and what is reported, more, and all less of an object
    that has many.

    What objects, or families of parts, have in common is to be learned, not what those few are like that have most.
    """
    absent = ~np.isfinite(poses["error"])
    _, which, counts = np.unique(poses["object"], return_inverse=True, return_counts=True)
    weights = np.where(absent & poses["refined"], options.absent_weight, 1.0) / np.sqrt(counts[which])
    weights = np.where(poses["reported"], options.reported_weight, 1.0) * weights
    return weights * (len(weights) / max(weights.sum(), 1e-9))


class Predicted(NamedTuple):
    """A model, and what models of its kind say of the objects that they were not fitted to."""

    model: Calibration
    held_out: Float[np.ndarray, " s"]  # log odds of the poses by models that do not know their object


class Fitted(NamedTuple):
    """A model, and how well models predict the objects that they were not fitted to."""

    model: Calibration
    held_out: Float[np.ndarray, " s"]  # log odds, see `Predicted`
    results: dict[str, Any]


def predict(poses: dict[str, np.ndarray], options: FitOptions) -> Predicted:
    """Fit a model of evidence, and those that do not know an object. Of all poses it must be `told` if they are right.

    Scales are as they come.
    """
    held_out = np.zeros(len(poses["error"]))
    for names, others in held_out_models(poses, options):
        own = np.isin(poses["object"], names)
        held_out[own] = others.logit(poses["evidence"][own])
    return Predicted(model_of(poses, options), held_out)


def mean_of(*several: Predicted) -> Predicted:
    """Return the mean of what models of the same poses say."""
    return Predicted(averaged([one.model for one in several]), np.mean([one.held_out for one in several], axis=0))


def fit(poses: dict[str, np.ndarray], options: FitOptions, predicted: Predicted) -> Fitted:
    """Return what predicts poses, on the scale of what is right of those that detection reports, where some are these.

    They are then also what is judged, as if the share of searches that is asked for was in vain.
    """
    right, (model, held_out) = poses["error"] < THRESHOLD, predicted
    if not poses["reported"].any():
        return Fitted(model, held_out, _judged(poses, held_out, np.ones(len(right))))
    judged, told_of = _reported(poses), held_out[poses["reported"]]
    factor, offset = scale_of(judged, told_of, options)
    model, held_out = model.scaled(factor, offset), factor * held_out + offset
    return Fitted(model, held_out, _judged(judged, held_out[poses["reported"]], _as_asked(judged, options)))


def scale_of(
    reported: dict[str, np.ndarray], logits: Float[np.ndarray, " s"], options: FitOptions
) -> tuple[float, float]:
    """Return by which factor and offset log odds of reported poses are right as often as they say.

    Raises InputError if what they say is wrong.
    """
    right, counts = reported["error"] < THRESHOLD, _as_asked(reported, options)
    scale = fit_logistic(logits[:, None], right, ("logit",), _SCALE_RIDGE, weights=counts)
    if scale.weights[0] <= 0:
        raise InputError("poses are right no more often where models of other objects say so: give more bins")
    return scale.weights[0], scale.bias


def fit_together(poses: dict[str, np.ndarray], logits: Float[np.ndarray, " s"], options: FitOptions) -> Fitted:
    """Fit the model of what reported poses of one search say about each other, given the log odds of each.

    Judged are those that it leaves in the list. Raises InputError if poses are right less often the surer they are, or
    the best of them is.
    """
    logits, poses = logits[poses["reported"]], _reported(poses)
    right, narrowed, counts = poses["error"] < THRESHOLD, poses["narrowed"], _as_asked(poses, options)
    columns = np.zeros((len(logits), len(COMPANY)))
    for search in np.unique(poses["search"]):
        rows = poses["search"] == search
        columns[rows] = company(logits[rows])

    def of_company(rows: Bool[np.ndarray, " s"]) -> Calibration:
        model = fit_logistic(columns[rows], right[rows], COMPANY, _SCALE_RIDGE, weights=counts[rows])
        if not keeps_order(model):
            raise InputError(
                "poses of an image are right less often where they, or its best, are surer: give more bins"
            )
        return model

    held_out = np.zeros(len(logits))
    for names in _folds(poses, options):
        own = np.isin(poses["object"], names)
        held_out[own] = in_company(columns[own], of_company(~own), narrowed[own])
    listed = 1 / (1 + np.exp(-held_out)) >= DetectConfig().reported
    judged = {name: values[listed] for name, values in poses.items()}
    return Fitted(
        of_company(np.ones(len(right), dtype=bool)), held_out, _judged(judged, held_out[listed], counts[listed])
    )


def _reported(poses: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: values[poses["reported"]] for name, values in poses.items()}


def _as_asked(poses: dict[str, np.ndarray], options: FitOptions) -> Float[np.ndarray, " s"]:
    """Return how much reported poses count, for the share of searches in vain, among those with any, that is told."""
    absent = ~np.isfinite(poses["error"])
    in_vain, others = (len(np.unique(poses["search"][of])) for of in (absent, ~absent))
    if options.in_vain is None or not in_vain or not others:
        return np.ones(len(absent))
    return np.where(absent, options.in_vain / (1 - options.in_vain) * others / in_vain, 1.0)


def _judged(
    poses: dict[str, np.ndarray], logits: Float[np.ndarray, " s"], counts: Float[np.ndarray, " s"]
) -> dict[str, Any]:
    """Return how well log odds predict which poses are right, where some count as several."""
    right, there = poses["error"] < THRESHOLD, np.isfinite(poses["error"])
    probability = 1 / (1 + np.exp(-logits))
    accepted = probability >= DetectConfig().accepted
    present = accepted & there
    summary = {
        "objects": len(np.unique(poses["object"])),
        "poses": len(right),
        "right": float(right.mean()),
        "expected calibration error": expected_calibration_error(probability, right, weights=counts),
        "searched in vain": len(np.unique(poses["search"][~there])),
        "accepted there": int((accepted & ~there).sum()),
        "right among accepted": float(right[accepted].mean()) if accepted.any() else None,
        "right among accepted where the part is": float(right[present].mean()) if present.any() else None,
        "accepted among right": float(accepted[right].mean()),
    }
    return {"summary": summary, "reliability": reliability_table(probability, right, counts)}
