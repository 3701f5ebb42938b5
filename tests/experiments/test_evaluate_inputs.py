"""What is evaluated: bins of the CAD files that are given, objects that can be told apart, files that are there."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from experiments import evaluate
from kmn_jax.bop import NAMES_FILE
from kmn_jax.data import Source
from tests.reference.poses import some_poses

SMALL = Path(evaluate.__file__).parent / "assets" / "small_test_set"


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The names of what bins were made of, call by call; the small test set stands for them."""
    calls: list[list[str]] = []

    def build(folder: Path, sources: list[Source]) -> str:
        calls.append([source.name for source in sources])
        if len(calls) == 1:  # interrupted
            shutil.copytree(SMALL / "test" / "000001", folder / "test" / "000001")
            raise KeyboardInterrupt
        shutil.copytree(SMALL, folder, dirs_exist_ok=True)
        return ""

    monkeypatch.setattr(evaluate, "build_test_set", build)
    return calls


def test_bins_are_those_of_the_cad_files(
    tmp_path: Path, made: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    cad, folder = tmp_path / "cad", tmp_path / "bins"
    cad.mkdir()
    for name in ("a", "b"):
        (cad / f"{name}.stl").write_text(name)
    (cad / "other.txt").touch()
    options = ["wrs", "--folder", str(folder), "--cad-names", "a", "b", "--objects", "none"]
    with_cad = [*options, "--cad", str(cad)]

    assert evaluate.main(options) == 2
    assert "holds no bins, or not all: give the folder of their CAD files with --cad" in capsys.readouterr().err
    with pytest.raises(KeyboardInterrupt):
        evaluate.main(with_cad)
    assert evaluate.main(options) == 2
    assert "--cad" in capsys.readouterr().err  # they are not whole
    for arguments in (with_cad, with_cad, options):  # goes on, finds all of them there, needs the files no more
        assert evaluate.main(arguments) == 2
        assert "no object that can be evaluated is named none" in capsys.readouterr().err
    assert made == [["a", "b"]] * 3

    (cad / "b.stl").write_text("another part")
    assert evaluate.main(with_cad) == 2
    assert "bins holds bins of other CAD files" in capsys.readouterr().err
    (cad / "b.stl").unlink()
    assert evaluate.main(with_cad) == 2
    assert f"{cad} holds no CAD file named like b" in capsys.readouterr().err
    (cad / "b.stl").write_text("another part")
    (folder / ".cad.json").unlink()
    assert evaluate.main(with_cad) == 2
    assert "choose another --folder, or delete it" in capsys.readouterr().err
    assert len(made) == 3


def test_cad_files_of_one_name_are_refused(
    tmp_path: Path, made: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.stl", "a.step"):
        (tmp_path / name).write_text(name)
    assert evaluate.main(["wrs", "--cad", str(tmp_path), "--cad-names", "--folder", str(tmp_path / "bins")]) == 2
    assert "'a' and 'a' would have the same files of predictions" in capsys.readouterr().err
    assert not made


def test_objects_whose_files_would_be_the_same_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "data"
    shutil.copytree(SMALL, folder)
    (folder / "models" / NAMES_FILE).write_text(json.dumps({"1": "part,1", "2": "part-1"}))
    assert evaluate.main(["bop", "--folder", str(folder), "--output", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "the objects 'part,1' and 'part-1' would have the same files" in error
    assert NAMES_FILE in error


@pytest.mark.parametrize("option", ["--camera", "--object"])
def test_files_that_are_not_there_are_one_sentence(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    np.save(folder / "scan.npy", np.random.default_rng(0).normal(size=(100, 3)))
    (folder / "scan.txt").write_text(" ".join(map(str, some_poses(1)[0].ravel().tolist())))
    shutil.copy(SMALL / "models" / "obj_000002.ply", tmp_path / "part.ply")
    given = {"--object": tmp_path / "part.ply", "--camera": tmp_path / "camera.json"} | {option: Path("nosuch.file")}
    arguments = [word for key, path in given.items() for word in (key, str(path))]
    assert evaluate.main(["clouds", "--folder", str(folder), "--output", str(tmp_path / "out"), *arguments]) == 2
    assert "nosuch.file cannot be read: No such file or directory" in capsys.readouterr().err
