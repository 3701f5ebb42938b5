"""How probable it is that a pose is right, from the evidence for and against it: a logistic model."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from kmn_jax.checks import InputError

_RIDGE = 1e-3  # keeps weights finite where the evidence separates right from wrong completely


@dataclass(frozen=True)
class Calibration:
    """A logistic model: probability = 1 / (1 + exp(-(bias + evidence @ weights)))."""

    names: tuple[str, ...]  # of the columns of the evidence
    weights: tuple[float, ...]
    bias: float

    def probability(self, evidence: Float[np.ndarray, "s f"]) -> Float[np.ndarray, " s"]:
        """Return the probability that each pose is right."""
        logits = self.bias + evidence.astype(np.float64) @ np.array(self.weights)
        return 1 / (1 + np.exp(-np.clip(logits, -50, 50)))


def fit_calibration(
    evidence: Float[np.ndarray, "s f"],
    right: Bool[np.ndarray, " s"],
    names: Sequence[str],
    weights: Float[np.ndarray, " s"] | None = None,
) -> Calibration:
    """Fit by Newton's method to poses of which it is known whether they are right; `weights` count some as several.

    Raises InputError if all are right or all are wrong.
    """
    if right.all() or not right.any():
        raise InputError(
            f"{int(right.sum())} of {len(right)} poses are right: to fit probabilities, some must be wrong"
        )
    mean, scale = evidence.mean(axis=0), evidence.std(axis=0)
    scale = np.where(scale > 0, scale, 1)
    columns = np.concatenate([(evidence - mean) / scale, np.ones((len(evidence), 1))], axis=1).astype(np.float64)
    counts = np.ones(len(right)) if weights is None else weights
    ridge = _RIDGE * counts.sum() * np.append(np.ones(len(scale)), 0.0)
    solution = np.zeros(columns.shape[1])
    for _ in range(50):
        predicted = 1 / (1 + np.exp(-columns @ solution))
        gradient = columns.T @ (counts * (predicted - right)) + ridge * solution
        curvature = (columns * (counts * predicted * (1 - predicted))[:, None]).T @ columns + np.diag(ridge + 1e-9)
        step = np.linalg.solve(curvature, gradient)
        solution -= step
        if np.abs(step).max() < 1e-8:
            break
    slopes = solution[:-1] / scale
    return Calibration(tuple(names), tuple(slopes.tolist()), float(solution[-1] - slopes @ mean))


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
        stored = json.loads(Path(path).read_text(encoding="utf-8"))
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
