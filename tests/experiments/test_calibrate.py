"""The fit of probabilities: their scale is that of the poses that detection reports, one for each place."""

from __future__ import annotations

import numpy as np
import pytest

from experiments import calibrate
from experiments.calibrate import Options, fit
from kmn_jax.detection import expected_calibration_error

_OBJECTS, _POSES, _COLUMNS = 10, 60, 12


def drawn(random_seed: int, objects: int = _OBJECTS) -> dict[str, np.ndarray]:
    """Return poses of objects, for each of which evidence is another wherever it is right."""
    rng = np.random.default_rng(random_seed)
    right = rng.random((objects, _POSES)) < 0.3
    strange = rng.normal(size=(objects, 1, _COLUMNS))
    evidence = right[..., None] + strange + rng.normal(size=(objects, _POSES, _COLUMNS))
    return {
        "evidence": evidence.reshape(-1, _COLUMNS),
        "error": np.where(right, 0.01, np.where(rng.random(right.shape) < 0.3, np.inf, 0.5)).reshape(-1),
        "object": np.repeat(np.arange(objects), _POSES),
        "refined": np.ones(right.size, dtype=bool),
        "reported": rng.random(right.size) < 0.9,
    }


@pytest.fixture(autouse=True)
def few_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibrate, "EVIDENCE", tuple(f"column {number}" for number in range(_COLUMNS)))


def test_probabilities_hold_for_objects_of_other_kinds() -> None:
    poses = drawn(0)
    options = Options(absent_weight=1.0)
    model, results = fit(poses, options)
    plain, _ = fit(poses | {"reported": np.zeros(len(poses["error"]), dtype=bool)}, options)
    assert results["summary"]["poses"] == poses["reported"].sum()
    fresh = drawn(1, 50)
    evidence, right = fresh["evidence"], fresh["error"] < 0.1
    error, before = (expected_calibration_error(fitted.probability(evidence), right) for fitted in (model, plain))
    assert error < 0.7 * before
    order = np.argsort(plain.probability(evidence), kind="stable")
    assert (np.diff(model.probability(evidence[order])) >= -1e-9).all()  # the scale alone is another


def test_absent_parts_count_more_among_refined_poses() -> None:
    poses = drawn(0) | {"reported": np.zeros(_OBJECTS * _POSES, dtype=bool)}  # the scale stays as it is
    absent, usual = (fit(poses, Options(absent_weight=weight))[0].probability(poses["evidence"]) for weight in (20, 1))
    assert absent.mean() < 0.8 * usual.mean()
    found = poses | {"refined": np.zeros(len(poses["error"]), dtype=bool)}
    absent, usual = (fit(found, Options(absent_weight=weight))[0].probability(poses["evidence"]) for weight in (20, 1))
    np.testing.assert_array_equal(absent, usual)
