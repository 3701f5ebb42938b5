"""Probabilities: what is fitted is found again, files come back, and what cannot be used is refused."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import (
    COMPANY,
    TREE_SETTINGS,
    Calibration,
    CalibrationArrays,
    Probabilities,
    averaged,
    chance_calibration_error,
    device_calibration,
    expected_calibration_error,
    fit_calibration,
    fit_logistic,
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
    fitted = fit_logistic(evidence, right, NAMES, ridge=3e-3)
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
    weights = np.where(right, 3.0, 1.0)
    plain, same, weighted = (fit_calibration(evidence, right, NAMES, given) for given in (None, np.ones(500), weights))
    assert plain == same
    # Fits are right on average: of what is said of poses, as often as they count.
    for fitted, counts in ((plain, np.ones(500)), (weighted, weights)):
        said, share = (np.average(values, weights=counts) for values in (fitted.probability(evidence), right))
        np.testing.assert_allclose(said, share, atol=0.01)
    assert np.average(right, weights=weights) > right.mean() + 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": np.zeros(500)}, "weights of poses must be finite and above zero"),
        ({"weights": np.full(500, np.nan)}, "weights of poses must be finite and above zero"),
        ({"weights": np.full(500, np.inf)}, "weights of poses must be finite and above zero"),
        ({"evidence": np.full((500, 3), np.nan)}, "evidence must be finite"),
        ({"members": 0}, "members = 0 must be 1 or more"),
        ({"names": NAMES[:2]}, "2 names are not those of 3 columns"),
    ],
)
def test_what_cannot_be_fitted_is_refused(change: dict[str, Any], message: str) -> None:
    evidence, right = drawn(500)
    with pytest.raises(InputError, match=message):
        fit_calibration(**({"evidence": evidence, "right": right, "names": NAMES} | change))


def test_a_missing_library_of_the_system_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken:
        def find_spec(self, name: str, *_: object) -> None:
            if name == "lightgbm":
                raise OSError("libgomp.so.1: cannot open shared object file")

    monkeypatch.delitem(sys.modules, "lightgbm", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Broken(), *sys.meta_path])
    evidence, right = drawn(20)
    with pytest.raises(InputError, match=r"cannot be loaded \(libgomp.* `sudo apt-get install libgomp1` on Debian"):
        fit_calibration(evidence, right, NAMES)


def test_trees_learn_what_depends_on_another_number() -> None:
    rng = np.random.default_rng(1)
    evidence = rng.uniform(-1, 1, (3_000, 2)).astype(np.float32)
    right = evidence.prod(axis=1) > 0
    plain, trees = fit_logistic(evidence, right, ("a", "b"), 1e-3), fit_calibration(evidence, right, ("a", "b"))
    assert ((plain.probability(evidence) > 0.5) == right).mean() < 0.7
    assert ((trees.probability(evidence) > 0.5) == right).mean() > 0.9
    assert fit_calibration(evidence, right, ("a", "b")) == trees


def test_trees_are_those_that_were_fitted_to_the_last_tie() -> None:
    import lightgbm

    rng = np.random.default_rng(2)
    # Few numbers that differ by the least that single precision can tell: thresholds lie next to them.
    near = np.float32(1) + np.finfo(np.float32).eps * rng.integers(0, 6, (1_000, 1))
    evidence = np.concatenate([near, rng.integers(-3, 3, (1_000, 2))], axis=1).astype(np.float32)
    right = rng.random(1_000) < 1 / (1 + np.exp(-evidence[:, 1] - 1e7 * (evidence[:, 0] - 1)))
    fitted = fit_calibration(evidence, right, NAMES)
    booster = lightgbm.train(TREE_SETTINGS | {"seed": 0}, lightgbm.Dataset(evidence, right))
    expected = booster.predict(evidence, raw_score=True)
    np.testing.assert_allclose(fitted.logit(evidence), expected, atol=1e-9)
    assert np.std(expected) > 0.5


def test_what_was_never_seen_counts_as_the_most_extreme_that_was() -> None:
    evidence, right = drawn(2_000)
    fitted = fit_calibration(evidence, right, NAMES)
    highest = float(evidence[:, 0].max())
    probability = fitted.probability(np.array([[x, 3.0, 1.0] for x in (highest, 1e30, np.inf)], dtype=np.float32))
    assert probability[0] == probability[1] == probability[2] > 0.9


def test_the_device_gives_the_same_probabilities() -> None:
    evidence, right = drawn(500)
    for fitted in (fit_calibration(evidence, right, NAMES), fit_logistic(evidence, right, NAMES, 1e-3)):
        logits = jax.jit(CalibrationArrays.logits)(device_calibration(fitted), jnp.asarray(evidence))
        np.testing.assert_allclose(jax.nn.sigmoid(logits), fitted.probability(evidence), atol=1e-5)


def test_a_scaled_model_says_the_same_in_other_odds() -> None:
    evidence, right = drawn(500)
    fitted = replace(fit_calibration(evidence, right, NAMES), weights=(0.5, 0.0, -1.0))
    np.testing.assert_allclose(fitted.scaled(0.8, 0.3).logit(evidence), 0.8 * fitted.logit(evidence) + 0.3, atol=1e-9)


def test_the_mean_of_models_says_the_mean_of_their_odds() -> None:
    evidence, right = drawn(500)
    trees = [fit_calibration(evidence, outcome, NAMES) for outcome in (right, evidence[:, 1] > 3)]
    lines = [fit_logistic(evidence, outcome, NAMES, ridge=1e-2) for outcome in (right, ~right)]
    for models in (trees, lines, trees[:1]):
        mean = np.mean([model.logit(evidence) for model in models], axis=0)
        np.testing.assert_allclose(averaged(models).logit(evidence), mean, rtol=1e-9, atol=1e-9)
    for other in (lines[0], replace(trees[0], names=(*NAMES[:2], "another")), _shallower(trees[0])):
        with pytest.raises(ValueError, match="have no mean"):
            averaged([trees[0], other])


def _shallower(model: Calibration) -> Calibration:
    """Return a model of the upper half of its trees."""
    leaves = len(model.values[0]) // 2
    return replace(
        model,
        columns=tuple(nodes[: leaves - 1] for nodes in model.columns),
        thresholds=tuple(nodes[: leaves - 1] for nodes in model.thresholds),
        values=tuple(values[:leaves] for values in model.values),
    )


def test_evidence_that_decides_completely_keeps_finite_weights() -> None:
    evidence = np.array([[0.0], [0.1], [0.9], [1.0]], dtype=np.float32)
    fitted = fit_logistic(evidence, np.array([False, False, True, True]), ("only",), 1e-3)
    assert np.isfinite(fitted.weights).all()
    assert (fitted.probability(evidence) > 0.5).tolist() == [False, False, True, True]


@pytest.mark.parametrize("outcome", [True, False])
def test_poses_that_are_all_right_or_all_wrong_teach_nothing(outcome: bool) -> None:
    evidence, right = np.zeros((4, 1), dtype=np.float32), np.full(4, outcome)
    message = f"{4 * outcome} of 4 poses are right"
    with pytest.raises(InputError, match=message):
        fit_calibration(evidence, right, ("only",))
    with pytest.raises(InputError, match=message):
        fit_logistic(evidence, right, ("only",), 1e-3)


def test_few_poses_are_as_probable_as_the_share_that_is_right() -> None:
    evidence, right = drawn(20)
    np.testing.assert_allclose(fit_calibration(evidence, right, NAMES).probability(evidence), right.mean(), atol=1e-6)


def test_several_members_are_the_mean_of_their_models() -> None:
    evidence, right = drawn(3_000)
    one, three = (fit_calibration(evidence, right, NAMES, members=members) for members in (1, 3))
    assert len(three.values) > 2.5 * len(one.values)  # LightGBM leaves out trees of one leaf
    first = replace(
        three, **{name: getattr(three, name)[: len(one.values)] for name in ("columns", "thresholds", "values")}
    )
    np.testing.assert_allclose(3 * first.logit(evidence), one.logit(evidence), atol=1e-9)
    assert np.abs(three.logit(evidence) - one.logit(evidence)).max() > 0.01


def test_poses_are_doubted_where_none_is_sure_and_vouched_for_where_parts_are_said_to_be() -> None:
    own = Calibration(("x",), (1.0,), 0.0)
    models = Probabilities(own, own, own, Calibration(COMPANY, (0.8, 1.4), -4.4))
    rng = np.random.default_rng(0)
    for is_narrowed in (False, True):
        assert len(models.of_scene(np.zeros((0, 1)), is_narrowed)) == 0
    for count in (1, 2, 3, 12):
        evidence = 3 * rng.normal(size=(count, 1))
        alone = own.probability(evidence)
        wide, narrowed = (models.of_scene(evidence, is_narrowed) for is_narrowed in (False, True))
        np.testing.assert_allclose(wide, np.minimum(1 / (1 + np.exp(-evidence[:, 0] - 1)), narrowed), rtol=1e-9)
        for together in (wide, narrowed):
            assert (np.diff(together[np.argsort(alone, kind="stable")]) >= 0).all()  # the order stays
    doubtful, with_a_sure_one, with_a_surer_one = (np.array([[1.5], [x]]) for x in (1.0, 5.0, 9.0))
    for is_narrowed in (False, True):
        assert models.of_scene(doubtful, is_narrowed)[0] < 0.5 * own.probability(doubtful)[0]
        sure, surer = (models.of_scene(some, is_narrowed)[0] for some in (with_a_sure_one, with_a_surer_one))
        assert sure == surer
        assert sure > own.probability(doubtful)[0]


def test_reliability_counts_every_pose_once() -> None:
    probability = np.array([0.0, 0.05, 0.55, 1.0])
    rows = reliability(probability, np.array([False, False, True, True]))
    assert [count for _, _, count in rows] == [2, 1, 1]
    np.testing.assert_allclose([mean for mean, _, _ in rows], [0.025, 0.55, 1.0])


def test_what_counts_twice_is_as_if_it_was_there_twice() -> None:
    evidence, right = drawn(300)
    rng = np.random.default_rng(1)
    weights, probability = rng.integers(1, 4, len(right)).astype(float), rng.random(len(right))
    twice = np.repeat(np.arange(len(right)), weights.astype(int))
    assert expected_calibration_error(probability, right, weights=weights) == pytest.approx(
        expected_calibration_error(probability[twice], right[twice])
    )
    rows, repeated = reliability(probability, right, weights=weights), reliability(probability[twice], right[twice])
    np.testing.assert_allclose([row[:2] for row in rows], [row[:2] for row in repeated])
    assert sum(count for _, _, count in rows) == len(right)
    fitted = fit_logistic(evidence, right, NAMES, 0.0, weights)
    again = fit_logistic(evidence[twice], right[twice], NAMES, 0.0)
    np.testing.assert_allclose((*fitted.weights, fitted.bias), (*again.weights, again.bias), rtol=1e-4)


def test_a_file_comes_back_and_others_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.calibration.json"
    logistic = Calibration(NAMES, (1.0, -2.5, 1e-3), 0.25)
    together = Calibration(COMPANY, (1.1, 1.2), -4.8)
    fitted = Probabilities(logistic, fit_calibration(*drawn(200), NAMES), logistic, together)
    path.write_bytes(probabilities_bytes(fitted))
    loaded = load_probabilities(path, NAMES)
    evidence, _ = drawn(200)
    np.testing.assert_allclose(loaded.found.logit(evidence), fitted.found.logit(evidence), rtol=1e-12)
    np.testing.assert_allclose(loaded.refined.logit(evidence), fitted.refined.logit(evidence), atol=3e-4)
    assert probabilities_bytes(loaded) == path.read_bytes()
    with pytest.raises(InputError, match="of other evidence"):
        load_probabilities(path, ("first",))
    path.write_bytes(probabilities_bytes(replace(fitted, together=logistic)))
    with pytest.raises(InputError, match="of other evidence"):
        load_probabilities(path, NAMES)
    for weights in ((-0.1, 1.2), (0.0, 1.0), (1.0, -0.1)):
        turned = Calibration(COMPANY, weights, 0.0)
        path.write_bytes(probabilities_bytes(replace(fitted, together=turned)))
        with pytest.raises(InputError, match="the order of poses"):
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
        _damaged(fitted, values=[0.0] * 15),  # a leaf is missing
        _damaged(fitted, values=[0.0] * 15 + [1e7]),
        _damaged(fitted, values=[0.0] * 15 + [True]),
        _damaged(fitted, values={str(leaf): 0.0 for leaf in range(16)}),
        _damaged(fitted, columns=[3] * 15),  # there are three columns
        _damaged(fitted, columns=[0.5] * 15),
        _damaged(fitted, columns="0" * 15),
        _damaged(fitted, thresholds=[1e39] * 15),  # not in single precision
        _damaged(fitted, thresholds=["x"] * 15),
        _with_trees(fitted, 1, 14),
        _damaged(fitted, columns=[0] * 7, thresholds=[0.0] * 7, values=[0.0] * 8),  # the others are deeper
        _with_trees(fitted, 1, 2047),
        _with_trees(fitted, 1, 0),
        _with_trees(fitted, 20_001, 1),
        _with_trees(fitted, 0, 0),  # and no weights
        _damaged(fitted, values=[np.nan] * 16),
        _damaged(fitted, values=[np.inf] * 16),
        _without_a_tree(fitted),
        probabilities_bytes(fitted).decode().replace("-2.5", f"1{'0' * 400}"),
    ):
        path.write_text(content)
        with pytest.raises(InputError, match="not a readable calibration"):
            load_probabilities(path, ("first",))


def test_a_file_of_the_time_before_trees_says_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "a.calibration.json"
    own = Calibration(NAMES, (1.0, 0.0, 0.0), 0.0)
    stored = json.loads(probabilities_bytes(Probabilities(own, own, own, Calibration(COMPANY, (1.0, 1.0), 0.0))))
    for model in stored.values():
        for name in ("columns", "thresholds", "values"):
            del model[name]
        model |= {"hidden_weights": [], "hidden_bias": [], "hidden_slopes": []}
    path.write_text(json.dumps(stored))
    with pytest.raises(InputError, match="of another kind: fit it again with"):
        load_probabilities(path, NAMES)


def _with_trees(fitted: Probabilities, trees: int, nodes: int) -> str:
    """Return a file in which a model has these trees alone."""
    stored = json.loads(probabilities_bytes(fitted))
    rows = {"columns": [0] * nodes, "thresholds": [0.0] * nodes, "values": [0.0] * (nodes + 1)}
    stored["refined"] |= {name: [row] * trees for name, row in rows.items()}
    return json.dumps(stored)


def _without_a_tree(fitted: Probabilities) -> str:
    stored = json.loads(probabilities_bytes(fitted))
    del stored["refined"]["thresholds"][-1]
    return json.dumps(stored)


def _damaged(fitted: Probabilities, **parts: Any) -> str:
    """Return a file of which the first tree of one model holds something else."""
    stored = json.loads(probabilities_bytes(fitted))
    for name, values in parts.items():
        stored["refined"][name][0] = values
    return json.dumps(stored)
