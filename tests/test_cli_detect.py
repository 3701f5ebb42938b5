"""`kmn prepare` and `kmn detect` as a user calls them: files in, files out, one sentence for bad input."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from kmn_jax.bop import bop_scan
from kmn_jax.cli import main
from kmn_jax.detection import FAST, THOROUGH, DetectConfig, Detections, PoseEstimator, Timing, config_of
from kmn_jax.errors import InputError
from kmn_jax.objects import Part
from kmn_jax.serve import ServeConfig
from tests.serve.serve_sample import running

ASSETS = Path(__file__).parent.parent / "experiments" / "assets"
IMAGE = ASSETS / "small_test_set" / "test" / "000002" / "depth" / "000000.png"  # of three copies: soon searched
MOTOR = ASSETS / "industrial" / "gear_motor.stl"
SHAFT = ASSETS / "industrial" / "shaft.stl"


@pytest.fixture(scope="module")
def card(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("card") / "motor.kmn"
    assert main(["prepare", str(MOTOR), "-o", str(path)]) == 0
    assert path.stat().st_size < 1_000_000
    return path


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cloud") / "scan.npy"
    np.save(path, bop_scan(IMAGE)[0].points)
    return path


def test_a_bin_in_all_forms_of_output(card: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    outputs = {flag: tmp_path / name for flag, name in (("--json", "a.json"), ("--bop-csv", "a.csv"))}
    picture = tmp_path / "a.png"
    arguments = [str(part) for pair in outputs.items() for part in pair]
    base = tmp_path / "base.json"
    base.write_text(json.dumps({"xyz": [0.5, 0, 1], "xyzw": [1, 0, 0, 0], "unit": "m"}))
    gripper = {"boxes": [{"center": [0, 0, -25], "size": [10, 10, 50]}]}
    ways = [{"name": "cup", "xyz": [18, 0, -10], "xyzw": [0, -(0.5**0.5), 0, 0.5**0.5]}]  # onto the side of the body
    (tmp_path / "grasps.json").write_text(json.dumps({"unit": "mm", "gripper": gripper, "grasps": ways}))
    arguments += ["--base-camera", str(base), "--grasps", str(tmp_path / "grasps.json")]
    code = main(
        [
            "detect",
            "--object",
            str(card),
            "--scene",
            str(IMAGE),
            *arguments,
            "--save-picture",
            str(picture),
            "--top",
            "3",
        ]
    )
    said = capsys.readouterr()
    assert code == 0, said.err
    assert "probability" in said.out
    found = json.loads(outputs["--json"].read_text())
    assert found["version"] == 1
    assert found["unit"] == "mm"
    assert 1 <= len(found["poses"]) <= 3
    assert {"T_scene_object", "probability", "inliers", "visible_fraction", "runner_up_gap", "warnings"} <= found[
        "poses"
    ][0].keys()
    for pose in found["poses"]:
        assert pose["num_inliers"] == pose["inliers"]
        T_base_camera = np.diag([1.0, -1, -1, 1])
        T_base_camera[:3, 3] = 500, 0, 1000
        np.testing.assert_allclose(pose["T_base_object"], T_base_camera @ pose["T_scene_object"], atol=1e-9)
        for pick in pose["grasps"]:
            assert pick["name"] == "cup"
            np.testing.assert_allclose(pick["T_base_grasp"], T_base_camera @ pick["T_scene_grasp"], atol=1e-9)
    assert "in the robot's frame" in said.out
    assert any(line.split()[:1] == ["rank"] and line.endswith("grasps") for line in said.out.splitlines())
    rows = table(outputs["--bop-csv"])
    assert [float(row["score"]) for row in rows] == [pose["probability"] for pose in found["poses"]]
    assert (rows[0]["scene_id"], rows[0]["im_id"], rows[0]["obj_id"]) == ("2", str(int(IMAGE.stem)), "2")
    first = np.array(found["poses"][0]["T_scene_object"])
    for name, numbers in (("R", first[:3, :3]), ("t", first[:3, 3])):
        np.testing.assert_allclose(np.array(rows[0][name].split(), dtype=float), numbers.ravel(), atol=1e-6)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_server_gives_what_a_search_here_gives(card: Path, tmp_path: Path) -> None:
    (tmp_path / "private").mkdir()
    flags = ["--object", str(card), "--scene", str(IMAGE), "--top", "2", "--random-seed", "1"]

    def searched(name: str, *more: str) -> tuple[dict, list[dict[str, str]], bytes]:
        outputs = {flag: tmp_path / f"{name}{flag}.png" for flag in ("--json", "--bop-csv", "--save-picture")}
        given = [str(text) for pair in outputs.items() for text in pair]
        assert main(["detect", *flags, *given, *more]) == 0
        found = json.loads(outputs["--json"].read_text())
        assert found.pop("timing")["total_s"] > 0
        rows = [{**row, "time": ""} for row in table(outputs["--bop-csv"])]
        return found, rows, outputs["--save-picture"].read_bytes()

    patient = ServeConfig(port=0, time_limit=1e4)
    with running(tmp_path / "private", patient, PoseEstimator.from_pretrained()) as server:
        there = searched("there", "--server", f"http://127.0.0.1:{server.port}")
    here = searched("here")
    assert there[0] == here[0]
    assert len(here[0]["poses"]) == 2
    assert there[1] == here[1]
    assert there[2].startswith(b"\x89PNG")


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_effort_that_is_asked_for_is_made(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[DetectConfig | None] = []

    def load(weights: str, config: DetectConfig | None = None) -> PoseEstimator:
        asked.append(config)
        raise InputError("that is enough")

    monkeypatch.setattr(PoseEstimator, "from_pretrained", load)
    given = ["detect", "--object", str(MOTOR), "--scene", str(IMAGE)]
    for more in (["--effort", "fast"], [], ["--effort", "usual"], ["--effort", "thorough"]):
        assert main([*given, *more]) == 2
    assert asked == [FAST, DetectConfig(), DetectConfig(), THOROUGH]
    assert main([*given, "--effort", "more"]) == 2
    assert "effort" in capsys.readouterr().err
    with pytest.raises(InputError, match="choose among fast, usual, thorough"):
        config_of("more")


def test_a_cloud_around_a_point(card: Path, cloud: Path, tmp_path: Path) -> None:
    target = tmp_path / "b.json"
    place = ",".join(f"{x:.3f}" for x in np.load(cloud)[100])
    assert main(["detect", "--object", str(card), "--scene", str(cloud), "--at", place, "--json", str(target)]) == 0
    assert json.loads(target.read_text())["seed"] == 0
    both = ["--at", place, "--at", ",".join(f"{x:.3f}" for x in np.load(cloud)[2000])]
    assert main(["detect", "--object", str(card), "--scene", str(cloud), *both, "--json", str(target)]) == 0


def test_an_object_in_inches_read_as_millimetres_is_told(
    cloud: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = trimesh.load(MOTOR)
    mesh.apply_scale(1 / 25.4)
    mesh.export(tmp_path / "motor.stl")
    place = ",".join(f"{x:.3f}" for x in np.load(cloud)[100])
    given = ["--scene", str(IMAGE), "--at", place]
    assert main(["detect", "--object", str(tmp_path / "motor.stl"), *given]) == 0
    assert "so that its diameter is 3.17 mm: if its numbers are inches or" in capsys.readouterr().out
    assert main(["prepare", str(tmp_path / "motor.stl"), "-o", str(tmp_path / "motor.kmn")]) == 0
    assert main(["detect", "--object", str(tmp_path / "motor.kmn"), *given]) == 0
    assert "for a card kmn prepare --units" in capsys.readouterr().out
    assert main(["detect", "--object", str(tmp_path / "motor.stl"), *given, "--object-units", "in"]) == 0
    assert "unit was taken to be" not in capsys.readouterr().out


def test_a_relative_path_and_another_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(IMAGE.parent)
    target = tmp_path / "a.csv"
    code = main(["detect", "--object", str(SHAFT), "--scene", IMAGE.name, "--bop-csv", str(target)])
    assert code == 0, capsys.readouterr().err
    assert {row["obj_id"] for row in table(target)} <= {"1"}  # not that of the motor, which is 2


def test_units_are_those_of_the_user_s_numbers(
    card: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given: list[Part] = []

    def export(estimator: object, part: Part, path: Path, points: int) -> int:
        given.append(part)
        return 1

    monkeypatch.setattr("kmn_jax.detection.export_estimator", export)
    for flags in ([], ["--units", "m"]):
        assert main(["export", "--object", str(card), "-o", str(tmp_path / "a.jaxexport"), *flags]) == 0
    assert [part.unit for part in given] == ["mm", "m"]
    assert given[1].diameter == pytest.approx(given[0].diameter / 1000)
    assert "in m\n" in capsys.readouterr().out
    (tmp_path / "small.stl").write_bytes(trimesh.creation.box((0.05, 0.02, 0.02)).export(file_type="stl"))
    assert main(["prepare", str(tmp_path / "small.stl")]) == 0
    said = capsys.readouterr().out
    asked = "note: is the object really 0.0574 mm large? If its numbers are metres, say --units m, or make what"
    assert f"{asked} states mm again\n" in said


def test_bad_input_is_one_sentence_and_exit_2(
    card: Path, cloud: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty.ply").write_bytes(b"")
    (tmp_path / "short.kmn").write_bytes(card.read_bytes()[:5000])
    (tmp_path / "renamed.ply").write_bytes(MOTOR.read_bytes())
    (tmp_path / "nothing.stl").write_text("solid a\nendsolid a\n")
    (tmp_path / "camera.json").write_text("{")
    (tmp_path / "base.json").write_text(json.dumps(np.eye(4).tolist()))
    np.save(tmp_path / "nan.npy", np.full((10, 3), np.nan, np.float32))
    np.save(tmp_path / "metres.npy", np.load(cloud) / 1000)
    np.save(tmp_path / "depth.npy", np.ones((40, 50), np.float32))
    whole = {"--object": str(card), "--scene": str(cloud)}
    cases: list[tuple[dict[str, str], str]] = [
        ({"--scene": "none.ply"}, "none.ply"),
        ({"--scene": str(tmp_path / "empty.ply")}, "empty.ply"),
        ({"--scene": str(tmp_path / "renamed.ply")}, "renamed.ply"),
        ({"--scene": str(tmp_path / "nan.npy")}, "none of its 10 points was measured"),
        ({"--scene": str(tmp_path / "metres.npy")}, "--units m"),
        ({"--scene": str(tmp_path / "depth.npy")}, "camera"),
        ({"--scene": str(tmp_path / "depth.npy"), "--camera": str(tmp_path / "camera.json")}, "camera.json"),
        ({"--object": str(tmp_path / "short.kmn")}, "short.kmn"),
        ({"--object": str(tmp_path / "nothing.stl")}, "nothing.stl"),
        ({"--at": "1,2"}, "--at"),
        ({"--roi": "1,2,3,0,0,0"}, "roi"),
        ({"--roi": "1,2,3,0,0"}, "must be 6 or 9 numbers"),
        ({"--roi": "1,2,3,0,1,1,0,0,90"}, "each side must be above zero"),
        ({"--roi": "1e6,0,0,1,1,1,0,0,90"}, "the region of interest holds none of the"),
        ({"--top": "0"}, "top"),
        ({"--random-seed": str(2**63)}, "seed"),
        ({"--save-picture": str(tmp_path / "a.jpg")}, "PNG"),
        ({"--at": "9000,9000,9000"}, "away from the nearest measured point"),
        ({"--json": str(tmp_path / "missing" / "a.json")}, "folder does not exist"),
        ({"--json": str(cloud)}, "it is read, too"),
        ({"--weights": "large"}, "no released model"),
        ({"--base-camera": str(tmp_path / "none.json")}, "none.json"),
        ({"--grasps": str(tmp_path / "base.json")}, "cannot be used as grasps"),
        ({"--base-camera": str(tmp_path / "camera.json")}, "cannot be used as a pose"),
        ({"--base-camera": str(tmp_path / "base.json"), "--sensor": "0,0,0"}, "leave --sensor out"),
    ]
    for changes, message in cases:
        arguments = [part for pair in (whole | changes).items() for part in pair]
        assert main(["detect", *arguments]) == 2, changes
        error = capsys.readouterr().err
        assert error.startswith("kmn: ")
        assert message in error, error
        assert error.count("\n") == 1, error
    assert main(["prepare", str(tmp_path / "nothing.stl")]) == 2
    assert main(["prepare", "."]) == 2
    for source, target in (("part.stl", "part.stl"), ("part.stl", "other.ply"), ("part.kmn", "part.kmn")):
        for path in (tmp_path / target, tmp_path / source):
            path.write_bytes(MOTOR.read_bytes())
        assert main(["prepare", str(tmp_path / source), "-o", str(tmp_path / target)]) == 2
        assert (tmp_path / target).read_bytes() == MOTOR.read_bytes()


def test_what_pictures_need_is_asked_for_before_the_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def search(request: object) -> None:
        raise AssertionError("searched")

    monkeypatch.setattr("kmn_jax.cli.Session", search)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    outputs = ["--json", str(tmp_path / "a.json"), "--save-picture", str(tmp_path / "a.png")]
    assert main(["detect", "--object", str(MOTOR), "--scene", str(IMAGE), *outputs]) == 2
    said = capsys.readouterr().err
    assert said.startswith("kmn: pictures need packages that are not installed: pip install ")
    assert "matplotlib" in said
    assert "viser" not in said
    assert list(tmp_path.iterdir()) == []


class Empty:
    """A search that finds nothing, at once."""

    part = SimpleNamespace(model_digest="0")
    scene = SimpleNamespace(bop_ids=(0, 0))
    places = None

    def __init__(self, request: object) -> None:
        pass

    def detect(self, places: None, top: int | None) -> Detections:
        return Detections("motor", "mm", (), Timing({}, 0.0), "nothing is there")


def test_json_is_printed_in_place_of_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("kmn_jax.cli.Session", Empty)
    monkeypatch.chdir(tmp_path)
    given = ["detect", "--object", str(MOTOR), "--scene", str(IMAGE)]
    assert main([*given, "--json", "-", "--bop-csv", "a.csv"]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert main([*given, "--json", "a.json"]) == 0
    assert printed.out == Path("a.json").read_text()
    assert json.loads(printed.out)["reason"] == "nothing is there"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "a.json"]


def test_results_are_written_though_nobody_reads_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def closed(found: Detections, accepted: float) -> str:
        raise BrokenPipeError

    monkeypatch.setattr("kmn_jax.cli.Session", Empty)
    monkeypatch.setattr("kmn_jax.detection.table", closed)
    target = tmp_path / "a.json"
    with (tmp_path / "out").open("w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        assert main(["detect", "--object", str(MOTOR), "--scene", str(IMAGE), "--json", str(target)]) == 0
    assert json.loads(target.read_text())["reason"] == "nothing is there"
    assert capsys.readouterr().err == ""
