"""Which cases are drawn, on poses whose errors are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.evaluation.cases import Case, Image, ObjectImages, draw_cases
from experiments.evaluation.chosen import chosen_cases
from experiments.evaluation.configs import EvaluateConfig
from experiments.evaluation.pictures import Shown
from experiments.evaluation.predictions import Export, Predictions
from experiments.evaluation.scores import cells_of
from tests.bop.bop_sample import box_model
from tests.reference.poses import some_poses

TITLES = {"ours": "kmn_jax", "fpfh": "FPFH", "kiss": "KISS"}


@pytest.fixture
def box() -> ObjectImages:
    """One scan of one copy."""
    model, pose = box_model(), some_poses(1)[0]
    points = np.repeat(model.points @ pose[:3, :3].T + pose[:3, 3], 20, axis=0).astype(np.float32)
    scan = Image("1/0", points, np.ones(len(points), dtype=bool), pose[None], np.ones(1))
    return ObjectImages("box", model, (scan,))


def shown(folder: Path, box: ObjectImages, noises: tuple[float, ...], off: dict[str, list[float]]) -> list[Shown]:
    """Return what is drawn of methods whose poses are so many diameters away in each case; NaN is no pose."""
    config = EvaluateConfig("x", noise=noises, crops=len(off["ours"]))
    exported = Export.open(folder, {}, overwrite=False)
    for noise in noises:
        cases = list(draw_cases(box, config.crops, noise))
        exported.write_truth("box", noise, cases)
        for key, away in off.items():
            exported.write(key, "box", noise, _poses(cases, np.array(away) * box.model.diameter))
    cells = cells_of(exported, {"box": box.model}, {key: TITLES[key] for key in off}, noises)
    return chosen_cases(config, [box], exported, cells, TITLES, [key for key in off if key != "ours"])


def _poses(cases: list[Case], away: np.ndarray) -> Predictions:
    poses = np.stack([case.T_camera_object[0] for case in cases])
    poses[:, :3, 3] += np.nan_to_num(away)[:, None] * poses[:, :3, 2]
    seconds = np.zeros(len(cases))
    return Predictions(poses, poses, ~np.isnan(away), seconds, seconds)


def test_our_best_median_worst_and_lost_cases_are_drawn(tmp_path: Path, box: ObjectImages) -> None:
    found = shown(tmp_path, box, (0.0, 0.05), {"ours": [0.3, 0.0, np.nan, 0.1, 0.2]})
    assert [one.title for one in found[:4]] == [f"{name}, noise 0%" for name in ("best", "median", "worst", "lost 1")]
    assert [one.title for one in found[4:]] == [f"{name}, noise 5%" for name in ("best", "median", "worst", "lost 1")]
    assert [one.case.name for one in found[:4]] == ["1/0/1", "1/0/4", "1/0/0", "1/0/2"]
    assert found[3].T_camera_object is None
    assert all(one.rival is None for one in found)


def test_cases_that_only_a_rival_solves_are_drawn_with_both_poses(tmp_path: Path, box: ObjectImages) -> None:
    ours = [0.3, 0.3, np.nan, 0.0, 0.0, 0.0]
    rivals = {"fpfh": [0.02, 0.01, 0.0, 0.3, 0.0, 0.0], "kiss": [0.0, 0.3, 0.3, 0.3, 0.3, 0.3]}
    found = [one for one in shown(tmp_path, box, (0.0,), {"ours": ours, **rivals}) if one.rival is not None]
    assert [one.title for one in found] == ["FPFH is right, noise 0%"] * 2  # KISS finds fewer than we do
    assert [one.case.name for one in found] == ["1/0/2", "1/0/1"]
    lost, far = found
    assert lost.T_camera_object is None
    assert far.rival is not None
    assert far.rival.method == "FPFH"
    assert far.rival.error < 0.1 < far.error
    true = far.case.T_camera_object[0]
    assert np.linalg.norm(far.rival.T_camera_object - true) < np.linalg.norm(far.T_camera_object - true)


def test_the_largest_gap_comes_first_and_no_case_twice(tmp_path: Path, box: ObjectImages) -> None:
    rivals = {"fpfh": [0.3, 0.0, 0.0, 0.3, 0.3], "kiss": [0.3, 0.0, 0.0, 0.0, 0.0]}
    found = shown(tmp_path, box, (0.0, 0.01, 0.05), {"ours": [0.3] * 5, **rivals})
    beaten = [one for one in found if one.rival is not None]
    assert [one.title.split()[0] for one in beaten] == ["KISS"] * 3 + ["FPFH"] * 3
    assert len({(one.title, one.case.name) for one in beaten}) == 6
    for noise in ("noise 0%", "noise 1%", "noise 5%"):
        assert len({one.case.name for one in beaten if one.title.endswith(noise)}) == 2
