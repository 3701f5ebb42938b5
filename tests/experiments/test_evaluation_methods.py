"""Where a method crops again, from poses that are given: nothing is searched."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments.evaluation import methods
from experiments.evaluation.cases import Case
from experiments.evaluation.configs import CROPS_AGAIN, METHODS, find_config
from experiments.evaluation.methods import ONE_RANSAC, Ours
from tests.reference.networks import TINY

POINTS = np.array([[x, 0, 500] for x in (0, 10, 20, 30, 40)], dtype=np.float32)
MIDDLE = np.array([1.0, 2.0, 3.0])  # of the object's points


def poses_of(monkeypatch: pytest.MonkeyPatch, crops_again: bool, *places: float | None) -> tuple[Any, list[int]]:
    """The pose of a case of which searches find the middle of the object at these places along x, and their rows."""
    rows: list[int] = []

    def poses_at(model: Any, part: Any, cloud: Any, row: int, *rest: Any) -> Any:
        place, pose = places[len(rows)], np.eye(4, dtype=np.float32)
        rows.append(row)
        pose[:3, 3] = [place or 0, 0, 500] - MIDDLE
        return SimpleNamespace(poses=SimpleNamespace(T_scene_object=pose[None], converged=[place is not None]))

    part = SimpleNamespace(points=np.stack([MIDDLE - 1, MIDDLE + 1]))
    monkeypatch.setattr(methods, "poses_at", poses_at)
    monkeypatch.setattr(methods, "arrays_of", lambda model, part: part)
    monkeypatch.setattr(Ours, "part", lambda self, model: part)
    method: Any = Ours("ours", SimpleNamespace(config=TINY), ONE_RANSAC, crops_again=crops_again)  # type: ignore[arg-type]
    case = Case("a/0", POINTS, np.eye(4)[None], 0, 1.0)
    return method.prepare(SimpleNamespace())(case), rows


def test_the_second_crop_is_around_the_middle_of_the_first_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    pose, rows = poses_of(monkeypatch, True, 28.0, 31.0)
    assert rows == [0, 3]
    np.testing.assert_allclose(pose[:3, 3], [31 - 1, -2, 497])


def test_without_a_second_pose_the_first_one_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    pose, rows = poses_of(monkeypatch, True, 12.0, None)
    assert rows == [0, 1]
    np.testing.assert_allclose(pose[:3, 3], [12 - 1, -2, 497])


@pytest.mark.parametrize(("crops_again", "place"), [(False, 28.0), (True, None)])
def test_one_crop_is_enough_where_no_other_is_asked_for_or_nothing_is_found(
    monkeypatch: pytest.MonkeyPatch, crops_again: bool, place: float | None
) -> None:
    pose, rows = poses_of(monkeypatch, crops_again, place)
    assert rows == [0]
    assert (pose is None) == (place is None)


def test_it_is_run_only_where_it_is_named() -> None:
    assert CROPS_AGAIN not in METHODS
    assert CROPS_AGAIN not in find_config("validation").methods
