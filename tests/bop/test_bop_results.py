from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.bop import BopEstimate, write_results
from kmn_jax.bop._results import HEADER, read_results
from kmn_jax.errors import InputError
from tests.bop.bop_sample import rotation

ROTATION = "1 0 0 0 1 0 0 0 1"


def estimates() -> list[BopEstimate]:
    generator = np.random.default_rng(0)
    result = []
    for scene_id, image_id, object_id in ((3, 7, 1), (3, 7, 2), (0, 12, 1)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation(generator), generator.normal(size=3)
        result.append(BopEstimate(scene_id, image_id, object_id, float(generator.random()), pose, 0.25 + scene_id))
    return result


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    wrote = estimates()
    write_results(path, wrote, "m")
    for got, want in zip(read_results(path, "m"), wrote, strict=True):
        assert replace(got, T_camera_object=want.T_camera_object) == want
        np.testing.assert_array_equal(got.T_camera_object[:3, :3], want.T_camera_object[:3, :3])
        np.testing.assert_allclose(got.T_camera_object, want.T_camera_object, rtol=1e-15)
    in_mm = read_results(path, "mm")
    np.testing.assert_allclose(in_mm[0].T_camera_object[:3, 3], wrote[0].T_camera_object[:3, 3] * 1000, rtol=1e-15)
    again = tmp_path / "again.csv"
    write_results(again, in_mm, "mm")
    assert again.read_bytes() == path.read_bytes()


def test_the_format_is_that_of_the_benchmark(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = [0.001, 0.002, 0.5]
    write_results(tmp_path / "r.csv", [BopEstimate(1, 2, 3, 0.75, pose, 0.5)], "m")
    assert (tmp_path / "r.csv").read_text() == (
        "scene_id,im_id,obj_id,score,R,t,time\n1,2,3,0.75,0.0 -1.0 0.0 1.0 0.0 0.0 0.0 0.0 1.0,1.0 2.0 500.0,0.5\n"
    )
    write_results(tmp_path / "none.csv", [], "m")
    assert read_results(tmp_path / "none.csv", "m") == ()


def test_files_of_others(tmp_path: Path) -> None:
    """Without a header, with spaces, other line ends, a blank last line, a time that is almost the same, or none."""
    rows = [
        f"1,1,1,1e-3,{ROTATION}, 1 2 3 ,0.5",
        f"1,1,2,2,{ROTATION},1 2 3,0.5004",
        f" 1,2,2,2,{ROTATION},1 2 3,-1",
        "",
    ]
    (tmp_path / "r.csv").write_bytes("\r\n".join(rows).encode())
    read = read_results(tmp_path / "r.csv", "mm")
    assert [(e.image_id, e.object_id, e.seconds) for e in read] == [(1, 1, 0.5), (1, 2, 0.5004), (2, 2, -1)]
    assert read[0].T_camera_object[:3, 3].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (f"1,1,1,1,{ROTATION},0 0 1", "has 6 comma-separated fields"),
        (f"a,1,1,1,{ROTATION},0 0 1,1", "scene_id is 'a', but must be a whole number"),
        (f"1,1.5,1,1,{ROTATION},0 0 1,1", "im_id is '1.5'"),
        (f"1,1,,1,{ROTATION},0 0 1,1", "obj_id is ''"),
        (f"1,1,1,,{ROTATION},0 0 1,1", "score holds 0 numbers, but must hold 1"),
        (f"1,1,1,nan,{ROTATION},0 0 1,1", "score holds NaN or infinity"),
        ("1,1,1,1,1 0 0 0 1 0 0 0,0 0 1,1", "R holds 8 numbers, but must hold 9"),
        ("1,1,1,1,1 0 0 0 1 0 0 0 x,0 0 1,1", "R holds '1 0 0 0 1 0 0 0 x', which is not a number"),
        ("1,1,1,1,1 0 0 0 1 0 0 0 -1,0 0 1,1", "R is not a rotation"),
        (f"1,1,1,1,{ROTATION},0 inf 1,1", "t holds NaN or infinity"),
        (f"1,1,1,1,{ROTATION},0 1,1", "t holds 2 numbers, but must hold 3"),
        (f"1,1,1,1,{ROTATION},0 0 1,1.1", "time is 1.1 s, but 1 s before in image 1 of scene 1"),
        (f"1,1,1,1,{ROTATION},0 0 1,", "time holds 0 numbers"),
        (HEADER, "scene_id is 'scene_id'"),
    ],
)
def test_a_broken_row_is_named_by_its_line(row: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text("\n".join([HEADER, f"1,1,1,1,{ROTATION},0 0 1,1", row]))
    with pytest.raises(InputError, match=message) as raised:
        read_results(path, "mm")
    assert f"{path}, line 3: " in str(raised.value)


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read_results(tmp_path / "absent.csv", "mm")
    for content, message in ((b"", "is empty"), (b"\xff\xfe\x00", "is not a text file")):
        (tmp_path / "r.csv").write_bytes(content)
        with pytest.raises(InputError, match=message):
            read_results(tmp_path / "r.csv", "mm")


def test_what_breaks_the_rules_is_not_written(tmp_path: Path) -> None:
    first = estimates()[0]
    bad_pose, bad_row = first.T_camera_object.copy(), first.T_camera_object.copy()
    bad_pose[:3, :3] *= 2
    bad_row[3, 0] = 1
    for bad, message in (
        (replace(first, score=float("nan")), "estimate 1: score holds NaN"),
        (replace(first, seconds=9.0), "estimate 1: time is 9 s, but 3.25 s before in image 7 of scene 3"),
        (replace(first, T_camera_object=bad_pose), "estimate 1: R is not a rotation"),
        (replace(first, T_camera_object=bad_row), "estimate 1: the last row of T_camera_object"),
    ):
        with pytest.raises(InputError, match=message):
            write_results(tmp_path / "r.csv", [first, bad], "mm")
    assert list(tmp_path.iterdir()) == []
