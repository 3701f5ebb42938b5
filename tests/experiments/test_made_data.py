"""Commands whose data has not been made yet name the command that makes it."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from experiments import (
    build_data,
    compare_runs,
    detect_bins,
    detect_worlds,
    evaluate,
    evaluate_network,
    search_curve,
    train,
    tune_rivals,
)
from experiments.made_data import _MAKERS, require_made
from kmn_jax.errors import InputError

ROOT = Path(__file__).parents[2]
TEST_SET = Path("outputs/test_sets/electronics")


@pytest.mark.parametrize(
    ("command", "arguments", "maker"),
    [
        (evaluate.main, ["electronics"], "test-sets"),
        (evaluate_network.main, [], "test-sets"),
        (tune_rivals.main, ["validation"], "validation-bins"),
        (train.main, ["small", "--resume"], "electronics"),
    ],
)
def test_the_command_that_makes_the_data_is_named(
    command: Callable[[list[str]], int],
    arguments: list[str],
    maker: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command(arguments) == 2
    said = capsys.readouterr().err
    assert said.endswith(f"has not been made yet: python -m experiments.build_data {maker}\n")
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("command", "maker"),
    [
        (lambda: detect_bins.run(detect_bins.Options()), "calibrate --method FPFH --output outputs/fpfh.calibration"),
        (lambda: detect_bins.run(detect_bins.Options(methods=("kmn_jax",))), "build_data test-sets"),
        (lambda: detect_worlds.run(detect_worlds.Options()), "build_data worlds"),
        (lambda: search_curve.run(search_curve.Options()), "build_data worlds"),
        (lambda: compare_runs.compare(compare_runs.Options(Path("a"), Path("b"), TEST_SET)), "build_data test-sets"),
    ],
)
def test_so_is_it_by_measurements_of_whole_bins_and_comparisons(
    command: Callable[[], object], maker: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=rf"has not been made yet: python -m experiments\.{maker}"):
        command()


def test_probabilities_of_rivals_that_are_of_another_day_name_it_as_well(tmp_path: Path) -> None:
    old = tmp_path / "fpfh.calibration.json"
    for content, what in ((None, "has not been made yet"), ("{}", "is not a readable calibration: .*")):
        if content is not None:
            old.write_text(content)
        maker = rf"python -m experiments.calibrate --method FPFH --output {re.escape(str(old))}, or leave FPFH out"
        with pytest.raises(InputError, match=f"{what}: {maker}"):
            detect_bins.run(detect_bins.Options(methods=("FPFH",), fpfh_calibration=old))


def test_a_benchmark_without_data_is_one_sentence() -> None:
    command = [sys.executable, "-m", "benchmarks.detection", "--folders", "outputs/test_sets/none"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=200)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert "python -m experiments.build_data test-sets" in done.stderr
    assert "Traceback" not in done.stderr


def test_folders_that_are_there_or_somebody_elses_are_left_to_who_reads_them(tmp_path: Path) -> None:
    require_made(ROOT / "experiments", tmp_path / "none", None, "outputs/other")
    with pytest.raises(InputError, match=r"python -m experiments\.build_data worlds"):
        require_made("outputs/worlds/none")


def test_what_is_named_is_a_command() -> None:
    names = set(re.findall(r'^ +"([\w-]+)": [A-Z]\w+,$', Path(build_data.__file__).read_text(encoding="utf-8"), re.M))
    assert {maker.split()[0] for maker in _MAKERS.values()} <= names
