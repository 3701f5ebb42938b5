"""Datasets with broken images: the rest is evaluated, and what was left out is told on every run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from experiments import evaluate
from experiments.evaluation.cases import Image as Scan
from experiments.evaluation.cases import ObjectImages, draw_cases
from kmn_jax.bop import dataset_digest
from kmn_jax.errors import InputError
from tests.bop.bop_sample import box_model, save_image
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


def test_scans_that_show_too_little_are_told_and_a_run_of_nothing_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "data"
    shutil.copytree(SMALL, folder)
    for path in (folder / GEARS / "depth").glob("*.png"):
        save_image(path, np.zeros_like(np.asarray(Image.open(path))))
    options = ["--folder", str(folder), "--images", "2", "--methods", "fpfh", "--crops", "2", "--noise", "0"]
    assert evaluate.main(["bop", *options, "--output", str(tmp_path / "out")]) == 0
    content = json.loads((tmp_path / "out" / "scores.json").read_text())
    assert "gear_motor" not in {cell["object"] for cell in content["cells"]}
    told = [line for line in content["left out"] if line.startswith("gear_motor")]
    assert len(told) == 2
    assert "0 of 1 crops: not enough was measured" in told[0]
    assert told[0] in capsys.readouterr().err
    alone = ["--objects", "gear_motor", "--output", str(tmp_path / "alone")]
    assert evaluate.main(["bop", *options, *alone]) == 2
    assert "gave no crop that can be evaluated: gear_motor, scan" in capsys.readouterr().err


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

    def __getitem__(self, row: int, /) -> Scan:
        self.read.append(row)
        if row == self.broken:
            raise InputError(f"scan {row} is broken")
        points = np.repeat(self.model.points @ self.pose[:3, :3].T + self.pose[:3, 3], 20, axis=0).astype(np.float32)
        return Scan(str(row), points, np.ones(len(points), dtype=bool), self.pose[None], np.ones(1))


def test_only_scans_of_which_crops_are_drawn_are_read() -> None:
    scans, problems = Scans(8, broken=3), list[str]()
    cases = list(draw_cases(ObjectImages("box", scans.model, scans), 4, 0.0, report=problems.append))
    assert scans.read == [1, 3, 5, 7]
    assert [case.name for case in cases] == ["1/0", "5/0", "7/0"]
    assert problems == ["scan 3 is broken"]
