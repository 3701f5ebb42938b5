"""The fit of probabilities: their scale is that of the poses that detection reports, one for each place."""

from __future__ import annotations

import numpy as np
import pytest

from experiments import fits
from experiments.fits import FitOptions, fit, fit_scenes
from kmn_jax.detection import company, expected_calibration_error
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
        "search": np.repeat(np.arange(2 * objects), _POSES // 2),
        "refined": np.ones(right.size, dtype=bool),
        "reported": rng.random(right.size) < 0.9,
    }


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


def in_scenes(random_seed: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return poses of scenes, half of which hold the part, and what each pose's own evidence says."""
    rng = np.random.default_rng(random_seed)
    scenes, poses = 300, 6
    there = rng.random((scenes, 1)) < 0.5
    right = (rng.random((scenes, poses)) < 0.6) & there
    evidence = np.where(right, 1.5, -1.5) + 1.5 * rng.normal(size=right.shape)
    reported = np.ones(right.shape, dtype=bool)
    reported[-50:, 1:] = False  # in the last scenes one pose alone
    rows = {
        "error": np.where(right, 0.01, np.where(there, 0.5, np.inf)).reshape(-1),
        "object": np.repeat(np.arange(scenes) % 10, poses),
        "search": np.repeat(np.arange(scenes), poses),
        "reported": reported.reshape(-1),
    }
    return rows, (2 * 1.5 / 1.5**2 * evidence + np.log(0.3 / 0.7)).reshape(-1)


def test_poses_of_one_scene_tell_whether_the_part_is_there() -> None:
    rows, logits = in_scenes(0)
    there, together, held_out, results = fit_scenes(rows, logits, FitOptions(in_vain=0.5))
    own, outcome = logits[rows["reported"]], rows["error"][rows["reported"]] < 0.1
    assert results["summary"]["poses"] == len(own) == len(held_out)
    losses = [np.logaddexp(0, np.where(outcome, -1, 1) * odds).mean() for odds in (own, held_out)]
    assert losses[1] < 0.9 * losses[0]
    first = rows["search"][rows["reported"]] == 0
    told = np.minimum(there.logit(own[first, None]), together.logit(company(own[first])))
    np.testing.assert_allclose(told, held_out[first], atol=0.6)  # of others' scenes
    absent = np.isinf(rows["error"][rows["reported"]])
    in_scenes_with_it = np.logaddexp(0, np.where(outcome, -1, 1) * there.logit(own[:, None]))[~absent].mean()
    assert in_scenes_with_it < np.logaddexp(0, np.where(outcome, -1, 1) * own)[~absent].mean()
    with pytest.raises(InputError, match="no pose"):
        fit_scenes(rows | {"reported": np.zeros(len(logits), dtype=bool)}, logits, FitOptions())


def test_a_model_that_turns_the_order_of_poses_round_is_refused() -> None:
    rows, logits = in_scenes(0)
    with pytest.raises(InputError, match="give more bins"):
        fit_scenes(rows, -logits, FitOptions())


def test_so_many_searches_count_as_in_vain_as_are_asked_for() -> None:
    rows, logits = in_scenes(0)
    absent = ~np.isfinite(rows["error"])
    said = []
    for in_vain in (0.1, 0.5, 0.9):
        counts = fits._as_asked(rows, FitOptions(in_vain=in_vain))
        searches = [np.unique(rows["search"][of]) for of in (absent, ~absent)]
        weight = len(searches[0]) * counts[absent][0], len(searches[1]) * counts[~absent][0]
        assert weight[0] / sum(weight) == pytest.approx(in_vain)
        _, _, held_out, results = fit_scenes(rows, logits, FitOptions(in_vain=in_vain))
        assert results["summary"]["expected calibration error"] < 0.06
        said.append(held_out.mean())
    assert said[0] > said[1] > said[2]
    everywhere = {name: values[~absent] for name, values in rows.items()}
    np.testing.assert_array_equal(fits._as_asked(everywhere, FitOptions()), 1)
    for wrong in (0.0, 1.0, np.nan):
        with pytest.raises(InputError, match="in_vain"):
            FitOptions(in_vain=wrong)


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
    weights = fits._weights(rows, FitOptions())
    np.testing.assert_allclose([weights[:100].sum(), weights[100:].sum()], [125 * 2 / 3, 125 / 3])
    rows["error"][0] = np.inf  # the object is not there
    first, second = fits._weights(rows, FitOptions(absent_weight=3))[:2]
    np.testing.assert_allclose(first, 3 * second)
    rows["reported"][1] = True
    first, second, third = fits._weights(rows, FitOptions(absent_weight=3, reported_weight=8))[:3]
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
