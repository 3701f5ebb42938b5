"""How long a bin is searched: until seeds are near to all of it, or poses explain it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kmn_jax.detection import (
    EVIDENCE,
    NUM_SEEDS,
    THOROUGH,
    Calibration,
    Candidates,
    Clock,
    CropPoses,
    DetectConfig,
    Prediction,
    Scene,
    candidates_of,
    explore,
    seeds_over,
)
from kmn_jax.detection._coverage import (
    AMONG,
    SEARCHED,
    SEARCHED_FINELY,
    _crowded,
    cover,
    near_surface,
    nothing_covered,
    to_search,
    unexplained,
)
from kmn_jax.detection._detect import narrowing
from kmn_jax.detection._seeds import SPACING
from kmn_jax.errors import InputError
from kmn_jax.pose import PoseResult
from tests.detection.box_sample import POSES, SIZES, WALL, box_part, box_view

SURE = Calibration(EVIDENCE, (0.0,) * len(EVIDENCE), 3.0)
QUICK = DetectConfig()
DIAMETER = 0.8


PART = replace(box_part(), diameter=DIAMETER)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return box_view()


def answer(scene: Scene, rows: np.ndarray, there: bool) -> Candidates:
    """Return a pose at each seed, or none."""
    count = len(rows)
    poses = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1, 1))
    poses[:, 0, :3, 3] = scene.points[rows]
    columns = np.zeros((count, 1), dtype=np.float32)
    found = np.full((count, 1), there)
    result = PoseResult(poses, columns, columns, columns, np.zeros((count, 1, 1), bool), found, columns)
    points = np.zeros((count, 4, 3), np.float32)
    prediction = Prediction(points, points, points[..., 0] == 0, points[..., :2], points)
    crops = CropPoses(result, columns, prediction, scene.points[rows], np.ones(count, bool))
    return candidates_of(crops, np.zeros((count, 1, len(EVIDENCE)), np.float32), rows)


def rounds(
    scene: Scene, found_from: int, config: DetectConfig, calibration: Calibration = SURE
) -> tuple[list[np.ndarray], tuple[str, ...]]:
    """Return the seeds of each round, of which those before `found_from` find a part at each, and warnings."""
    asked: list[np.ndarray] = []

    def propose(rows: np.ndarray) -> Candidates:
        asked.append(scene.points[rows])
        return answer(scene, rows, len(asked) < found_from)

    _, warnings = explore(scene, PART, propose, calibration, config, Clock())
    return asked, warnings


def nearest_seeds(asked: list[np.ndarray], scene: Scene) -> np.ndarray:
    return np.linalg.norm(scene.points[::50, None] - np.concatenate(asked)[None], axis=2).min(axis=1)


def test_a_bin_is_searched_until_a_seed_is_near_to_all_of_it(scene: Scene) -> None:
    asked, found = rounds(scene, 0, THOROUGH)
    assert len(asked[0]) == NUM_SEEDS
    assert max(len(seeds) for seeds in asked[1:]) == THOROUGH.later_seeds
    seeds = np.concatenate(asked)
    apart = np.linalg.norm(seeds[:, None] - seeds[None], axis=2)[np.triu_indices(len(seeds), 1)]
    assert apart.min() > SEARCHED_FINELY * DIAMETER
    # But for a few stray points, and what is between the spacing of seeds and the reach of one.
    assert np.mean(nearest_seeds(asked, scene) <= SPACING * DIAMETER) > 0.98
    assert not found


def test_where_nothing_is_found_it_is_searched_coarsely(scene: Scene) -> None:
    fine, coarse = (rounds(scene, 0, config)[0] for config in (THOROUGH, QUICK))
    assert len(np.concatenate(coarse)) < len(np.concatenate(fine))
    assert np.mean(nearest_seeds(coarse, scene) <= 1.1 * SEARCHED * DIAMETER) > 0.98
    assert np.isin(np.concatenate(coarse), np.concatenate(fine)).all()  # it only ends earlier


def test_doubtful_poses_are_a_reason_to_go_on_but_cover_nothing(scene: Scene) -> None:
    doubtful = Calibration(EVIDENCE, (0.0,) * len(EVIDENCE), float(np.log(0.3 / 0.7)))
    patient, hasty, none, likely, barely_likely = (
        np.concatenate(rounds(scene, until, config, calibration)[0])
        for until, config, calibration in (
            (99, QUICK, doubtful),
            (99, replace(QUICK, promising=0.5), doubtful),
            (0, QUICK, doubtful),
            (99, QUICK, SURE),
            (99, replace(QUICK, likely=0.2, promising=0.5), doubtful),
        )
    )
    assert len(hasty) == len(none) < len(patient)
    assert len(likely) < len(patient)
    np.testing.assert_array_equal(barely_likely, likely)  # what is likely is a reason to go on, too


def test_a_search_that_is_given_up_says_so(scene: Scene) -> None:
    asked, found = rounds(scene, 0, DetectConfig(most_seeds=40, later_seeds=5))
    assert [len(seeds) for seeds in asked] == [NUM_SEEDS, 5, 5]
    assert "of the foreground was not searched" in found[0]


def test_likely_poses_cover_what_they_explain(scene: Scene) -> None:
    nothing, something = (rounds(scene, until, THOROUGH)[0] for until in (0, 99))
    assert len(np.concatenate(something)) < len(np.concatenate(nothing))


def test_seeds_are_no_more_than_asked_for_or_needed(scene: Scene) -> None:
    assert len(seeds_over(scene, scene.foreground, PART, 7)) == 7
    one_point = np.zeros_like(scene.foreground)
    one_point[0] = True
    assert len(seeds_over(scene, one_point, PART)) == 1


@pytest.mark.parametrize(
    "values",
    [{"most_seeds": 0}, {"later_seeds": 0}, {"reported": 0.9}, {"likely": 1.5}, {"promising": -0.1}, {"patience": 0}],
)
def test_contradictory_values_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(values))):
        DetectConfig(**values)  # type: ignore[arg-type]


def test_points_know_whether_a_seed_is_near(scene: Scene) -> None:
    rows = np.array([0, len(scene.points) // 2])
    none = np.zeros(2, dtype=bool)
    state = cover(nothing_covered(scene), scene, PART, answer(scene, rows, False), none, none, 0.1)
    away = np.linalg.norm(scene.points[:, None] - scene.points[rows][None], axis=2).min(axis=1)
    for share in (SEARCHED, SEARCHED_FINELY):
        np.testing.assert_array_equal(
            (state.away > share * DIAMETER)[state.left], (away > share * DIAMETER)[state.left]
        )
    assert 0 < (state.away[state.left] > SEARCHED * DIAMETER).mean() < 1


def test_it_is_searched_finely_among_promising_poses_or_everywhere(scene: Scene) -> None:
    part = replace(PART, diameter=0.5)
    everywhere = nothing_covered(scene)
    everywhere = everywhere._replace(away=np.full_like(everywhere.away, 0.3 * part.diameter))
    assert SEARCHED_FINELY < 0.3 < SEARCHED
    place = scene.points[[0]].astype(np.float64)
    among = everywhere._replace(places=place)
    near = np.linalg.norm(scene.points - place, axis=1) < AMONG * part.diameter
    assert 0.01 < near.mean() < 0.9
    np.testing.assert_array_equal(to_search(among, scene, part, 3), _crowded(near, scene, part))
    for state, patience in ((everywhere, 3), (among, None)):
        np.testing.assert_array_equal(to_search(state, scene, part, patience), _crowded(everywhere.left, scene, part))
    for state in (everywhere, among):
        assert not to_search(state._replace(barren=3), scene, part, 3).any()


def test_what_lies_on_no_pose_is_unexplained(scene: Scene) -> None:
    part, everything = box_part(), np.ones(len(scene.points), dtype=bool)
    one, both = (unexplained(everything, scene, part, np.stack(POSES)[:n]) for n in (1, 2))
    on_wall = scene.points[:, 2] > WALL - 1e-3
    beside = (np.abs(scene.points[:, 0]) > POSES[1][0, 3] + SIZES[0]) | (np.abs(scene.points[:, 1]) > 2 * SIZES[1])
    assert not both[~on_wall].any()
    assert both[on_wall & beside].all()
    np.testing.assert_array_equal(one[~on_wall], scene.points[~on_wall, 0] > 0)
    assert not unexplained(~everything, scene, part, np.stack(POSES)).any()


def test_points_are_near_to_a_surface_as_they_are_to_any_of_its_points() -> None:
    rng = np.random.default_rng(0)
    surface = rng.uniform((20, -1, 3), (60, 1, 4), (300, 3))  # long, and far from its origin
    poses = np.tile(np.eye(4), (3, 1, 1))
    for pose in poses:
        turned, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        pose[:3, :3], pose[:3, 3] = turned * np.sign(np.linalg.det(turned)), rng.uniform(-30, 30, 3)
    placed = np.concatenate([surface @ pose[:3, :3].T + pose[:3, 3] for pose in poses])
    points = np.concatenate([placed[::9] + rng.normal(size=(100, 3)) * 2, rng.uniform(-80, 80, (200, 3))])
    away = np.linalg.norm(points[:, None] - placed[None], axis=2).min(axis=1)
    found = near_surface(points, surface, poses, 2.0)
    np.testing.assert_array_equal(found, away < 2.0)
    assert 40 < found.sum() < 200
    assert not near_surface(points, surface, poses[:0], 2.0).any()


def test_poses_that_pile_up_on_a_plane_bring_a_warning() -> None:
    evidence = np.zeros((4, len(EVIDENCE)), dtype=np.float32)
    assert narrowing(evidence, 0.1) == ()
    evidence[:3, EVIDENCE.index("coplanar")] = 0.9
    (flush,) = narrowing(evidence, 0.1)
    assert flush.startswith("3 poses lie flush in a larger surface")
    assert all(flag in flush for flag in ("--background", "--roi"))
    (left,) = narrowing(evidence[3:], 0.7)
    assert left.startswith("70% of the foreground is on no pose")
