"""How probable it is that a pose is right, from the evidence for and against it: a model of many small trees.

What one number says depends on others: that a surface goes on in its plane speaks against a pose, but less so if much
of a curved surface agrees. Trees learn that, and what is more extreme than all that was seen counts as the most
extreme of it. `fit_calibration` fits them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from kmn_jax.errors import InputError, shown
from kmn_jax.limits import parse_json

_DECIMALS = 6  # of the values of leaves, in files
_TREE_FIELDS = ("columns", "thresholds", "values")  # of `Calibration`
_MOST_TREES, _MOST_LEAVES = 20_000, 1024  # of a model in a file, and of a tree
_LARGEST = 1e6  # of numbers that are added up


class CalibrationArrays(NamedTuple):
    """A `Calibration` as arrays, of f columns and t trees of one depth.

    The nodes of a tree are those of its levels one after the other, n = 2^depth - 1 of them, and l = n + 1 leaves.
    """

    weights: Float[Array | np.ndarray, " w"]  # w = f, or none
    bias: Float[Array | np.ndarray, ""]
    columns: Int[Array | np.ndarray, "t n"]  # that nodes look at
    thresholds: Float32[Array | np.ndarray, "t n"]  # up to which it is the left branch that is taken
    values: Float[Array | np.ndarray, "t l"]  # of leaves

    def logits(self, evidence: Float[Array | np.ndarray, "*s f"], xp: ModuleType = jnp) -> Any:
        """Return the log odds that poses are right, by the functions of jax.numpy or numpy."""
        rows = evidence.reshape(-1, evidence.shape[-1])
        logits = rows @ self.weights if len(self.weights) else xp.zeros(len(rows))
        trees, leaves = self.values.shape
        if trees:
            tree, branch = xp.arange(trees, dtype=xp.int32)[None], xp.zeros((len(rows), trees), dtype=xp.int32)
            for first in (2**level - 1 for level in range(leaves.bit_length() - 1)):  # nodes before those of a level
                node = (leaves - 1) * tree + first + branch
                column, threshold = (
                    xp.take(of.reshape(-1), node, mode="clip") for of in (self.columns, self.thresholds)
                )
                is_right = xp.take_along_axis(rows, column, axis=1) > threshold
                branch = 2 * branch + is_right.astype(xp.int32)
            logits = logits + xp.take(self.values.reshape(-1), leaves * tree + branch, mode="clip").sum(axis=1)
        return (logits + self.bias).reshape(evidence.shape[:-1])


@dataclass(frozen=True)
class Calibration:
    """A model of evidence x: log odds = bias + weights x + the values of the leaves that x leads to, one of each tree.

    Trees are as in `CalibrationArrays`. Without any it is a logistic model.
    """

    names: tuple[str, ...]  # of the columns of the evidence
    weights: tuple[float, ...]  # one for each, or none
    bias: float
    columns: tuple[tuple[int, ...], ...] = ()  # of the nodes of each tree
    thresholds: tuple[tuple[float, ...], ...] = ()
    values: tuple[tuple[float, ...], ...] = ()  # of the leaves of each tree

    def arrays(self) -> CalibrationArrays:
        """Return the model as arrays, thresholds in the precision of evidence."""
        trees, leaves = len(self.values), len(self.values[0]) if self.values else 1
        return CalibrationArrays(
            np.array(self.weights),
            np.array(self.bias),
            np.array(self.columns, dtype=np.int32).reshape(trees, leaves - 1),
            np.array(self.thresholds, dtype=np.float32).reshape(trees, leaves - 1),
            np.array(self.values, dtype=np.float64).reshape(trees, leaves),
        )

    def probability(self, evidence: Float[np.ndarray, "s f"]) -> Float[np.ndarray, " s"]:
        """Return the probability that each pose is right."""
        return _logistic(self.logit(evidence))

    def logit(self, evidence: Float[np.ndarray, "s f"]) -> Float[np.ndarray, " s"]:
        """Return the logarithm of the odds that each pose is right."""
        return self.arrays().logits(evidence, np)

    def scaled(self, factor: float, offset: float) -> Calibration:
        """Return the model whose logits are these times a factor, plus an offset."""
        return replace(
            self,
            weights=tuple(factor * weight for weight in self.weights),
            values=tuple(tuple(factor * value for value in leaves) for leaves in self.values),
            bias=factor * self.bias + offset,
        )


def averaged(models: Sequence[Calibration]) -> Calibration:
    """Return the model whose logits are the mean of those of models of the same evidence, with trees of one depth."""
    if len({(model.names, len(model.weights), *map(len, model.values[:1])) for model in models}) != 1:
        raise ValueError("models of other evidence, or of trees of another depth, have no mean")
    parts = [model.scaled(1 / len(models), 0.0) for model in models]
    return Calibration(
        parts[0].names,
        tuple(map(sum, zip(*(part.weights for part in parts), strict=True))),
        sum(part.bias for part in parts),
        *(tuple(chain.from_iterable(getattr(part, name) for part in parts)) for name in _TREE_FIELDS),
    )


def _logistic(logits: Float[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
    return 1 / (1 + np.exp(-np.clip(logits, -50, 50)))


def expected_calibration_error(
    probability: Float[np.ndarray, " s"],
    right: Bool[np.ndarray, " s"],
    bins: int = 10,
    weights: Float[np.ndarray, " s"] | None = None,
) -> float:
    """Return the mean difference of probability and share of right poses over equal ranges of probability.

    `weights` count some poses as several.
    """
    rows = _by_range(probability, right, bins, weights)
    total = sum(weight for *_, weight in rows)
    return sum(weight * abs(mean - share) for mean, share, _, weight in rows) / max(total, 1e-9)


def chance_calibration_error(probability: Float[np.ndarray, " s"], bins: int = 10, draws: int = 200) -> float:
    """Return the mean `expected_calibration_error` of independent poses that are right just as often as is said.

    `probability` is what is said of each, `bins` the number of ranges of it, `draws` that of random outcomes which the
    mean is over. An error about as large as this says nothing against the probabilities.
    """
    rng = np.random.default_rng(0)
    errors = [
        expected_calibration_error(probability, rng.random(len(probability)) < probability, bins) for _ in range(draws)
    ]
    return float(np.mean(errors))


def reliability(
    probability: Float[np.ndarray, " s"],
    right: Bool[np.ndarray, " s"],
    bins: int = 10,
    weights: Float[np.ndarray, " s"] | None = None,
) -> list[tuple[float, float, int]]:
    """Return mean probability, share of right poses and their number for each range of probability that has any.

    `weights` count some poses as several in the mean and the share.
    """
    return [(mean, share, count) for mean, share, count, _ in _by_range(probability, right, bins, weights)]


def _by_range(
    probability: Float[np.ndarray, " s"],
    right: Bool[np.ndarray, " s"],
    bins: int,
    weights: Float[np.ndarray, " s"] | None,
) -> list[tuple[float, float, int, float]]:
    """Return the rows of `reliability`, and the weight of each."""
    weights = np.ones(len(right)) if weights is None else weights
    place = np.minimum((probability * bins).astype(int), bins - 1)
    rows = []
    for own in (place == row for row in np.unique(place)):
        mean, share = (float(np.average(values[own], weights=weights[own])) for values in (probability, right))
        rows.append((mean, share, int(own.sum()), float(weights[own].sum())))
    return rows


_BEYOND_DOUBT = 5.0  # log odds of a pose that leaves no doubt that its part is there
_MOST_ADDED = 1.0  # log odds that company adds at most to a pose, in a scan of which nothing was said
COMPANY = ("own", f"best, at most {_BEYOND_DOUBT:g}")  # the evidence of `together`, see `company`


def company(logits: Float[np.ndarray, " s"]) -> Float[np.ndarray, "s 2"]:
    """Return of each pose of one scene its log odds, and those of the most probable one, at most `_BEYOND_DOUBT`."""
    return np.stack([logits, np.full_like(logits, min(logits.max(initial=-np.inf), _BEYOND_DOUBT))], axis=1)


@dataclass(frozen=True)
class Probabilities:
    """The model of poses as they are found, which chooses among them, and that of refined ones, which is reported.

    `refined` is the mean of models that are fitted to either error, scaled to say how probable it is that the points
    are in their places on average. `exact` is of all of them being so: it tells poses of one place apart that are
    turned against each other. `together` is of poses in one scene, by what `refined` says of each: where none leaves
    no doubt, the part may not be there at all, see `in_company`.
    """

    found: Calibration
    refined: Calibration
    exact: Calibration
    together: Calibration

    def of_scene(self, evidence: Float[np.ndarray, "s f"], is_narrowed: bool) -> Float[np.ndarray, " s"]:
        """Return the probabilities of all refined poses that stand in one scene."""
        return _logistic(in_company(company(self.refined.logit(evidence)), self.together, is_narrowed))


def in_company(
    columns: Float[np.ndarray, "s 2"], together: Calibration, is_narrowed: bool | Bool[np.ndarray, " s"]
) -> Float[np.ndarray, " s"]:
    """Return the log odds of poses, given their `company`, in scenes of which was said where parts are, or not.

    Where it was not, there may be other things to be mistaken than any that probabilities were fitted to: there a pose
    beyond doubt adds at most `_MOST_ADDED` to what is said of another one.
    """
    told = together.logit(columns)
    return np.where(is_narrowed, told, np.minimum(columns[:, 0] + _MOST_ADDED, told))


def keeps_order(together: Calibration) -> bool:
    """Tell whether of two poses of a scene the surer one stays more probable, and sure company speaks against none."""
    return len(together.weights) == 2 and together.weights[0] > 0 and together.weights[1] >= 0 and not together.values


def probabilities_bytes(probabilities: Probabilities) -> bytes:
    """Return the JSON form, in which the values of leaves are rounded."""
    models = asdict(probabilities)
    for model in models.values():
        model["values"] = [[round(value, _DECIMALS) for value in leaves] for leaves in model["values"]]
    return (json.dumps(models) + "\n").encode()


def calibration_beside(weights: str | Path) -> Path:
    """Return where the probabilities that were fitted for a file of weights are kept."""
    return Path(weights).with_suffix(".calibration.json")


def load_probabilities(path: str | Path, names: Sequence[str]) -> Probabilities:
    """Read models of the evidence with the given names. Raises InputError if the file holds anything else."""
    evidence = {field.name: COMPANY if field.name == "together" else tuple(names) for field in fields(Probabilities)}
    try:
        stored = parse_json(Path(path).read_text(encoding="utf-8"))
        models = {name: _read(stored[name]) for name in evidence if name == "found" or name in stored}
    except _OtherKindError:
        raise InputError(f"{path} is a calibration of another kind: fit it again with experiments.calibrate") from None
    except (OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path} is not a readable calibration: {shown(error)}") from None
    if {name: model.names for name, model in models.items()} != evidence:
        raise InputError(f"{path} is a calibration of other evidence: fit it again with experiments.calibrate")
    result = Probabilities(**models)
    if not keeps_order(result.together):
        raise InputError(
            f"{path} does not keep the order of poses of one scan: fit it again with experiments.calibrate"
        )
    return result


class _OtherKindError(Exception):
    """A file is of a time when models were no trees."""


def _read(stored: dict[str, Any]) -> Calibration:
    """Return a model of its JSON form. Raises KeyError, TypeError, ValueError, OverflowError or _OtherKindError."""
    names = tuple(str(name) for name in _listed(stored["names"]))
    if not any(name in stored for name in _TREE_FIELDS):
        raise _OtherKindError
    columns, thresholds, values = (_listed(stored[name]) for name in _TREE_FIELDS)
    leaves = len(_listed(values[0])) if values else 2
    if not len(columns) == len(thresholds) == len(values) <= _MOST_TREES:
        raise ValueError(f"its trees are not the same in all parts, or more than {_MOST_TREES}")
    if not 2 <= leaves <= _MOST_LEAVES or leaves & (leaves - 1):
        raise ValueError(f"a tree has {leaves} leaves, no power of two up to {_MOST_LEAVES}")
    weights = _numbers("weights", stored["weights"], len(names) if stored["weights"] else 0, _LARGEST)
    (bias,) = _numbers("bias", [stored["bias"]], 1, _LARGEST)
    if not weights and not values:
        raise ValueError("it has neither weights nor trees")
    return Calibration(
        names,
        weights,
        bias,
        tuple(_places(row, leaves - 1, len(names)) for row in columns),
        tuple(_numbers("thresholds", row, leaves - 1, float(np.finfo(np.float32).max)) for row in thresholds),
        tuple(_numbers("values", row, leaves, _LARGEST) for row in values),
    )


def _listed(given: Any) -> list[Any]:
    if not isinstance(given, list):
        raise TypeError(f"{shown(given)} is no list")
    return given


def _numbers(name: str, given: Any, count: int, largest: float) -> tuple[float, ...]:
    if len(_listed(given)) != count or not all(
        type(value) in (int, float) and abs(value) <= largest for value in given
    ):
        raise ValueError(f"{name} are not {count} numbers up to {largest:g}")
    return tuple(map(float, given))


def _places(given: Any, count: int, limit: int) -> tuple[int, ...]:
    if len(_listed(given)) != count or not all(type(place) is int and 0 <= place < limit for place in given):
        raise ValueError(f"columns are not {count} of the {limit} that there are")
    return tuple(given)
