"""How probable it is that a pose is right, from the evidence for and against it: a logistic model."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from kmn_jax.errors import InputError
from kmn_jax.limits import parse_json

_RIDGE = 1e-3  # keeps weights finite where the evidence separates right from wrong completely


@dataclass(frozen=True)
class Calibration:
    """A logistic model: probability = 1 / (1 + exp(-(bias + evidence @ weights)))."""

    names: tuple[str, ...]  # of the columns of the evidence
    weights: tuple[float, ...]
    bias: float

    def probability(self, evidence: Float[np.ndarray, "s f"]) -> Float[np.ndarray, " s"]:
        """Return the probability that each pose is right."""
        return _logistic(self.bias + evidence.astype(np.float64) @ np.array(self.weights))


def fit_calibration(
    evidence: Float[np.ndarray, "s f"],
    right: Bool[np.ndarray, " s"],
    names: Sequence[str],
    weights: Float[np.ndarray, " s"] | None = None,
    signs: Mapping[str, int] | None = None,
) -> Calibration:
    """Fit to poses of which it is known whether they are right; `weights` count some as several.

    Columns whose sign is 1 may only speak for a pose, those of -1 only against it: what is fitted then holds better
    in scenes of another kind. Raises InputError if all are right or all are wrong.
    """
    from scipy.optimize import minimize

    if right.all() or not right.any():
        raise InputError(
            f"{int(right.sum())} of {len(right)} poses are right: to fit probabilities, some must be wrong"
        )
    mean, scale = evidence.mean(axis=0), evidence.std(axis=0)
    scale = np.where(scale > 0, scale, 1)
    columns = np.concatenate([(evidence - mean) / scale, np.ones((len(evidence), 1))], axis=1).astype(np.float64)
    counts = np.ones(len(right)) if weights is None else weights
    ridge = _RIDGE * counts.sum() * np.append(np.ones(len(scale)), 0.0)

    def loss(solution: Float[np.ndarray, " g"]) -> tuple[float, Float[np.ndarray, " g"]]:
        logits = columns @ solution
        value = counts @ (np.logaddexp(0, logits) - right * logits) + ridge @ solution**2 / 2
        slope = columns.T @ (counts * (_logistic(logits) - right)) + ridge * solution
        return float(value / counts.sum()), slope / counts.sum()

    ranges = {1: (0, None), -1: (None, 0), 0: (None, None)}
    bounds = [ranges[(signs or {}).get(name, 0)] for name in names] + [ranges[0]]
    start = np.zeros(columns.shape[1])
    options = {"maxiter": 10_000, "maxfun": 100_000, "ftol": 1e-15, "gtol": 1e-9}
    solution = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
    slopes = solution[:-1] / scale
    return Calibration(tuple(names), tuple(slopes.tolist()), float(solution[-1] - slopes @ mean))


def _logistic(logits: Float[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
    return 1 / (1 + np.exp(-np.clip(logits, -50, 50)))


def expected_calibration_error(
    probability: Float[np.ndarray, " s"], right: Bool[np.ndarray, " s"], bins: int = 10
) -> float:
    """Return the mean difference of probability and share of right poses over equal ranges of probability."""
    rows = reliability(probability, right, bins)
    return float(sum(count * abs(mean - share) for mean, share, count in rows) / max(len(right), 1))


def reliability(
    probability: Float[np.ndarray, " s"], right: Bool[np.ndarray, " s"], bins: int = 10
) -> list[tuple[float, float, int]]:
    """Return mean probability, share of right poses and their number for each range of probability that has any."""
    place = np.minimum((probability * bins).astype(int), bins - 1)
    chosen = [place == row for row in range(bins)]
    return [(float(probability[own].mean()), float(right[own].mean()), int(own.sum())) for own in chosen if own.any()]


@dataclass(frozen=True)
class Probabilities:
    """The model of poses as they are found, which chooses among them, and that of refined ones, which is reported."""

    found: Calibration
    refined: Calibration


def probabilities_bytes(probabilities: Probabilities) -> bytes:
    """Return the JSON form."""
    return (json.dumps(asdict(probabilities), indent=1) + "\n").encode()


def load_probabilities(path: str | Path, names: Sequence[str]) -> Probabilities:
    """Read models of the evidence with the given names. Raises InputError if the file holds anything else."""
    try:
        stored = parse_json(Path(path).read_text(encoding="utf-8"))
        models = [
            Calibration(
                tuple(str(name) for name in found["names"]),
                tuple(float(weight) for weight in found["weights"]),
                float(found["bias"]),
            )
            for found in (stored["found"], stored["refined"])
        ]
        finite = all(np.isfinite([*model.weights, model.bias]).all() for model in models)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is not a readable calibration: {error}") from None
    if any(model.names != tuple(names) or len(model.weights) != len(names) for model in models) or not finite:
        raise InputError(f"{path} is a calibration of other evidence: fit it again with experiments.calibrate")
    return Probabilities(*models)
