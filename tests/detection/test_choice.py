"""Which candidates are refined: the best of each place, and others where that one is not sure."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
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
    DevicePart,
    Probabilities,
    SearchConfig,
    choose_and_refine,
    same_place,
)
from kmn_jax.detection import _choice as choosing
from kmn_jax.errors import InputError
from kmn_jax.objects._symmetry import rotation_about
from kmn_jax.pose import mssd
from tests.detection.box_sample import box_view
from tests.reference.meshes import pose
from tests.reference.parts import box_part, on_device

BOX = box_part()
Z = np.array([0.0, 0.0, 1.0])
CONFIG = DetectConfig()


def by(column: int) -> Calibration:
    return Calibration(EVIDENCE, tuple(float(row == column) for row in range(len(EVIDENCE))), 0.0)


# The first column of evidence is the log odds of a pose as it was found, the second those of a refined one, of which
# none tells anything of another.
MODELS = Probabilities(by(0), by(1), by(1), Calibration(COMPANY, (1.0, 0.0), 0.0))


def candidates(*rows: tuple[float, float]) -> Candidates:
    """Return candidates by where they lie and their log odds; each is known by its number of inliers."""
    places, odds = np.array(rows, dtype=np.float32).T
    poses = np.stack([pose((place, 0.0, 9.0), np.eye(3)) for place in places]).astype(np.float32)
    evidence = np.zeros((len(rows), len(EVIDENCE)), dtype=np.float32)
    evidence[:, 0] = odds
    count = np.arange(len(rows))
    nothing: Any = None
    return Candidates(poses, np.ones(len(rows), dtype=bool), evidence, count, count, nothing, count)


def refine(
    monkeypatch: pytest.MonkeyPatch,
    found: Candidates,
    become: dict[int, list[float]],
    config: DetectConfig = CONFIG,
    turned: dict[int, float] | None = None,
    part: DevicePart | None = None,
    models: Probabilities = MODELS,
) -> tuple[list[list[int]], Choice]:
    """Return which candidates are refined in each turn, and the choice.

    `become` are their log odds, each time that they are refined, `turned` those of another form of some.
    """
    turns: list[list[int]] = []

    def refined(
        part: object, scene: object, of: Candidates, rows: np.ndarray, seed: int, search: object, starts: Any = None
    ) -> Candidates:
        """Move candidates away from the camera, those of another form twice as far."""
        numbers = of.num_inliers[rows].tolist()
        evidence = np.tile(of.evidence[rows], (2, 1))
        own = [become[number][sum(number in turn for turn in turns)] for number in numbers]
        evidence[:, 1] = [*own, *((turned or {}).get(number, 0.0) for number in numbers)]
        usable = np.array([*(True for _ in numbers), *(number in (turned or {}) for number in numbers)])
        turns.append(numbers)
        poses = np.tile(of.T_camera_object[rows] if starts is None else starts, (2, 1, 1))
        poses[:, 2, 3] += np.repeat([MOVE, 2 * MOVE], len(rows))
        columns = (np.tile(of.num_inliers[rows], 2), np.tile(of.crop[rows], 2))
        return Candidates(poses, usable, evidence, *columns, of.found, of.seed_rows)

    monkeypatch.setattr(choosing, "refined_candidates", refined)
    part = part or on_device(BOX)
    return turns, choose_and_refine(found, models, part, box_view(), 0, config, SearchConfig(), Clock())


def stand(choice: Choice) -> dict[int, float]:
    """Return which candidates stand, and their log odds."""
    rows = np.flatnonzero(choice.selection.kept)
    return dict(
        zip(choice.candidates.num_inliers[rows].tolist(), choice.candidates.evidence[rows, 1].tolist(), strict=True)
    )


MOVE = 0.001 * BOX.diameter
APART = 0.06 * BOX.diameter  # what is so far apart is refined for itself, but is one place
FAR = 9.0
SIDEWAYS = np.diag(np.float32([-1, -1, 1, 1]))


def test_where_all_become_sure_no_others_are_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, 3.0), (APART, 0.0), (FAR, 3.0), (FAR + APART, 0.0))
    turns, choice = refine(monkeypatch, found, {0: [4.0], 2: [5.0]})
    assert turns == [[0, 2]]
    assert stand(choice) == {0: 4.0, 2: 5.0}


def test_the_next_best_are_refined_until_one_is_sure(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, 3.0), (APART, 0.5), (2 * APART, 0.0), (-APART, -0.5), (FAR, 3.0), (FAR + APART, 0.0))
    turns, choice = refine(monkeypatch, found, {0: [0.0], 1: [-1.0], 2: [3.0], 4: [4.0]})
    assert turns == [[0, 4], [1], [2]]
    assert stand(choice) == {2: 3.0, 4: 4.0}
    assert choice.probability[choice.selection.kept] == pytest.approx(1 / (1 + np.exp([-4.0, -3.0])))


def test_what_stays_doubtful_is_refined_once_more_from_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, 3.0), (APART, 0.0), (FAR, 4.0))
    turns, choice = refine(monkeypatch, found, {0: [1.0, 2.0], 1: [0.0], 2: [5.0]})
    assert turns == [[0, 2], [1], [0]]
    assert stand(choice) == {0: 2.0, 2: 5.0}
    depth = choice.candidates.T_camera_object[choice.selection.kept, 2, 3]
    assert sorted(depth.tolist()) == pytest.approx([9.0 + MOVE, 9.0 + 2 * MOVE])


def test_forms_of_candidates_that_were_refined_later_are_known_by_them(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, 3.0), (FAR, 2.0), (APART, 0.0), (FAR + APART, -0.5), (-FAR, 4.0))
    become = {0: [0.0], 1: [0.1], 2: [0.2, 0.3], 3: [0.4, 2.0], 4: [5.0]}
    turns, choice = refine(monkeypatch, found, become, turned={3: 1.0})
    assert turns == [[0, 1, 4], [2, 3], [2, 3]]
    assert stand(choice) == pytest.approx({2: 0.3, 3: 2.0, 4: 5.0})
    depth = choice.candidates.T_camera_object[choice.selection.kept, 2, 3]
    assert depth.tolist() == pytest.approx([9.0 + MOVE, 9.0 + 2 * MOVE, 9.0 + 3 * MOVE])


@pytest.mark.parametrize(("odds", "listed"), [(0.5, {2: 0.3, 3: 0.5, 4: 5.0}), (-20.0, {2: 0.3, 4: 5.0})])
def test_what_is_taken_for_another_form_has_evidence_of_its_own(
    monkeypatch: pytest.MonkeyPatch, odds: float, listed: dict[int, float]
) -> None:
    """It is known by the candidate that it was made of, and as little reported as any if it is improbable."""
    found = candidates((0.0, 3.0), (FAR, 2.0), (APART, 0.0), (FAR + APART, -0.5), (-FAR, 4.0))
    become = {0: [0.0], 1: [0.1], 2: [0.2, 0.3], 3: [0.4, 2.0], 4: [5.0]}
    made_of: list[int] = []

    def disambiguate(poses: np.ndarray, *_: object) -> tuple[np.ndarray, np.ndarray]:
        is_other = poses[:, 0, 3] > 8.0
        return np.where(is_other[:, None, None], poses @ SIDEWAYS, poses), is_other

    def with_evidence(of: Candidates, rows: np.ndarray, poses: np.ndarray, there: np.ndarray, *_: object) -> Candidates:
        assert there.tolist() == [[True, False]]
        made_of.extend(of.num_inliers[rows].tolist())
        evidence = of.evidence[rows].copy()
        evidence[:, 1] = odds
        return Candidates(poses[:, 0], there[:, 0], evidence, of.num_inliers[rows], of.crop[rows], of.found, rows)

    monkeypatch.setattr(choosing, "disambiguate", disambiguate)
    monkeypatch.setattr(choosing, "_with_evidence", with_evidence)
    _, choice = refine(monkeypatch, found, become, turned={3: 1.0})
    assert made_of == [3]
    assert stand(choice) == pytest.approx(listed)
    ways = choice.candidates.T_camera_object[choice.selection.kept, 0, 0]
    assert sorted(ways.tolist()) == [-1.0] * (3 in listed) + [1.0, 1.0]


def test_what_would_become_the_same_pose_or_is_hardly_probable_is_not_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, 3.0), (0.02 * BOX.diameter, 1.0), (APART, -4.0), (FAR, 4.0))
    turns, _ = refine(monkeypatch, found, {0: [0.0, 0.0], 3: [5.0]})
    assert turns == [[0, 3], [0]]


def test_where_nothing_is_sure_no_others_are_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, 3.0), (APART, 1.0), (FAR, 4.0))
    become = {0: [0.0, 0.1], 1: [0.0], 2: [2.0, 2.1]}
    assert refine(monkeypatch, found, become)[0] == [[0, 2]]
    become[2] = [2.5]
    assert refine(monkeypatch, found, become)[0] == [[0, 2], [1], [0]]


def test_where_nothing_stands_no_others_are_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two places with candidates to try, in one the pose that was refined is too improbable to be reported."""
    found = candidates((0.0, 3.0), (APART, 2.0), (FAR, 3.0), (FAR + APART, 2.0), (-FAR, 4.0))
    turns, choice = refine(monkeypatch, found, {0: [-3.0], 2: [-2.0, -2.0], 3: [-1.0, -1.0], 4: [5.0]})
    assert turns == [[0, 2, 4], [3], [3]]
    assert stand(choice) == {3: -1.0, 4: 5.0}


def test_what_is_hardly_probable_where_none_is_sure_is_not_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, 3.0), (FAR, 3.0), (-FAR, 3.0))
    doubt = replace(MODELS, together=Calibration(COMPANY, (1.0, 1.0), -5.0))
    for best, others in ((2.0, {0: 2.0}), (6.0, {0: 6.0, 1: -1.0})):
        turns, choice = refine(monkeypatch, found, {0: [best], 1: [-1.0] * 2, 2: [-3.0]}, models=doubt)
        assert stand(choice) == pytest.approx(others)
        said = choice.probability[choice.selection.kept]
        told = np.array(list(others.values())) + min(best, 5.0) - 5.0
        assert sorted(said) == pytest.approx(sorted(1 / (1 + np.exp(-told))))
        assert (said >= CONFIG.reported).all()
    assert turns == [[0, 1, 2], [1]]


def test_what_looks_like_one_that_was_tried_is_not_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, 3.0), (0.0, 1.0), (FAR, 4.0))
    half = np.diag([-1.0, -1.0, 1.0, 1.0])
    found.T_camera_object[1] @= half
    become = {0: [0.0, 0.0], 1: [0.0], 2: [5.0]}
    assert refine(monkeypatch, found, become)[0] == [[0, 2], [1], [0]]
    part = on_device(BOX)._replace(symmetries=jnp.asarray(np.stack([np.eye(4), half]), jnp.float32))
    assert refine(monkeypatch, found, become, part=part)[0] == [[0, 2], [0]]


def test_what_is_in_the_places_of_sure_poses_is_not_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is more probable than the next best one of an unsure pose's place."""
    copies, others = 20, np.arange(1, 7) * 0.03 * BOX.diameter
    assert others.max() < same_place(BOX)
    rows = [
        (FAR * copy + other, odds)
        for copy in range(copies)
        for other, odds in [(0.0, 4.0), *((x, 3.0) for x in others)]
    ]
    place = -FAR
    found = candidates(*rows, (place, 3.5), (place - APART, 1.5))
    sure = range(0, 7 * copies, 7)
    turns, choice = refine(monkeypatch, found, {**{row: [5.0] for row in sure}, 140: [0.0], 141: [4.5]})
    assert turns[1:] == [[141]]
    assert stand(choice)[141] == 4.5


def test_the_surest_copies_leave_room_for_all_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a full bin, hundreds of candidates lie at the copies that are seen best."""
    sure = [(FAR * copy, 4.0) for copy in range(20) for _ in range(10)]
    doubtful = [(-FAR * copy, 1.0) for copy in range(1, 31)]
    found = candidates(*sure, *doubtful)
    first, others = range(0, len(sure), 10), range(len(sure), len(sure) + len(doubtful))
    turns, choice = refine(monkeypatch, found, {**{row: [4.0] for row in first}, **{row: [3.0] for row in others}})
    assert turns == [[*first, *others]]
    assert sorted(stand(choice)) == [*first, *others]


def test_what_may_be_of_a_sure_poses_copy_is_in_no_unsure_place() -> None:
    """Between two poses that stand, a third one may be of either's copy."""
    half = 0.9 * same_place(BOX)
    places = [pose((place * half, 0.0, 9.0), np.eye(3)) for place in (-2, -1, 0, 1)]
    poses = np.stack(places).astype(np.float32)
    are_unsure = choosing.in_unsure_places(poses, poses[1:2], poses[3:], on_device(BOX))
    assert are_unsure.tolist() == [True, True, False, False]


def test_many_symmetries_are_compared_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    turns = [rotation_about(Z, angle) for angle in np.linspace(0, 2 * np.pi, 36, endpoint=False)]
    part = on_device(box_part(rotations=np.array(turns)))
    rng = np.random.default_rng(0)
    poses = np.stack([pose(rng.normal(size=3) * 0.02, turns[row] @ tilt) for row, tilt in enumerate(tilts(36))])
    tried = np.stack([pose((0.0, 0.0, 0.0), turns[5]), pose((0.05, 0.0, 0.0), np.eye(3))])
    poses, tried = poses.astype(np.float32), tried.astype(np.float32)
    points, limit = np.asarray(part.arrays.points)[:16], 0.05 * BOX.diameter
    nearest = [min(mssd(one, other, points, part.symmetries) for other in tried) for one in poses]
    wanted = np.array(nearest) <= limit
    assert 5 < wanted.sum() < 31
    np.testing.assert_array_equal(choosing._alike(poses, tried, part), wanted)
    monkeypatch.setattr(choosing, "_NUMBERS", 1)
    np.testing.assert_array_equal(choosing._alike(poses, tried, part), wanted)


def tilts(count: int) -> list[np.ndarray]:
    """Return small rotations about x, up to 0.3."""
    return [rotation_about(np.array([1.0, 0, 0]), angle) for angle in np.linspace(0, 0.3, count)]


def test_settings_say_how_many_are_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    others = ((APART, 3.0), (-APART, 2.0), (2 * APART, 1.0), (-2 * APART, 0.5), (3 * APART, 0.2))
    found = candidates((0.0, 4.0), *others, (FAR, 4.0))
    become = {number: [0.0, 0.0] for number in range(6)} | {6: [5.0]}
    assert refine(monkeypatch, found, become)[0] == [[0, 6], [1], [2], [3], [4], [0]]
    assert refine(monkeypatch, found, become, replace(CONFIG, next_best=1))[0] == [[0, 6], [1], [0]]
    assert refine(monkeypatch, found, become, replace(CONFIG, next_best=0))[0] == [[0, 6], [0]]
    assert refine(monkeypatch, found, become, replace(CONFIG, next_best=0, sure=0.0))[0] == [[0, 6]]
    with pytest.raises(InputError, match="next_best = -1"):
        DetectConfig(next_best=-1)
    with pytest.raises(InputError, match="sure = 2"):
        DetectConfig(sure=2.0)


def test_where_nothing_is_probable_nothing_is_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    found = candidates((0.0, -5.0), (FAR, -6.0))
    turns, choice = refine(monkeypatch, found, {})
    assert turns == []
    assert not choice.selection.kept.any()
    assert choice.probability == pytest.approx(1 / (1 + np.exp([5.0, 6.0])))
