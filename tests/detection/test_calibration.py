"""Probabilities: what is fitted is found again, files come back, and what cannot be used is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import (
    COMPANY,
    Calibration,
    CalibrationArrays,
    Probabilities,
    chance_calibration_error,
    device_calibration,
    expected_calibration_error,
    fit_calibration,
    load_probabilities,
    probabilities_bytes,
    reliability,
)
from kmn_jax.errors import InputError

NAMES = ("first", "second", "constant")


def drawn(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return evidence, and outcomes of a known logistic model of it."""
    rng = np.random.default_rng(0)
    evidence = np.concatenate([rng.normal(size=(count, 2)) * [1, 5] + [0, 3], np.ones((count, 1))], axis=1)
    probability = 1 / (1 + np.exp(-(2 * evidence[:, 0] - 0.3 * evidence[:, 1] + 1)))
    return evidence.astype(np.float32), rng.random(count) < probability


def test_a_known_model_is_found_and_its_probabilities_hold() -> None:
    evidence, right = drawn(20_000)
    fitted = fit_calibration(evidence, right, NAMES, hidden_units=0, ridge=3e-3)
    np.testing.assert_allclose(fitted.weights[:2], [2, -0.3], rtol=0.1)
    np.testing.assert_allclose(fitted.bias + fitted.weights[2], 1, atol=0.15)
    assert expected_calibration_error(fitted.probability(evidence), right) < 0.02
    assert expected_calibration_error(np.full(len(right), 0.99), right) > 0.2


def test_few_poses_have_a_calibration_error_by_chance_alone() -> None:
    # Of 100 tosses of a coin, the share of heads is off by 0.0398 in the mean.
    np.testing.assert_allclose(chance_calibration_error(np.full(100, 0.5), draws=2000), 0.0398, rtol=0.05)
    probability = np.linspace(0.05, 0.95, 10)
    few, many = (chance_calibration_error(np.repeat(probability, count)) for count in (5, 500))
    np.testing.assert_allclose(few / many, 10, rtol=0.1)
    assert chance_calibration_error(np.zeros(0)) == 0 == chance_calibration_error(np.ones(20))


def test_a_weight_counts_a_pose_several_times() -> None:
    evidence, right = drawn(500)
    twice = np.concatenate([evidence, evidence[:100]]), np.concatenate([right, right[:100]])
    weights = np.where(np.arange(500) < 100, 2.0, 1.0)
    # Columns are scaled by the spread of what is given, so the ridge differs a little.
    weighted, repeated = (
        fit_calibration(*given, hidden_units=0) for given in ((evidence, right, NAMES, weights), (*twice, NAMES))
    )
    np.testing.assert_allclose(weighted.probability(evidence), repeated.probability(evidence), atol=0.01)


def test_hidden_units_learn_what_depends_on_another_number() -> None:
    rng = np.random.default_rng(1)
    evidence = rng.uniform(-1, 1, (3_000, 2)).astype(np.float32)
    right = evidence.prod(axis=1) > 0
    plain, hidden = (fit_calibration(evidence, right, ("a", "b"), hidden_units=units) for units in (0, 24))
    assert ((plain.probability(evidence) > 0.5) == right).mean() < 0.7
    assert ((hidden.probability(evidence) > 0.5) == right).mean() > 0.9
    assert fit_calibration(evidence, right, ("a", "b")) == hidden


def test_what_was_never_seen_counts_as_the_most_extreme_that_was() -> None:
    evidence, right = drawn(2_000)
    fitted = fit_calibration(evidence, right, NAMES)
    far = np.array([[100.0, 3.0, 1.0], [1e6, 3.0, 1.0]], dtype=np.float32)
    first, second = fitted.probability(far)
    assert first == second == fitted.probability(np.array([[fitted.high[0], 3.0, 1.0]]))[0]


def test_the_device_gives_the_same_probabilities() -> None:
    evidence, right = drawn(500)
    fitted = fit_calibration(evidence, right, NAMES)
    logits = jax.jit(CalibrationArrays.logits)(device_calibration(fitted), jnp.asarray(evidence))
    np.testing.assert_allclose(jax.nn.sigmoid(logits), fitted.probability(evidence), atol=1e-5)


def test_evidence_that_decides_completely_keeps_finite_weights() -> None:
    evidence = np.array([[0.0], [0.1], [0.9], [1.0]], dtype=np.float32)
    fitted = fit_calibration(evidence, np.array([False, False, True, True]), ("only",))
    assert np.isfinite(fitted.weights).all()
    assert (fitted.probability(evidence) > 0.5).tolist() == [False, False, True, True]
    with pytest.raises(InputError, match="4 of 4 poses are right"):
        fit_calibration(evidence, np.ones(4, dtype=bool), ("only",))


def test_several_members_are_the_mean_of_their_models() -> None:
    evidence, right = drawn(300)
    one, three = (fit_calibration(evidence, right, NAMES, hidden_units=4, members=members) for members in (1, 3))
    assert len(three.hidden_slopes) == 12
    own = CalibrationArrays(*three.arrays())
    # The first of the three is the one that is fitted alone, up to what all share.
    first = own._replace(
        hidden_weights=own.hidden_weights[:, :4],
        hidden_bias=own.hidden_bias[:4],
        hidden_slopes=3 * own.hidden_slopes[:4],
    )
    hidden = [
        model.logits(evidence, np) - evidence.clip(model.low, model.high) @ model.weights - model.bias
        for model in (first, one.arrays())
    ]
    np.testing.assert_allclose(*hidden, rtol=1e-6, atol=1e-9)
    losses = [np.mean(np.logaddexp(0, np.where(right, -1, 1) * model.logit(evidence))) for model in (one, three)]
    assert losses[1] < losses[0] + 0.02


def test_sure_poses_vouch_for_others_of_their_scene() -> None:
    own = Calibration(("x",), (1.0,), 0.0)
    models = Probabilities(own, own, own, Calibration(COMPANY, (1.1, 1.15), -4.8))
    rng = np.random.default_rng(0)
    assert len(models.of_scene(np.zeros((0, 1)), True)) == 0
    for count in (1, 2, 3, 12):
        evidence = 3 * rng.normal(size=(count, 1))
        alone = own.probability(evidence)
        np.testing.assert_allclose(models.of_scene(evidence, False), alone, rtol=1e-12)
        together = models.of_scene(evidence, True)
        assert (together >= alone).all()
        assert (np.diff(together[np.argsort(alone, kind="stable")]) >= 0).all()  # the order stays
    np.testing.assert_allclose(models.of_scene(np.array([[1.2]]), True), own.probability(np.array([[1.2]])), rtol=1e-12)
    doubtful, with_a_sure_one = np.array([[-1.0], [-2.0]]), np.array([[-1.0], [6.0]])
    np.testing.assert_allclose(models.of_scene(doubtful, True), own.probability(doubtful), rtol=1e-12)
    assert models.of_scene(with_a_sure_one, True)[0] > 2 * own.probability(doubtful)[0]


def test_reliability_counts_every_pose_once() -> None:
    probability = np.array([0.0, 0.05, 0.55, 1.0])
    rows = reliability(probability, np.array([False, False, True, True]))
    assert [count for _, _, count in rows] == [2, 1, 1]
    np.testing.assert_allclose([mean for mean, _, _ in rows], [0.025, 0.55, 1.0])


def test_a_file_comes_back_and_others_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.calibration.json"
    logistic = Calibration(NAMES, (1.0, -2.5, 1e-3), 0.25)
    together = Calibration(COMPANY, (1.1, 1.2), -4.8)
    fitted = Probabilities(logistic, fit_calibration(*drawn(100), NAMES), logistic, together)
    path.write_bytes(probabilities_bytes(fitted))
    assert load_probabilities(path, NAMES) == fitted
    with pytest.raises(InputError, match="of other evidence"):
        load_probabilities(path, ("first",))
    path.write_bytes(probabilities_bytes(replace(fitted, together=logistic)))
    with pytest.raises(InputError, match="of other evidence"):
        load_probabilities(path, NAMES)
    old = json.loads(probabilities_bytes(fitted))
    del old["exact"], old["together"]
    path.write_text(json.dumps(old))
    with pytest.raises(InputError, match="fit it again"):
        load_probabilities(path, NAMES)
    for content in (
        "",
        "[]",
        "{}",
        '{"found": 1, "refined": {"names": ["first"], "weights": ["x"], "bias": 0}, "exact": 1, "together": 1}',
        _damaged(fitted),
        probabilities_bytes(fitted).decode().replace("-2.5", f"1{'0' * 400}"),
    ):
        path.write_text(content)
        with pytest.raises(InputError, match="not a readable calibration"):
            load_probabilities(path, ("first",))


def _damaged(fitted: Probabilities) -> str:
    """Return a file whose hidden units lack a number."""
    stored = json.loads(probabilities_bytes(fitted))
    del stored["refined"]["hidden_weights"][3][-1]
    return json.dumps(stored)
