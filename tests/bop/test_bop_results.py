from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.bop import BopEstimate, write_results
from kmn_jax.errors import InputError
from tests.bop.bop_sample import rotation

HEADER = "scene_id,im_id,obj_id,score,R,t,time\n"


def estimates() -> list[BopEstimate]:
    generator = np.random.default_rng(0)
    result = []
    for scene_id, image_id, object_id in ((3, 7, 1), (3, 7, 2), (0, 12, 1)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation(generator), generator.normal(size=3)
        result.append(BopEstimate(scene_id, image_id, object_id, float(generator.random()), pose, 0.25 + scene_id))
    return result


def test_rows_hold_all_digits_in_millimetres(tmp_path: Path) -> None:
    path, wrote = tmp_path / "results.csv", estimates()
    write_results(path, wrote, "m")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row, want in zip(rows, wrote, strict=True):
        assert (int(row["scene_id"]), int(row["im_id"]), int(row["obj_id"])) == (
            want.scene_id,
            want.image_id,
            want.object_id,
        )
        assert (float(row["score"]), float(row["time"])) == (want.score, want.seconds)
        turned, moved = (np.array(row[name].split(), dtype=float) for name in ("R", "t"))
        np.testing.assert_array_equal(turned.reshape(3, 3), want.T_camera_object[:3, :3])
        np.testing.assert_array_equal(moved, want.T_camera_object[:3, 3] * 1000)


def test_the_format_is_that_of_the_benchmark(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = [0.001, 0.002, 0.5]
    write_results(tmp_path / "r.csv", [BopEstimate(1, 2, 3, 0.75, pose, 0.5)], "m")
    rows = "1,2,3,0.75,0.0 -1.0 0.0 1.0 0.0 0.0 0.0 0.0 1.0,1.0 2.0 500.0,0.5\n"
    assert (tmp_path / "r.csv").read_text() == HEADER + rows
    write_results(tmp_path / "none.csv", [], "m")
    assert (tmp_path / "none.csv").read_text() == HEADER


def test_times_of_an_image_may_differ_by_rounding(tmp_path: Path) -> None:
    first = estimates()[0]
    write_results(tmp_path / "r.csv", [first, replace(first, seconds=first.seconds + 4e-4)], "mm")
    assert (tmp_path / "r.csv").read_text().count("\n") == 3


def test_what_breaks_the_rules_is_not_written(tmp_path: Path) -> None:
    first = estimates()[0]
    bad_pose, bad_row, bad_place = (first.T_camera_object.copy() for _ in range(3))
    bad_pose[:3, :3] *= 2
    bad_row[3, 0] = 1
    bad_place[0, 3] = np.inf
    for bad, message in (
        (replace(first, score=float("nan")), "estimate 1: score is nan and time 3.25 s, but both must be finite"),
        (replace(first, seconds=float("inf")), "estimate 1: score is .* and time inf s, but both must be finite"),
        (replace(first, seconds=9.0), "estimate 1: time is 9 s, but 3.25 s before in image 7 of scene 3"),
        (replace(first, T_camera_object=bad_pose), "estimate 1: T_camera_object is not a rigid pose"),
        (replace(first, T_camera_object=bad_row), "estimate 1: T_camera_object is not a rigid pose"),
        (replace(first, T_camera_object=bad_place), "estimate 1: T_camera_object holds 1 values"),
    ):
        with pytest.raises(InputError, match=message):
            write_results(tmp_path / "r.csv", [first, bad], "mm")
    assert list(tmp_path.iterdir()) == []
