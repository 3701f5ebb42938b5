"""Which candidates are refined: the best of each place, and others where that one becomes no sure pose."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kmn_jax.detection import (
    COMPANY,
    EVIDENCE,
    Calibration,
    Candidates,
    Choice,
    Clock,
    DetectConfig,
    Probabilities,
    SearchConfig,
    choose_and_refine,
)
from kmn_jax.detection import _choice as choosing
from kmn_jax.errors import InputError
from tests.detection.box_sample import box_view
from tests.detection.test_selection import BOX, on_device
from tests.reference.meshes import pose

CONFIG = DetectConfig()


def by(column: int) -> Calibration:
    return Calibration(EVIDENCE, tuple(float(row == column) for row in range(len(EVIDENCE))), 0.0)


# The first column of evidence is the log odds of a pose as it was found, the second those of a refined one.
MODELS = Probabilities(by(0), by(1), by(1), Calibration(COMPANY, (1.0, 0.0), -9.0))


def candidates(*rows: tuple[float, float]) -> Candidates:
    """Return candidates by where they lie and their log odds; each is known by its number of inliers."""
    places, odds = np.array(rows, dtype=np.float32).T
    poses = np.stack([pose((place, 0.0, 9.0), np.eye(3)) for place in places]).astype(np.float32)
    evidence = np.zeros((len(rows), len(EVIDENCE)), dtype=np.float32)
    evidence[:, 0] = odds
    count = np.arange(len(rows))
    nothing: Any = None
    return Candidates(poses, np.ones(len(rows), dtype=bool), evidence, count, count, nothing, count)


def chosen(
    monkeypatch: pytest.MonkeyPatch, found: Candidates, become: dict[int, list[float]], config: DetectConfig = CONFIG
) -> tuple[list[list[int]], Choice]:
    """Return which candidates are refined in each turn, and the choice; `become` are their log odds, each time."""
    turns: list[list[int]] = []

    def refined(part: object, scene: object, of: Candidates, rows: np.ndarray, *given: object) -> Candidates:
        """Move candidates away from the camera, and add a second form of each, which there is not."""
        numbers = of.num_inliers[rows].tolist()
        evidence = of.evidence[rows].copy()
        evidence[:, 1] = [become[number][sum(number in turn for turn in turns)] for number in numbers]
        turns.append(numbers)
        poses = of.T_camera_object[rows] + pose((0.0, 0.0, MOVE), np.zeros((3, 3))) * (np.arange(4) < 3)[:, None]
        columns = (poses.astype(np.float32), of.usable[rows], evidence, of.num_inliers[rows], of.crop[rows])
        both = [np.concatenate([column, column]) for column in columns]
        both[1][len(rows) :] = False
        return Candidates(both[0], both[1], both[2], both[3], both[4], of.found, of.seed_rows)

    monkeypatch.setattr(choosing, "refined_candidates", refined)
    return turns, choose_and_refine(found, MODELS, on_device(BOX), box_view(), 0, config, SearchConfig(), Clock())


def stand(choice: Choice) -> dict[int, float]:
    """Return which candidates stand, and their log odds."""
    rows = np.flatnonzero(choice.selection.kept)
    return dict(
        zip(choice.candidates.num_inliers[rows].tolist(), choice.candidates.evidence[rows, 1].tolist(), strict=True)
    )


MOVE = 0.001 * BOX.diameter
APART = 0.06 * BOX.diameter  # what is so far apart is refined for itself, but is one place
FAR = 9.0


def test_where_all_become_sure_no_others_are_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, 3.0), (APART, 0.0), (FAR, 3.0), (FAR + APART, 0.0))
    turns, choice = chosen(monkeypatch, found, {0: [4.0], 2: [5.0]})
    assert turns == [[0, 2]]
    assert stand(choice) == {0: 4.0, 2: 5.0}


def test_the_next_best_are_refined_until_one_is_sure(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, 3.0), (APART, 0.5), (2 * APART, 0.0), (-APART, -0.5), (FAR, 3.0), (FAR + APART, 0.0))
    turns, choice = chosen(monkeypatch, found, {0: [0.0], 1: [-1.0], 2: [3.0], 4: [4.0]})
    assert turns == [[0, 4], [1], [2]]
    assert stand(choice) == {2: 3.0, 4: 4.0}
    assert choice.probability[choice.selection.kept] == pytest.approx(1 / (1 + np.exp([-4.0, -3.0])))


def test_what_stays_doubtful_is_refined_once_more_from_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, 3.0), (APART, 0.0), (FAR, 4.0))
    turns, choice = chosen(monkeypatch, found, {0: [1.0, 2.0], 1: [0.0], 2: [5.0]})
    assert turns == [[0, 2], [1], [0]]
    assert stand(choice) == {0: 2.0, 2: 5.0}
    depth = choice.candidates.T_camera_object[choice.selection.kept, 2, 3]
    assert sorted(depth.tolist()) == pytest.approx([9.0 + MOVE, 9.0 + 2 * MOVE])


def test_what_would_become_the_same_pose_or_is_hardly_probable_is_not_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, 3.0), (0.02 * BOX.diameter, 1.0), (APART, -4.0))
    turns, _ = chosen(monkeypatch, found, {0: [0.0, 0.0]})
    assert turns == [[0], [0]]


def test_settings_say_how_many_are_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, 4.0), (APART, 3.0), (-APART, 2.0), (2 * APART, 1.0))
    become = {number: [0.0, 0.0] for number in range(4)}
    assert chosen(monkeypatch, found, become, replace(CONFIG, next_best=1))[0] == [[0], [1], [0]]
    assert chosen(monkeypatch, found, become, replace(CONFIG, next_best=0, sure=0.0))[0] == [[0]]
    assert len(chosen(monkeypatch, found, become)[0]) == 5
    with pytest.raises(InputError, match="next_best = -1"):
        DetectConfig(next_best=-1)
    with pytest.raises(InputError, match="sure = 2"):
        DetectConfig(sure=2.0)


def test_where_nothing_is_probable_nothing_is_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, -5.0), (FAR, -6.0))
    turns, choice = chosen(monkeypatch, found, {})
    assert turns == []
    assert not choice.selection.kept.any()
    assert choice.probability == pytest.approx(1 / (1 + np.exp([5.0, 6.0])))
