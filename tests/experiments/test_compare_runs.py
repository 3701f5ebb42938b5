"""Two evaluations of the same crops: paired differences, and folders that cannot be compared."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import experiments
from experiments.compare_runs import main
from experiments.evaluation.cases import Case
from experiments.evaluation.predictions import Export, Predictions
from experiments.evaluation.sources import bop_objects

SMALL = Path(experiments.__file__).parent / "assets" / "small_test_set"
GEAR = "gear_motor"


@pytest.fixture(scope="module")
def names() -> list[str]:
    return [found.name for found in bop_objects(SMALL, "test", pytest.fail, most_images=1)]


def evaluation(folder: Path, names: list[str], right: int, crops: int = 8, scan: int = 0) -> Path:
    """Write a folder in which so many of the crops of each object, two a scan, have the right pose."""
    export = Export.open(folder, {"methods": {"ours": {}}}, overwrite=False)
    truth = np.eye(4)[None]
    cases = [Case(f"{scan}/{row // 2}/{row % 2}", np.zeros((1, 3), np.float32), truth, 0, 1.0) for row in range(crops)]
    poses = np.tile(np.eye(4), (crops, 1, 1))
    poses[right:, :3, 3] = 1e3
    seconds = np.ones(crops)
    for name in names:
        export.write_truth(name, 0.0, cases)
        export.write("ours", name, 0.0, Predictions(poses, poses, np.ones(crops, bool), seconds, seconds))
    return folder


def run(*folders: Path, **flags: str) -> int:
    options = {"dataset": str(SMALL), "noises": "0"} | flags
    return main([*map(str, folders), *(part for key, value in options.items() for part in (f"--{key}", value))])


def test_differences_are_paired_over_scans(
    names: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert GEAR in names
    before, after = evaluation(tmp_path / "a", names, 4), evaluation(tmp_path / "b", names, 6)
    assert run(before, after, json=str(tmp_path / "c.json")) == 0
    rows = json.loads((tmp_path / "c.json").read_text())["rows"]
    assert [row["method"] for row in rows] == ["ours", "ours + ICP"]
    for row in rows:
        assert (row["recall before"], row["recall after"], row["difference"]) == (0.5, 0.75, 0.25)
        assert row["crops"] == 8 * len(names)
        low, high = (float(end) for end in row["95% interval"].split(" to "))
        assert 0 <= low < 0.25 < high < 0.75
    assert "0.25" in capsys.readouterr().out
    assert run(before, before) == 0
    assert "+0.000 to +0.000" in capsys.readouterr().out


def test_what_cannot_be_compared_is_one_sentence(
    names: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = evaluation(tmp_path / "a", names, 4)
    other = evaluation(tmp_path / "b", names, 4, scan=1)
    for folder, message in ((other, "are not the same"), (tmp_path / "none", "is no folder of an evaluation")):
        assert run(before, folder) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1
    assert run(before, before, noises="0.05") == 2
    assert "has no crops with a noise of 0.05: name what it has by --noises" in capsys.readouterr().err
