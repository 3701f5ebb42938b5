"""The table of accuracies on the committed pack and images, and the release of a run's weights."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import jax
import numpy as np
import pytest

from configs import find_config
from experiments import evaluate_network, release
from kmn_jax.errors import InputError
from kmn_jax.models import create_model, load_model, load_pretrained, save_model
from kmn_jax.released import RELEASED
from tests.reference.networks import TINY

ASSETS = Path(__file__).parent.parent.parent / "experiments" / "assets"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a run leaves it, of a network that was never trained."""
    folder = tmp_path_factory.mktemp("run")
    save_model(create_model(TINY, jax.random.key(0)), folder / "model.safetensors")
    debug = find_config("debug")
    crops = replace(debug.examples.crops, num_points=64)
    config = replace(debug, name="tiny", network=TINY, examples=replace(debug.examples, crops=crops))
    (folder / "config.json").write_text(json.dumps(asdict(config)))
    session = {
        "training_objects": 4,
        "validation_objects": 2,
        "devices": ["cpu", "cpu"],
        "commit": "abc",
        "command": ["experiments/train.py", "small", "--seed", "1"],
        "versions": {"jax": "0"},
    }
    (folder / "sessions.jsonl").write_text(json.dumps(session) + '\n{"half a li')
    rows = [
        {"step": step, "samples": 8 * step, "seconds": 60.0 * step, "split": split, "loss": 3.0 - step / 100}
        | {"segmentation_accuracy": 0.5 + step / 100, "keypoint_accuracy": step / 1000}
        for step in (10, 20)
        for split in ("train", "validation")
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


@pytest.fixture(scope="module")
def evaluation(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("evaluation") / "network.json"
    arguments = [str(run), "--pack", str(ASSETS / "small_pack"), "--training-objects", "2", "--crops", "2"]
    arguments += ["--test-sets", str(ASSETS / "small_test_set"), "--crops-a-frame", "2", "--json", str(path)]
    assert evaluate_network.main(arguments) == 0
    return path


def test_every_split_and_object_is_counted(run: Path, evaluation: Path) -> None:
    results = json.loads(evaluation.read_text())
    assert results["sha256"] == hashlib.sha256((run / "model.safetensors").read_bytes()).hexdigest()
    train, validation, test, without = results["splits"]
    assert (without["split"], without["crops"]) == ("test, small_test_set, ray casting, without the bin", test["crops"])
    assert without["segmentation"] != test["segmentation"]
    assert (train["objects"], train["crops"]) == (2, 4)
    assert (validation["objects"], validation["crops"]) == (2, 4)
    assert test["objects"] == 2
    rows = results["objects"]["small_test_set"]
    assert sum(row["crops"] for row in rows) == test["crops"]
    for row in results["splits"]:
        # A network that knows nothing: cross entropies of two classes and of four keypoints, weighted.
        assert row["loss"] == pytest.approx(0.2 * np.log(2) + 0.8 * np.log(4), rel=0.2)
        assert 0 <= row["keypoints"] <= 0.6
    means = [sum(row["crops"] * row["loss"] for row in rows) / test["crops"]]
    assert means[0] == pytest.approx(test["loss"], rel=1e-4)


def test_the_released_model_does_what_its_card_says(tmp_path: Path) -> None:
    path = tmp_path / "network.json"
    arguments = ["--pack", "nowhere", "--test-sets", str(ASSETS / "small_test_set"), "--json", str(path)]
    arguments += ["--crops-a-frame", "2"]
    assert evaluate_network.main([str(evaluate_network.SHIPPED), *arguments]) == 0
    results = json.loads(path.read_text())
    card = evaluate_network.SHIPPED.with_suffix(".md").read_text()
    assert results["sha256"][:16] in card
    assert load_pretrained().config.num_keypoints == 64
    # Two objects of a few images: less exact than the card's seven, and better than chance by far.
    found, *_ = results["splits"]
    assert found["segmentation"] > 0.93
    assert found["keypoints"] > 5 / 64


def test_a_model_that_was_never_released_is_refused() -> None:
    with pytest.raises(InputError, match=f"there is no released model 'huge': there are {RELEASED}"):
        load_pretrained("huge")


def test_the_card_tells_how_exact_poses_are(run: Path, evaluation: Path, tmp_path: Path) -> None:
    results = [str(ASSETS.parent / "results" / f"{name}.json") for name in ("detection", "worlds_test")]
    assert release.main([str(run), str(evaluation), "--folder", str(tmp_path), "--detection", *results]) == 0
    (section,) = re.findall(r"^## Poses in whole bins\n.*?(?=^## )", (tmp_path / "tiny.md").read_text(), re.M | re.S)
    assert section in evaluate_network.SHIPPED.with_suffix(".md").read_text()  # the released one's, of these results
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in section.splitlines() if line.startswith("| ")]
    assert [row[0] for row in rows] == ["bins", "electronics", "industrial", "world bins"]
    assert rows[0][4:] == [
        *("shifted, mm", "shifted, % of the diameter", "turned, degrees"),
        *("MSSD recall", "average precision"),
    ]
    told = json.loads(Path(results[0]).read_text())["detection"]
    (of,) = (row for row in told if (row["bins"], row["method"]) == ("electronics", "kmn_jax"))
    exact = [
        [factor * of[f"{name}, {at}"] for at in ("median", "90%")]
        for name, factor in (("shifted, mm", 1), ("shifted, diameters", 100), ("turned, degrees", 1))
    ]
    shares = [f"{of[name]:.2f}" for name in ("MSSD recall", "average precision")]
    assert rows[1][4:] == [*(f"{median:.3g} / {most:.3g}" for median, most in exact), *shares]


def test_a_release_holds_weights_curve_picture_and_card(run: Path, evaluation: Path, tmp_path: Path) -> None:
    assert release.main([str(run), str(evaluation), "--folder", str(tmp_path)]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tiny.csv", "tiny.md", "tiny.png", "tiny.safetensors"]
    assert load_model(tmp_path / "tiny.safetensors").config == TINY
    assert (tmp_path / "tiny.csv").read_text().splitlines()[1] == "10,80,600,train,2.9,0.6,0.01"
    card = (tmp_path / "tiny.md").read_text()
    for fact in (
        "160 seen by these weights",
        "keypoint accuracy 0.020",
        "174000 times as many",
        "abc",
        "test, small",
        "experiments.train small --seed 1",
    ):
        assert fact in card, fact


def test_a_card_tells_what_a_run_went_on_from(run: Path, evaluation: Path, tmp_path: Path) -> None:
    again = Path(shutil.copytree(run, tmp_path / "again"))
    config = json.loads((again / "config.json").read_text())
    (again / "config.json").write_text(json.dumps(config | {"warm_start": "other"}))
    assert release.main([str(again), str(evaluation), "--folder", str(tmp_path)]) == 0
    card = (tmp_path / "tiny.md").read_text()
    assert "They went on from the weights `other`" in card
    assert "times as many" not in card  # samples of the weights before are not counted


def test_a_table_of_other_weights_is_refused(
    run: Path, evaluation: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.json"
    other.write_text(json.dumps(json.loads(evaluation.read_text()) | {"sha256": "0"}))
    assert release.main([str(run), str(other), "--folder", str(tmp_path)]) == 2
    assert "is of other weights than" in capsys.readouterr().err
    assert list(tmp_path.glob("tiny*")) == []


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("sessions.jsonl", None, "cannot read"),
        ("sessions.jsonl", "half a line", "tells of no session"),
        ("config.json", "{}", "has no name, network"),
        ("metrics.jsonl", "", "has no validation yet"),
        ("network.json", "[1]", "has no sha256"),
    ],
)
def test_a_broken_run_is_not_released(
    run: Path,
    evaluation: Path,
    tmp_path: Path,
    name: str,
    content: str | None,
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    shutil.copyfile(evaluation, folder / "network.json")
    (folder / name).unlink()
    if content is not None:
        (folder / name).write_text(content)
    arguments = [str(folder), str(folder / "network.json"), "--folder", str(tmp_path / "released")]
    assert release.main(arguments) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.glob("released/*"))


@pytest.mark.parametrize("arguments", [["nowhere.safetensors", "--test-sets", "."], ["--test-sets", "nowhere"]])
def test_what_cannot_be_read_is_one_sentence(
    run: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    model = [] if arguments[0].endswith(".safetensors") else [str(run)]
    assert evaluate_network.main([*model, *arguments, "--pack", "nowhere"]) == 2
    message = capsys.readouterr().err
    assert message.startswith("evaluate_network: ")
    assert "nowhere" in message


def test_what_has_not_been_made_yet_is_told_with_its_command(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)

    def said(*arguments: str) -> str:
        assert release.main([*arguments, "--folder", "released"]) == 2
        return capsys.readouterr().err

    assert "runs/small holds no weights yet: python -m experiments.train small --resume," in said(
        "runs/small", "a.json"
    )
    assert "python -m experiments.train small --folder other/small --resume," in said("other/small", "a.json")
    assert "python -m experiments.train NAME --folder mine --resume," in said("mine", "a.json")
    made_by = f"python -m experiments.evaluate_network {run} --json a.json\n"
    assert said(str(run), "a.json") == f"release: a.json has not been made yet: {made_by}"
    assert not (tmp_path / "released").exists()
