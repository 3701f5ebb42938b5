"""Models of which poses are right, fitted to poses of which that is known: see `Calibration`."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from kmn_jax.detection._calibration import Calibration
from kmn_jax.errors import InputError, require, shown

_DEPTH = 4
# Numbers are chosen by how well kinds of objects are predicted that were not fitted to.
TREE_SETTINGS: dict[str, Any] = {
    "objective": "binary",
    "num_iterations": 300,
    "learning_rate": 0.05,
    "max_depth": _DEPTH,
    "num_leaves": 2**_DEPTH,
    "min_data_in_leaf": 40,
    "lambda_l2": 5.0,
    "feature_fraction_bynode": 0.4,  # of the columns, that each node may look at
    "extra_trees": True,  # a node's threshold is the best of one drawn for each column
    "deterministic": True,
    "force_col_wise": True,  # else what is quicker is tried out, and sums may be rounded otherwise
    "num_threads": 1,
    "verbose": -1,
}


def load_lightgbm() -> ModuleType:
    """Import lightgbm and return it. Raises InputError if a library of the system is missing."""
    try:
        return import_module("lightgbm")
    except OSError as error:
        raise InputError(
            f"lightgbm, which fits probabilities, cannot be loaded ({shown(error)}). If OpenMP is missing, run `sudo"
            " apt-get install libgomp1` on Debian, `brew install libomp` on macOS"
        ) from None


def fit_calibration(
    evidence: Float[np.ndarray, "s f"],
    right: Bool[np.ndarray, " s"],
    names: Sequence[str],
    weights: Float[np.ndarray, " s"] | None = None,
    members: int = 1,
) -> Calibration:
    """Fit trees to poses of which it is known whether they are right; `weights` count some as several.

    With several `members` the model is the mean of as many fits that draw otherwise: each errs in its own way about
    kinds of objects that it has not seen. Each has up to 300 trees: where none is left to be grown, fewer. The same
    arguments give the same model on one machine. Raises InputError if all are right or all are wrong, if numbers are
    not finite or weights not above zero, and if lightgbm lacks a library of the system.
    """
    lightgbm = load_lightgbm()
    _check(right)
    require(members >= 1, f"members = {members} must be 1 or more")
    counts = np.ones(len(right)) if weights is None else weights
    require(bool((np.isfinite(counts) & (counts > 0)).all()), "weights of poses must be finite and above zero")
    require(len(names) == evidence.shape[1], f"{len(names)} names are not those of {evidence.shape[1]} columns")
    columns = evidence.astype(np.float32)
    require(bool(np.isfinite(columns).all()), "evidence must be finite")
    trees: list[dict[str, Any]] = []
    for random_seed in range(members):
        data = lightgbm.Dataset(columns, right, weight=counts)
        booster = lightgbm.train(TREE_SETTINGS | {"seed": random_seed}, data)
        trees += [tree["tree_structure"] for tree in booster.dump_model()["tree_info"]]
    nodes = 2**_DEPTH - 1
    columns, thresholds = np.zeros((len(trees), nodes), dtype=int), np.zeros((len(trees), nodes), dtype=np.float32)
    values = np.zeros((len(trees), nodes + 1))
    for row, tree in enumerate(trees):
        _fill(tree, 0, 0, columns[row], thresholds[row], values[row])
    return Calibration(
        tuple(names),
        (),
        0.0,
        tuple(map(tuple, columns.tolist())),
        tuple(tuple(float(str(number)) for number in row) for row in thresholds),  # the shortest that means the same
        tuple(map(tuple, (values / members).tolist())),
    )


def _fill(
    node: dict[str, Any],
    level: int,
    place: int,
    columns: Int[np.ndarray, " n"],
    thresholds: Float32[np.ndarray, " n"],
    values: Float[np.ndarray, " l"],
) -> None:
    """Write a node and those below it, the `place`-th of its level, into the arrays of a tree of full depth."""
    if "leaf_value" in node:
        count = 2 ** (_DEPTH - level)
        values[place * count : (place + 1) * count] = node["leaf_value"]
        return
    own = 2**level - 1 + place
    columns[own] = node["split_feature"]
    # Evidence is in single precision: what is not above the threshold is not above the next lower such number.
    near = np.float32(node["threshold"])
    thresholds[own] = near if float(near) <= node["threshold"] else np.nextafter(near, np.float32(-np.inf))
    for side, child in enumerate(("left_child", "right_child")):
        _fill(node[child], level + 1, 2 * place + side, columns, thresholds, values)


def fit_logistic(
    columns: Float[np.ndarray, "s f"],
    right: Bool[np.ndarray, " s"],
    names: Sequence[str],
    ridge: float,
    weights: Float[np.ndarray, " s"] | None = None,
) -> Calibration:
    """Fit a logistic model of columns, with a ridge on the weights of standardised ones; `weights` count some rows as
    several.

    Raises InputError if all are right or all are wrong.
    """
    from scipy.optimize import minimize

    _check(right)
    mean, scale = columns.mean(axis=0), columns.std(axis=0)
    scale = np.where(scale > 0, scale, 1)
    standard = np.append((columns - mean) / scale, np.ones((len(right), 1)), axis=1)
    ridges = np.append(np.full(columns.shape[1], ridge), 0)
    counts = np.ones(len(right)) if weights is None else weights
    counts = counts / counts.sum()

    def loss(solution: Float[np.ndarray, " g"]) -> tuple[float, Float[np.ndarray, " g"]]:
        logits = standard @ solution
        value = counts @ (np.logaddexp(0, logits) - right * logits) + ridges @ solution**2 / 2
        error = np.exp(-np.logaddexp(0, -logits)) - right
        return float(value), standard.T @ (counts * error) + ridges * solution

    start = np.zeros(standard.shape[1])
    *slopes, bias = minimize(loss, start, jac=True, method="L-BFGS-B", options={"ftol": 1e-12, "gtol": 1e-8}).x
    slopes = np.array(slopes) / scale
    return Calibration(tuple(names), tuple(slopes.tolist()), float(bias - slopes @ mean))


def _check(right: Bool[np.ndarray, " s"]) -> None:
    message = f"{int(right.sum())} of {len(right)} poses are right: to fit probabilities, some must be wrong"
    require(bool(right.any() and not right.all()), message)
