"""Datasets with broken images: the rest is evaluated, and what was left out is told on every run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from experiments import evaluate
from experiments.evaluation.cases import Image, ObjectImages, draw_cases
from kmn_jax.checks import InputError
from kmn_jax.data.bop import dataset_digest
from tests.data.bop_sample import box_model
from tests.reference.poses import some_poses

SMALL = Path(evaluate.__file__).parent / "assets" / "small_test_set"
GEARS = "test/000002"


def halved(path: Path) -> Path:
    """Cut a file in half."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    return path


def test_truncated_images_are_reported_on_every_run_and_the_rest_is_evaluated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, output = tmp_path / "data", tmp_path / "out"
    shutil.copytree(SMALL, folder)
    depth = halved(sorted((folder / GEARS / "depth").glob("*.png"))[1])
    mask = halved(sorted((folder / GEARS / "mask_visib").glob("000002_*.png"))[0])
    options = ["--folder", str(folder), "--objects", "gear_motor", "--methods", "fpfh", "--crops", "6", "--noise", "0"]
    told = []
    for _ in range(2):
        assert evaluate.main(["bop", *options, "--output", str(output)]) == 0
        errors = capsys.readouterr().err
        assert depth.name in errors
        assert mask.name in errors
        content = json.loads((output / "scores.json").read_text())
        told.append(content["left out"])
        assert content["cells"][0]["crops"] == 4  # of two of the three images that seemed whole
    assert told[0] == told[1]
    assert len(told[0]) == 2
    report = (output / "report.md").read_text()
    assert depth.name in report
    assert mask.name in report


def test_the_digest_of_damaged_images_is_that_of_their_bytes(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    shutil.copytree(SMALL, folder)
    path = halved(sorted((folder / GEARS / "depth").glob("*.png"))[0])
    damaged = dataset_digest(folder)
    assert damaged not in (dataset_digest(SMALL), "")
    assert dataset_digest(folder) == damaged
    halved(path)
    assert dataset_digest(folder) != damaged


class Scans:
    """Scans of which one cannot be read; `read` tells which were."""

    def __init__(self, count: int, broken: int) -> None:
        self.count, self.broken, self.read = count, broken, list[int]()
        self.model, self.pose = box_model(), some_poses(1)[0]

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, row: int, /) -> Image:
        self.read.append(row)
        if row == self.broken:
            raise InputError(f"scan {row} is broken")
        points = np.repeat(self.model.points @ self.pose[:3, :3].T + self.pose[:3, 3], 20, axis=0).astype(np.float32)
        return Image(str(row), points, np.ones(len(points), dtype=bool), self.pose[None], np.ones(1))


def test_only_scans_of_which_crops_are_drawn_are_read() -> None:
    scans, problems = Scans(8, broken=3), list[str]()
    cases = list(draw_cases(ObjectImages("box", scans.model, scans), 4, 0.0, report=problems.append))
    assert scans.read == [1, 3, 5, 7]
    assert [case.name for case in cases] == ["1/0", "5/0", "7/0"]
    assert problems == ["scan 3 is broken"]
