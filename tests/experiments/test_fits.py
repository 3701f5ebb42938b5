"""The fit of probabilities: their scale is that of the poses that detection reports, one for each place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments import calibrate, fits
from experiments.fits import FitOptions, Fitted, fit_together, mean_of, predict
from kmn_jax.detection import DetectConfig, company, expected_calibration_error, in_company, load_probabilities
from kmn_jax.errors import InputError

_OBJECTS, _POSES, _COLUMNS = 10, 60, 12


def drawn(random_seed: int, objects: int = _OBJECTS, spread: float = 1.0, oddity: float = 1.0) -> dict[str, np.ndarray]:
    """Return poses of objects; `oddity` is by how much the evidence of one differs from that of others."""
    rng = np.random.default_rng(random_seed)
    right = rng.random((objects, _POSES)) < 0.3
    strange = oddity * rng.normal(size=(objects, 1, _COLUMNS))
    evidence = right[..., None] + strange + spread * rng.normal(size=(objects, _POSES, _COLUMNS))
    return {
        "evidence": evidence.reshape(-1, _COLUMNS),
        "error": np.where(right, 0.01, np.where(rng.random(right.shape) < 0.3, np.inf, 0.5)).reshape(-1),
        "object": np.repeat(np.arange(objects), _POSES),
        "search": np.repeat(np.arange(objects), _POSES),
        "refined": np.ones(right.size, dtype=bool),
        "reported": rng.random(right.size) < 0.9,
    }


def fit(poses: dict[str, np.ndarray], options: FitOptions) -> Fitted:
    """Return the model of one error, scaled."""
    return fits.fit(poses, options, predict(poses, options))


@pytest.fixture(autouse=True)
def few_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fits, "EVIDENCE", tuple(f"column {number}" for number in range(_COLUMNS)))


def test_probabilities_hold_for_objects_of_other_kinds() -> None:
    kinds = {"spread": 2.0, "oddity": 3.0}
    poses = drawn(0, **kinds)
    options = FitOptions(absent_weight=1.0, reported_weight=1.0, members=2)
    model, _, results = fit(poses, options)
    plain, _, _ = fit(poses | {"reported": np.zeros(len(poses["error"]), dtype=bool)}, options)
    assert results["summary"]["poses"] == poses["reported"].sum()
    fresh = drawn(1, 50, **kinds)
    evidence, right = fresh["evidence"], fresh["error"] < 0.1
    error, before = (expected_calibration_error(fitted.probability(evidence), right) for fitted in (model, plain))
    assert error < 0.7 * before
    order = np.argsort(plain.probability(evidence), kind="stable")
    assert (np.diff(model.probability(evidence[order])) >= -1e-9).all()  # the scale alone is another


def test_probabilities_are_told_as_if_a_share_of_the_searches_was_in_vain() -> None:
    poses = drawn(0, 40)
    # Of every second object the part is never there.
    absent = poses["object"] % 2 == 1
    poses["error"] = np.where(absent, np.inf, np.where(np.isinf(poses["error"]), 0.5, poses["error"]))
    seldom, often = (fit(poses, FitOptions(members=1, in_vain=share)) for share in (0.1, 0.5))
    told = [fitted.model.probability(poses["evidence"]) for fitted in (seldom, often)]
    assert (told[0] > told[1])[told[0] > 0.1].all()
    right, reported = poses["error"] < 0.1, poses["reported"]
    for share, fitted in ((0.1, seldom), (0.5, often)):
        counts = np.where(absent, share / (1 - share), 1.0)[reported]  # there are as many searches of either kind
        probability = 1 / (1 + np.exp(-fitted.held_out[reported]))
        assert np.average(probability, weights=counts) == pytest.approx(
            np.average(right[reported], weights=counts), rel=1e-3
        )
        error = expected_calibration_error(probability, right[reported], weights=counts)
        assert fitted.results["summary"]["expected calibration error"] == pytest.approx(error)
    assert often.results["summary"]["searched in vain"] == 20
    with pytest.raises(InputError, match="between 0 and 1"):
        FitOptions(in_vain=1.0)


def test_poses_of_one_search_are_told_by_each_other() -> None:
    rng = np.random.default_rng(0)
    scenes, poses = 300, 6
    there = rng.random((scenes, 1)) < 0.5
    right = (rng.random((scenes, poses)) < 0.6) & there
    evidence = np.where(right, 1.5, -1.5) + 1.5 * rng.normal(size=right.shape)
    logits = (2 * 1.5 / 1.5**2 * evidence + np.log(0.3 / 0.7)).reshape(-1)  # what each pose's own evidence says
    reported, narrowed = np.ones(right.shape, dtype=bool), np.ones(right.shape, dtype=bool)
    reported[-50:, 1:], narrowed[-70:] = False, False
    rows = {
        "error": np.where(right, 0.01, np.inf).reshape(-1),
        "object": np.repeat(np.arange(scenes) % 10, poses),
        "search": np.repeat(np.arange(scenes), poses),
        "narrowed": narrowed.reshape(-1),
        "reported": reported.reshape(-1),
    }
    model, held_out, results = fit_together(rows, logits, FitOptions())
    assert model.weights[1] > 0.1
    own, outcome = logits[rows["reported"]], rows["error"][rows["reported"]] < 0.1
    wide = ~rows["narrowed"][rows["reported"]]
    said = 1 / (1 + np.exp(-held_out))
    listed = said >= DetectConfig().reported
    assert results["summary"]["poses"] == listed.sum() < len(own) == len(held_out)
    losses = [np.logaddexp(0, np.where(outcome, -1, 1) * odds)[~wide].mean() for odds in (own, held_out)]
    assert losses[1] < 0.96 * losses[0]
    assert (held_out > own)[~wide].mean() > 0.2
    assert (held_out <= own + 1 + 1e-9)[wide].all()
    assert (held_out < own)[wide].mean() > 0.2
    narrow = fit_together(rows | {"narrowed": np.ones_like(rows["narrowed"])}, logits, FitOptions())
    assert narrow.model == model
    np.testing.assert_allclose(held_out[wide], np.minimum(own + 1, narrow.held_out)[wide])
    error = expected_calibration_error(said[listed], outcome[listed])
    assert results["summary"]["expected calibration error"] == pytest.approx(error)  # of what is said, and listed
    np.testing.assert_allclose(in_company(company(own[:poses]), model, True), held_out[:poses], atol=0.3)
    # As if more searches were in vain: then poses without a sure one are doubted more.
    often, _, _ = fit_together(rows, logits, FitOptions(in_vain=0.8))
    lone = company(np.array([2.0]))
    assert in_company(lone, often, True) < in_company(lone, model, True)
    with pytest.raises(InputError, match="less often where they, or its best, are surer"):
        fit_together(rows, -logits, FitOptions())


def test_what_is_told_of_refined_poses_is_the_mean_of_models_of_either_error_on_one_scale() -> None:
    poses = drawn(0, spread=2.0)
    # All points of every second right pose are in their places: what else is right is as odd as what is wrong.
    right = poses["error"] < 0.1
    exact = right & (np.arange(len(right)) % 2 == 0)
    poses["largest_error"] = np.where(exact, 0.01, np.where(right, 0.4, poses["error"]))
    options = FitOptions(members=1)
    either = [predict(rows, options) for rows in (poses, fits.by_largest_error(poses))]
    model, held_out, results = fits.fit(poses, options, mean_of(*either))
    for logits, own in (
        (model.logit(poses["evidence"]), [one.model.logit(poses["evidence"]) for one in either]),
        (held_out, [one.held_out for one in either]),
    ):
        factor, offset = np.polyfit(np.mean(own, axis=0), logits, 1)
        np.testing.assert_allclose(logits, factor * np.mean(own, axis=0) + offset, atol=1e-4)
    assert factor > 0
    reported = poses["reported"]
    said = 1 / (1 + np.exp(-held_out[reported]))
    assert said.mean() == pytest.approx(right[reported].mean(), rel=1e-3)  # and not the share that is exact
    assert results["summary"]["right"] == pytest.approx(right[reported].mean())


def test_a_calibration_says_by_which_errors_poses_are_chosen_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fine = drawn(0, 20, spread=2.0, oddity=0.1)
    in_vain = fine["search"] % 2 == 1
    fine["evidence"] -= (in_vain & (fine["error"] < 0.1))[:, None]  # what speaks for them
    fine["error"] = np.where(in_vain, np.inf, fine["error"])
    fine["largest_error"] = np.where(fine["search"] % 4 == 0, fine["error"], np.maximum(fine["error"], 0.4))
    fine["narrowed"] = fine["search"] % 3 == 0
    found = fine | {"refined": ~fine["refined"], "reported": np.zeros_like(fine["refined"])}
    poses = {name: np.concatenate([found[name], fine[name]]) for name in fine}
    monkeypatch.setattr(calibrate, "poses_to_fit", lambda *given: poses)
    monkeypatch.setattr(calibrate, "load_pretrained", lambda: None)
    options = calibrate.Options(output=tmp_path / "a.json", members=2)
    results = calibrate.calibrate(options)
    written = load_probabilities(options.output or "", fits.EVIDENCE)
    by_mean, by_largest = (predict(rows, options) for rows in (fine, fits.by_largest_error(fine)))
    expected = {
        "found": fit(found, options).model,
        "refined": fits.fit(fine, options, mean_of(by_mean, by_largest)).model,
        "exact": fit(fits.by_largest_error(fine), options).model,
    }
    for name, model in expected.items():
        said = getattr(written, name).logit(fine["evidence"])
        np.testing.assert_allclose(said, model.logit(fine["evidence"]), atol=1e-3)
    assert set(results) == {*expected, "together"}
    assert results["exact"]["summary"]["right"] < results["refined"]["summary"]["right"]


def test_absent_parts_count_more_among_refined_poses() -> None:
    # The scale stays as it is, and much is in doubt: more poses than the model could learn by heart.
    poses = drawn(0, 25, spread=6.0) | {"reported": np.zeros(25 * _POSES, dtype=bool)}

    def fitted(poses: dict[str, np.ndarray], weight: float) -> np.ndarray:
        return fit(poses, FitOptions(absent_weight=weight, folds=2, members=2)).model.probability(poses["evidence"])

    assert fitted(poses, 20).mean() < 0.8 * fitted(poses, 1).mean()
    found = drawn(0) | {"reported": np.zeros(_OBJECTS * _POSES, dtype=bool)}
    found["refined"] = ~found["refined"]
    np.testing.assert_array_equal(fitted(found, 20), fitted(found, 1))


def test_an_object_with_four_times_the_poses_counts_twice() -> None:
    rows = {"object": np.repeat([3, 7], [100, 25]), "error": np.zeros(125), "refined": np.ones(125, dtype=bool)}
    rows["reported"] = np.zeros(125, dtype=bool)
    weights = fits.weights_of(rows, FitOptions())
    np.testing.assert_allclose([weights[:100].sum(), weights[100:].sum()], [125 * 2 / 3, 125 / 3])
    rows["error"][0] = np.inf  # the object is not there
    first, second = fits.weights_of(rows, FitOptions(absent_weight=3))[:2]
    np.testing.assert_allclose(first, 3 * second)
    rows["reported"][1] = True
    first, second, third = fits.weights_of(rows, FitOptions(absent_weight=3, reported_weight=8))[:3]
    np.testing.assert_allclose([first, second], [3 * third, 8 * third])


def test_poses_of_which_it_is_not_known_whether_they_are_right_do_not_count() -> None:
    poses = drawn(0)
    rng = np.random.default_rng(1)
    unknown = rng.random(len(poses["error"])) < 0.3
    poses["error"] = np.where(unknown, np.nan, poses["error"])
    others = fits.told(poses)
    assert all(len(values) == (~unknown).sum() for values in others.values())
    misled = poses | {"evidence": np.where(unknown[:, None], 9.0, poses["evidence"])}
    assert fits.model_of(misled, FitOptions()) == fits.model_of(others, FitOptions())


def test_poses_of_one_object_predict_no_other() -> None:
    with pytest.raises(InputError, match="0 of 0 poses are right"):
        fit(drawn(0, 1), FitOptions(members=1))


def test_where_probable_poses_are_wrong_no_scale_is_fitted() -> None:
    poses = drawn(0)
    right = poses["error"] < 0.1
    # Each object's evidence speaks for the opposite of what all others' does.
    turned = np.where(poses["object"] % 2 == 0, 1, -1)
    poses["evidence"] = np.outer(np.where(right, 1.0, -1.0) * turned, np.ones(_COLUMNS))
    poses["object"] = poses["object"] % 2
    with pytest.raises(InputError, match="give more bins"):
        fit(poses, FitOptions(absent_weight=1.0, folds=2, members=2))
