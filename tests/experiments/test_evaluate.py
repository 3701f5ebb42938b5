"""The evaluation as it is run: on the small test set, on broken copies of it, on clouds, with a rival missing."""

from __future__ import annotations

import importlib.metadata
import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from experiments import ablate, evaluate, tune_rivals
from experiments.evaluation import predictions, rivals
from experiments.evaluation.cases import Case, ObjectImages, Solver, draw_cases
from experiments.evaluation.configs import EvaluateConfig
from experiments.evaluation.predictions import Export
from experiments.evaluation.rivals import FastGlobal, Fpfh, Kiss, PointPairs, missing
from experiments.evaluation.sources import bop_objects, cloud_objects
from experiments.evaluation.tuned import RIVALS
from experiments.evaluation.versions import VERSIONS, versions_of
from kmn_jax.errors import InputError
from kmn_jax.models import create_model, load_model, released_file, save_model
from kmn_jax.objects import ObjectModel
from kmn_jax.pose import adi
from tests.bop.bop_sample import save_image

SMALL = Path(evaluate.__file__).parent / "assets" / "small_test_set"
GEAR, IMAGES = "gear_motor", "2"


@pytest.fixture(scope="module")
def gear() -> ObjectImages:
    problems: list[str] = []
    found = bop_objects(SMALL, "test", problems.append, most_images=2)
    assert not problems
    return found[1]


def test_cases_lie_on_copies_and_are_the_same_whenever_they_are_drawn(gear: ObjectImages) -> None:
    cases, again = (list(draw_cases(gear, 6, 0.0)) for _ in range(2))
    assert len(cases) == 6
    for case, other in zip(cases, again, strict=True):
        np.testing.assert_array_equal(case.points, other.points)
        pose = case.T_camera_object[case.copy]
        local = (case.points[0] - pose[:3, 3]) @ pose[:3, :3]
        assert np.linalg.norm(gear.model.points - local, axis=1).min() < 0.05 * gear.model.diameter
        reach = np.linalg.norm(case.points - case.points[0], axis=1)
        assert reach.max() <= gear.model.diameter * (1 + 1e-5)


def test_noise_is_a_share_of_the_longest_side_and_keeps_the_seeds(gear: ObjectImages) -> None:
    plain, noisy = (list(draw_cases(gear, 4, noise)) for noise in (0.0, 0.05))
    longest = float((gear.model.maximum - gear.model.minimum).max())
    for one, other in zip(plain, noisy, strict=True):
        assert one.name == other.name
        assert (other.points - one.points).std() == pytest.approx(0.05 * longest, rel=0.05)


def test_more_crops_than_scans_are_spread_evenly(gear: ObjectImages) -> None:
    names = [case.name.rpartition("/")[0] for case in draw_cases(gear, 7, 0.0)]
    assert sorted(names.count(name) for name in set(names)) == [3, 4]


@pytest.mark.parametrize("kind", [Fpfh, FastGlobal, Kiss, PointPairs])
def test_rivals_find_a_part_that_lies_there_alone(gear: ObjectImages, kind: type) -> None:
    """Each gets the side of the part that a camera sees, and nothing else."""
    pose = next(draw_cases(gear, 1, 0.0)).T_camera_object[0]
    points = gear.model.points @ pose[:3, :3].T + pose[:3, 3]
    seen = points[((gear.model.normals @ pose[:3, :3].T) * points).sum(axis=1) < 0].astype(np.float32)
    method = kind(sampling=0.1) if kind is PointPairs else kind()
    solve = method.prepare(gear.model)
    alone = [Case(f"alone/{number}", seen, pose[None], 0, 1.0) for number in range(3)]
    found = [solve(case) for case in alone]
    right = [
        one is not None and float(adi(one, pose, gear.model.points[:1000])) < 0.1 * gear.model.diameter for one in found
    ]
    assert sum(right) >= 2
    if kind is not Fpfh:  # threads of Open3D's RANSAC end each other's search
        np.testing.assert_array_equal(solve(alone[0]), found[0])


def test_a_package_that_is_missing_or_broken_is_told_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken_rival.py").write_text("raise OSError('libX.so: cannot open\\nmore')")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert missing("json") is None
    assert missing("no_such_rival") == "no_such_rival cannot be imported (No module named 'no_such_rival')"
    assert missing("broken_rival") == "broken_rival cannot be imported (libX.so: cannot open)"


def no_pictures(*_: Any) -> dict[str, Any]:
    """Draw nothing: for one of the pictures a whole bin is searched, which takes long."""
    return {}


def test_evaluating_twice_gives_the_same_numbers_and_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(RIVALS, "kiss", ("no_such_rival", Kiss))  # type: ignore[index]
    options = ["--objects", GEAR, "--images", IMAGES, "--crops", "4", "--methods", "ours", "fpfh", "kiss"]
    scores = []
    for folder in ("one", "two", "two"):
        assert evaluate.main(["demo", *options, "--output", str(tmp_path / folder)]) == 0
        monkeypatch.setattr(evaluate, "draw_pictures", no_pictures)  # the first ones tell all
        content = json.loads((tmp_path / folder / "scores.json").read_text())
        scores.append([{key: cell[key] for key in ("method", "noise", "crops", "recall")} for cell in content["cells"]])
    assert scores[1] == scores[2]
    assert scores[0][:2] == scores[1][:2]  # poses made anew, of which only Open3D's RANSAC finds others
    assert [cell["method"] for cell in scores[0]] == [
        "kmn_jax",
        "kmn_jax + ICP",
        "FPFH + RANSAC",
        "FPFH + RANSAC + ICP",
    ]
    assert scores[0][1]["recall"]["diameter"] >= 0.5
    assert "skipped kiss: no_such_rival cannot be imported" in capsys.readouterr().err

    page = (tmp_path / "one" / "report.html").read_text()
    assert page.count('src="data:image/png;base64,') == 3
    assert "http" not in re.sub(r"base64,[^\"]+", "", page).replace("http-equiv", "")
    report = (tmp_path / "one" / "report.md").read_text()
    for text in (page, report):
        assert "FPFH + RANSAC + ICP" in text
        assert "kiss: no_such_rival cannot be imported" in text
        assert "Nothing." not in text
        assert "Nowhere." not in text
        found = text.index("kmn_jax + ICP finds the right pose in")
        whole = re.search(r"(\d+) of (\d+) copies found in this bin, all accepted poses right", text)
        assert whole is not None
        assert int(whole[1]) >= int(whole[2]) / 2
        assert "The image with the most copies of gear_motor" in text
        assert (
            found < whole.start() < text.index("Recall, objects: ") < text.index("Where, when and of what it was made")
        )

    own = tmp_path / "one" / "ours" / f"{GEAR}.noise0.safetensors"
    stamp = own.stat().st_mtime_ns
    (before,) = json.loads((tmp_path / "one" / "scores.json").read_text())["poses"]
    shutil.rmtree(tmp_path / "one" / "fpfh")
    monkeypatch.setattr(predictions, "commit", lambda: "a1b2c3")
    assert evaluate.main(["demo", *options, "--output", str(tmp_path / "one")]) == 0
    assert own.stat().st_mtime_ns == stamp  # not made anew
    made_at = json.loads((tmp_path / "one" / "scores.json").read_text())["poses"]
    assert made_at == sorted({"a1b2c3", before})
    assert f"- Poses: made at commits {', '.join(made_at)}" in (tmp_path / "one" / "report.md").read_text()
    capsys.readouterr()

    monkeypatch.setitem(VERSIONS, "Fpfh", 1 + VERSIONS["Fpfh"])
    assert evaluate.main(["demo", *options, "--output", str(tmp_path / "one")]) == 2
    assert "(differing: method fpfh)" in capsys.readouterr().err  # ours is not


def test_broken_scenes_are_reported_and_the_rest_is_read(tmp_path: Path) -> None:
    folder = tmp_path / "broken"
    shutil.copytree(SMALL, folder)
    usb, gears = folder / "test" / "000001", folder / "test" / "000002"
    for number, scene in enumerate((usb, gears), start=3):
        shutil.copytree(scene, folder / "test" / f"{number:06d}")
    (usb / "scene_gt.json").unlink()
    depth = sorted((gears / "depth").glob("*.png"))
    save_image(depth[0], np.zeros((10, 10), dtype=np.uint16))
    truth = json.loads((folder / "test" / "000004" / "scene_gt.json").read_text())
    images = sorted(truth, key=int)
    for instance in truth[images[0]]:
        instance["obj_id"] = 77
    truth[images[1]] = []
    (folder / "test" / "000004" / "scene_gt.json").write_text(json.dumps(truth))
    for name in ("mask", "mask_visib"):
        shutil.rmtree(folder / "test" / "000004" / name, ignore_errors=True)
    (folder / "test" / "000004" / "scene_gt_info.json").unlink(missing_ok=True)

    problems: list[str] = []
    found = bop_objects(folder, "test", problems.append)
    told = "\n".join(problems)
    assert "scene_gt.json" in told
    assert depth[0].name in told
    assert "shows no object" in told
    assert "obj_id 77 has no model" in told
    counts = {one.name: len(one.images) for one in found}
    whole = {one.name: len(one.images) for one in bop_objects(SMALL, "test", problems.append)}
    assert counts[GEAR] == 2 * whole[GEAR] - 3
    assert sum(counts.values()) == sum(whole.values()) * 2 - 3 - whole[next(name for name in whole if name != GEAR)]
    for one in found:
        assert len(list(draw_cases(one, 5, 0.0))) == 5


def test_clouds_with_poses_are_evaluated_from_their_sensor(tmp_path: Path, gear: ObjectImages) -> None:
    """A scan in another frame than the sensor's, whose place is named."""
    image = gear.images[0]
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = np.diag([1.0, -1, -1]), [10.0, 20.0, 700.0]
    points = image.points @ turn[:3, :3].T + turn[:3, 3]
    np.save(tmp_path / "scan1.npy", points.astype(np.float32))
    poses = turn @ image.T_camera_object
    (tmp_path / "scan1.txt").write_text("\n".join(" ".join(map(repr, row)) for pose in poses for row in pose.tolist()))
    mesh = next((SMALL / "models").glob("obj_000002.*"))
    shutil.copy(mesh, tmp_path / "part.ply")
    (found,) = cloud_objects(tmp_path, tmp_path / "part.ply", None, "mm", turn[:3, 3])
    cases = list(draw_cases(found, 4, 0.0))
    assert len(cases) == 4
    for case in cases:
        pose = case.T_camera_object[case.copy]
        assert case.points[:, 2].min() > 0  # in front of the sensor
        local = (case.points[0] - pose[:3, 3]) @ pose[:3, :3]
        assert np.linalg.norm(found.model.points - local, axis=1).min() < 0.05 * found.model.diameter
    exported = Export.open(tmp_path / "out", {}, overwrite=False)
    exported.write_truth("part", 0.0, cases)
    assert np.isnan(exported.truth("part", 0.0).visible).all()  # it is not known


def test_an_ablation_changes_one_choice_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    methods = ablate.methods_of(load_model(released_file()))
    plain = leaves(methods["ours"].settings)
    single = leaves(methods["one_RANSAC"].settings)
    for key, method in methods.items():
        base = single if key.startswith("one_RANSAC") else plain
        number = 0 if key in ("ours", "one_RANSAC") else 2 * (1 + key.count("keypoints_normals"))
        assert len(base.items() ^ leaves(method.settings).items()) == number, key
    monkeypatch.setattr(evaluate, "draw_pictures", no_pictures)
    monkeypatch.setattr(ablate, "VARIANTS", {})
    monkeypatch.setattr(ablate, "SINGLE", {})
    monkeypatch.setattr(ablate, "KEYPOINTS", {"10 keypoints": 10})
    monkeypatch.setattr(evaluate, "_TOGETHER", 1)  # of two
    forgotten: list[bool] = []
    monkeypatch.setattr(jax, "clear_caches", lambda: forgotten.append(True))  # other tests go on with what is compiled
    options = ["demo", "--objects", GEAR, "--images", "1", "--crops", "3", "--output", str(tmp_path / "out")]
    assert ablate.main(options) == 0
    assert len(forgotten) == 1, "between the two"
    content = json.loads((tmp_path / "out" / "scores.json").read_text())
    assert {cell["method"] for cell in content["cells"]} == {
        f"{name}{refined}" for name in ("kmn_jax", "10 keypoints") for refined in ("", " + ICP")
    }
    settings = content["recipe"]["methods"]
    assert settings["10_keypoints"]["num_keypoints"] == 10
    assert settings["ours"]["num_keypoints"] is None


def leaves(settings: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return settings without their nesting; one that is left out as a whole counts as one."""
    found: dict[str, str] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping) and key not in ("smooth", "icp"):
            found |= leaves(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = str(value)
    return found


def test_rivals_are_tuned_by_settings_side_by_side(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluate, "draw_pictures", no_pictures)
    monkeypatch.setattr(tune_rivals, "_VOXELS", {"fpfh": ((0.05,), (0.05,)), "kiss": ((0.03,), (0.03,))})
    monkeypatch.setattr(rivals, "_SMOOTHED", (1024, 2048))  # of which each is compiled
    options = ["demo", "--objects", GEAR, "--images", "1", "--crops", "2", "--output", str(tmp_path / "out")]
    assert tune_rivals.main([*options, "--methods", "ours", "fpfh", "fpfh_best", "kiss"]) == 0
    recipe = json.loads((tmp_path / "out" / "scores.json").read_text())["recipe"]
    settings = recipe["methods"]
    tuned = {f"{name}{how}" for name in ("fpfh_0.05", "kiss_0.03") for how in ("", "_smoothed")}
    assert set(settings) == {*tuned, "ours"}
    assert settings["fpfh_0.05_smoothed"]["features"]["smooth"]
    assert settings["fpfh_0.05"]["features"]["voxel"] == 0.05
    assert settings["fpfh_0.05"]["versions"] == versions_of(Fpfh())
    # The version of a rival's library is a matter of this rival alone: it can be installed, or updated, later.
    assert settings["kiss_0.03"]["versions"]["kiss-matcher"] == importlib.metadata.version("kiss-matcher")
    assert {*recipe["versions"]} == {"cases", "refinement", "jax", "jaxlib", "numpy", "open3d"}


def test_without_a_rival_there_is_nothing_to_tune(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert tune_rivals.main(["demo", "--methods", "ours_ransac", "--output", str(tmp_path / "out")]) == 2
    assert "no rival to tune among ours_ransac: there are fpfh" in capsys.readouterr().err


def test_a_method_that_fails_ends_the_run_in_a_sentence_and_what_was_found_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def prepare(self: Kiss, model: ObjectModel) -> Solver:
        def solve(case: Case) -> np.ndarray | None:
            raise RuntimeError("no clique\nat all")

        return solve

    monkeypatch.setattr(Kiss, "prepare", prepare)
    options = ["--objects", GEAR, "--images", "1", "--crops", "2", "--methods", "fpfh", "kiss"]
    assert evaluate.main(["demo", *options, "--output", str(tmp_path)]) == 2
    expected = f"KISS-Matcher failed on {GEAR} at noise 0 (RuntimeError: no clique): leave it out with --methods"
    assert capsys.readouterr().err.splitlines()[-1] == f"evaluate: {expected}"
    assert (tmp_path / "fpfh" / f"{GEAR}.noise0.safetensors").exists()


def test_networks_of_one_object_each_are_a_method(
    tmp_path: Path, gear: ObjectImages, capsys: pytest.CaptureFixture[str]
) -> None:
    """An untrained one finds nothing much, but it is used for its object, and only there."""
    config = replace(load_model(released_file()).config, object_branch="learned")
    (tmp_path / "own").mkdir()
    save_model(create_model(config, jax.random.key(0)), tmp_path / "own" / f"{GEAR}.safetensors")
    options = ["demo", "--images", "1", "--crops", "2", "--methods", "per_object", "--output", str(tmp_path / "out")]
    assert evaluate.main([*options, "--objects", GEAR, "--networks", str(tmp_path / "own")]) == 0
    content = json.loads((tmp_path / "out" / "scores.json").read_text())
    assert {cell["object"] for cell in content["cells"]} == {GEAR}
    assert set(content["recipe"]["methods"]["per_object"]["networks"]) == {GEAR}
    assert evaluate.main([*options, "--networks", str(tmp_path / "own"), "--overwrite"]) == 2
    assert "there is no network of USB" in capsys.readouterr().err
    assert evaluate.main(options) == 2
    assert "--networks" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["electronic"], "did you mean electronics"),
        (["bop"], "needs a folder"),
        (["bop", "--folder", "no_such_folder"], "no_such_folder"),
        (["clouds", "--folder", "no_such_folder"], "not a folder"),
        (["demo", "--methods", "magic"], "no method 'magic'"),
        (["demo", "--objects", GEAR, "none"], "no object that can be evaluated is named none: there are"),
        (["demo", "--output", str(SMALL / "out")], "which is evaluated: choose another --output"),
        (["demo", "--crops", "0"], "must be 1 or more"),
        (["demo", "--noise", "2"], "noise"),
        (["demo", "--random-seed", "-1"], "random_seed is -1, but must be 0 or more"),
        (["demo", "--weights", "none"], "none"),
    ],
)
def test_bad_input_is_one_sentence(
    arguments: list[str],
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert evaluate.main(arguments) == 2
    error = capsys.readouterr().err
    assert text in error
    assert "Traceback" not in error


def test_settings_that_contradict_each_other_are_refused() -> None:
    for values in (
        {"methods": ("fpfh", "fpfh")},
        {"noise": ()},
        {"noise": (0.1, 0.1 + 1e-12)},
        {"images": 0},
        {"sensor": "1,2"},
        {"methods": ()},
    ):
        with pytest.raises(InputError):
            EvaluateConfig("x", **values)  # type: ignore[arg-type]
