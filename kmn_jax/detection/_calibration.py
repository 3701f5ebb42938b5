"""How probable it is that a pose is right, from the evidence for and against it: a model with a few hidden units.

What one number says depends on others: that a surface goes on in its plane speaks against a pose, but less so if much
of a curved surface agrees. Hidden units learn that; ridges and the clipping of what was never seen keep them tame.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from kmn_jax.errors import InputError, shown
from kmn_jax.limits import parse_json

_RIDGE = 1e-3  # on standardised weights: that which predicts kinds of objects best that were not fitted to
_HIDDEN = 24  # units: chosen in the same way
_EXTREME = 1.0  # percent of the poses on either side, beyond which evidence counts as no more extreme
_ITERATIONS = 500


class CalibrationArrays(NamedTuple):
    """A `Calibration` as arrays, of f columns and u hidden units."""

    low: Float[Array | np.ndarray, " f"]
    high: Float[Array | np.ndarray, " f"]
    hidden_weights: Float[Array | np.ndarray, "f u"]
    hidden_bias: Float[Array | np.ndarray, " u"]
    hidden_slopes: Float[Array | np.ndarray, " u"]
    weights: Float[Array | np.ndarray, " f"]
    bias: Float[Array | np.ndarray, ""]

    def logits(self, evidence: Float[Array | np.ndarray, "*s f"], xp: ModuleType = jnp) -> Any:
        """Return the log odds that poses are right, by the functions of jax.numpy or numpy."""
        rows = xp.clip(evidence.reshape(-1, len(self.low)), self.low[None], self.high[None])
        hidden = xp.tanh(rows @ self.hidden_weights + self.hidden_bias[None])
        return (rows @ self.weights + hidden @ self.hidden_slopes + self.bias).reshape(evidence.shape[:-1])


@dataclass(frozen=True)
class Calibration:
    """A model of evidence x: log odds = bias + weights x + slopes tanh(hidden weights x + hidden bias).

    Evidence is clipped to `low` and `high` first. Without hidden units it is a logistic model.
    """

    names: tuple[str, ...]  # of the columns of the evidence
    weights: tuple[float, ...]
    bias: float
    low: tuple[float, ...] = ()  # no bounds unless given
    high: tuple[float, ...] = ()
    hidden_weights: tuple[tuple[float, ...], ...] = ()  # of each hidden unit
    hidden_bias: tuple[float, ...] = ()
    hidden_slopes: tuple[float, ...] = ()

    def arrays(self) -> CalibrationArrays:
        """Return the model as arrays of float64."""
        count = len(self.names)
        return CalibrationArrays(
            np.array(self.low or (-np.inf,) * count),
            np.array(self.high or (np.inf,) * count),
            np.array(self.hidden_weights).reshape(-1, count).T,
            np.array(self.hidden_bias),
            np.array(self.hidden_slopes),
            np.array(self.weights),
            np.array(self.bias),
        )

    def probability(self, evidence: Float[np.ndarray, "s f"]) -> Float[np.ndarray, " s"]:
        """Return the probability that each pose is right."""
        return _logistic(self.logit(evidence))

    def logit(self, evidence: Float[np.ndarray, "s f"]) -> Float[np.ndarray, " s"]:
        """Return the logarithm of the odds that each pose is right."""
        return self.arrays().logits(evidence.astype(np.float64), np)

    def scaled(self, factor: float, offset: float) -> Calibration:
        """Return the model whose logits are these times a factor, plus an offset."""
        weights, slopes = ([factor * value for value in values] for values in (self.weights, self.hidden_slopes))
        return replace(self, weights=tuple(weights), hidden_slopes=tuple(slopes), bias=factor * self.bias + offset)


def fit_calibration(
    evidence: Float[np.ndarray, "s f"],
    right: Bool[np.ndarray, " s"],
    names: Sequence[str],
    weights: Float[np.ndarray, " s"] | None = None,
    hidden_units: int = _HIDDEN,
    ridge: float = _RIDGE,
    members: int = 1,
) -> Calibration:
    """Fit to poses of which it is known whether they are right; `weights` count some as several.

    With several `members` the model is the mean of as many fits that begin elsewhere: each errs in its own way about
    kinds of objects that it has not seen. The same arguments give the same model on one machine. Raises InputError if
    all are right or all are wrong.
    """
    from scipy.optimize import minimize

    if right.all() or not right.any():
        raise InputError(
            f"{int(right.sum())} of {len(right)} poses are right: to fit probabilities, some must be wrong"
        )
    counts = np.ones(len(right)) if weights is None else weights
    low, high = np.percentile(
        evidence.astype(np.float64), (_EXTREME, 100 - _EXTREME), axis=0, weights=counts, method="inverted_cdf"
    )
    clipped = np.clip(evidence.astype(np.float64), low, high)
    mean, scale = clipped.mean(axis=0), clipped.std(axis=0)
    scale = np.where(scale > 0, scale, 1)
    columns = (clipped - mean) / scale
    counts = counts / counts.sum()
    f, u = columns.shape[1], hidden_units
    shapes = ((f, u), (u,), (u,), (f,), ())
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    ridges = np.concatenate([np.full(f * u, ridge), np.zeros(u), np.full(u + f, ridge), np.zeros(1)])

    def unpacked(solution: Float[np.ndarray, " g"]) -> list[Float[np.ndarray, "..."]]:
        parts = np.split(solution, ends[:-1])
        return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]

    def loss(solution: Float[np.ndarray, " g"]) -> tuple[float, Float[np.ndarray, " g"]]:
        inner, inner_bias, slopes, direct, bias = unpacked(solution)
        hidden = np.tanh(columns @ inner + inner_bias)
        logits = hidden @ slopes + columns @ direct + bias
        value = counts @ (np.logaddexp(0, logits) - right * logits) + ridges @ solution**2 / 2
        error = counts * (_logistic(logits) - right)
        back = np.outer(error, slopes) * (1 - hidden**2)
        slope = [columns.T @ back, back.sum(axis=0), hidden.T @ error, columns.T @ error, error.sum()]
        return float(value), np.concatenate([part.reshape(-1) for part in slope]) + ridges * solution

    def member(random_seed: int) -> list[Float[np.ndarray, "..."]]:
        start, rng = np.zeros(ends[-1]), np.random.default_rng(random_seed)
        start[: f * u] = rng.normal(size=f * u) / np.sqrt(f)
        start[f * u + u : f * u + 2 * u] = rng.normal(size=u) / 4
        options = {"maxiter": _ITERATIONS, "maxfun": 2 * _ITERATIONS, "ftol": 1e-12, "gtol": 1e-8}
        return unpacked(minimize(loss, start, jac=True, method="L-BFGS-B", options=options).x)

    fitted = [member(random_seed) for random_seed in range(members)]
    inner, inner_bias, slopes = (np.concatenate(parts, axis=-1) for parts in list(zip(*fitted, strict=True))[:3])
    slopes, direct, bias = slopes / members, *(np.mean([parts[row] for parts in fitted], axis=0) for row in (3, 4))
    inner, direct = inner / scale[:, None], direct / scale
    return Calibration(
        tuple(names),
        tuple(direct.tolist()),
        float(bias - direct @ mean),
        tuple(low.tolist()),
        tuple(high.tolist()),
        tuple(map(tuple, inner.T.tolist())),
        tuple((inner_bias - mean @ inner).tolist()),
        tuple(slopes.tolist()),
    )


def _logistic(logits: Float[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
    return 1 / (1 + np.exp(-np.clip(logits, -50, 50)))


def expected_calibration_error(
    probability: Float[np.ndarray, " s"], right: Bool[np.ndarray, " s"], bins: int = 10
) -> float:
    """Return the mean difference of probability and share of right poses over equal ranges of probability."""
    rows = reliability(probability, right, bins)
    return float(sum(count * abs(mean - share) for mean, share, count in rows) / max(len(right), 1))


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
    probability: Float[np.ndarray, " s"], right: Bool[np.ndarray, " s"], bins: int = 10
) -> list[tuple[float, float, int]]:
    """Return mean probability, share of right poses and their number for each range of probability that has any."""
    place = np.minimum((probability * bins).astype(int), bins - 1)
    chosen = [place == row for row in range(bins)]
    return [(float(probability[own].mean()), float(right[own].mean()), int(own.sum())) for own in chosen if own.any()]


COMPANY = ("own", "best")  # the evidence of `together`, see `company`


def company(logits: Float[np.ndarray, " s"]) -> Float[np.ndarray, "s 2"]:
    """Return of each pose of one scene its log odds, and those of the most probable pose there."""
    return np.stack([logits, np.full_like(logits, logits.max(initial=-np.inf))], axis=1)


@dataclass(frozen=True)
class Probabilities:
    """The model of poses as they are found, which chooses among them, and that of refined ones, which is reported.

    `exact` is of refined poses that are right in all of their points, not on average: it tells poses of one place apart
    that are turned against each other. `together` is of poses in one scene of which was said where parts are, by what
    `refined` says of each: if one is sure, doubtful ones are more often right. Anywhere else poses tell little about
    each other: there are walls, and other parts, to be mistaken.
    """

    found: Calibration
    refined: Calibration
    exact: Calibration
    together: Calibration

    def of_scene(self, evidence: Float[np.ndarray, "s f"], is_narrowed: bool) -> Float[np.ndarray, " s"]:
        """Return the probabilities of all refined poses that stand in one scene."""
        logits = self.refined.logit(evidence)
        return _logistic(vouched(logits, self.together) if is_narrowed else logits)


def vouched(logits: Float[np.ndarray, " s"], together: Calibration) -> Float[np.ndarray, " s"]:
    """Return the log odds of poses that vouch for each other: none has less than alone, and their order stays.

    That doubtful poses speak against each other is left out: so they do in full bins, which are what is fitted to, but
    not where the last copy lies.
    """
    return np.maximum(logits, together.logit(company(logits))) if len(logits) > 1 else logits


def probabilities_bytes(probabilities: Probabilities) -> bytes:
    """Return the JSON form."""
    return (json.dumps(asdict(probabilities), indent=1) + "\n").encode()


def load_probabilities(path: str | Path, names: Sequence[str]) -> Probabilities:
    """Read models of the evidence with the given names. Raises InputError if the file holds anything else."""
    evidence = {field.name: COMPANY if field.name == "together" else tuple(names) for field in fields(Probabilities)}
    try:
        stored = parse_json(Path(path).read_text(encoding="utf-8"))
        models = {name: _read(stored[name]) for name in evidence if name == "found" or name in stored}
    except (OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path} is not a readable calibration: {shown(error)}") from None
    if {name: model.names for name, model in models.items()} != evidence:
        raise InputError(f"{path} is a calibration of other evidence: fit it again with experiments.calibrate")
    return Probabilities(**models)


def _read(stored: dict[str, Any]) -> Calibration:
    """Return a model of its JSON form. Raises KeyError, TypeError, ValueError or OverflowError if it is none."""
    names = tuple(str(name) for name in stored["names"])

    def numbers(name: str, count: int, given: Any = None) -> tuple[float, ...]:
        values = tuple(float(value) for value in (stored[name] if given is None else given))
        if len(values) != count or not np.isfinite(values).all():
            raise ValueError(f"{name} are not {count} finite numbers")
        return values

    units = len(stored["hidden_slopes"])
    if len(stored["hidden_weights"]) != units:
        raise ValueError(f"hidden_weights are not those of {units} units")
    low, high = (numbers(name, len(names) if stored[name] else 0) for name in ("low", "high"))
    return Calibration(
        names=names,
        weights=numbers("weights", len(names)),
        bias=numbers("bias", 1, [stored["bias"]])[0],
        low=low,
        high=high,
        hidden_weights=tuple(numbers("hidden_weights", len(names), row) for row in stored["hidden_weights"]),
        hidden_bias=numbers("hidden_bias", units),
        hidden_slopes=numbers("hidden_slopes", units),
    )
