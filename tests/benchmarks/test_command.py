"""What benchmarks say of wrong flags, before they measure anything."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

import pytest

from benchmarks.command import run

TIMED = ("crops", "detection", "gate", "knn", "network", "pose", "roofline", "scaling", "scenes", "training")


def said(main: object, arguments: list[str], capsys: pytest.CaptureFixture[str], patch: pytest.MonkeyPatch) -> str:
    """Return what a benchmark prints that must end with the status of bad input."""
    patch.setattr(sys, "argv", ["benchmark", *arguments])
    with pytest.raises(SystemExit) as end:
        run(main)  # type: ignore[arg-type]
    assert end.value.code == 2
    output, errors = capsys.readouterr()
    assert not output
    assert errors.count("\n") == 1
    return errors


@pytest.mark.parametrize("name", TIMED)
def test_no_repeats_are_refused(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    main = import_module(f"benchmarks.{name}").main
    error = said(main, ["--repeats", "0"], capsys, monkeypatch)
    assert error == "error: --repeats is 0, but must be a whole number of 1 or more\n"


@pytest.mark.parametrize(
    ("name", "arguments", "reason"),
    [
        ("knn", ["--sizes", "64", "0"], "--sizes is 0"),
        ("knn", ["--sizes"], "--sizes needs at least one value"),
        ("knn", ["--sizes", "4096", "64", "--k", "100"], "only 64 points in the smallest of --sizes"),
        ("endurance", ["--hours", "nan"], "--hours is nan"),
        ("compiled", ["--pause", "/nonexistent"], "/nonexistent cannot be read"),
        ("crops", ["--weights", "nosuch"], "there is no released model 'nosuch'"),
        ("detection", ["--weights", "nosuch"], "there is no released model 'nosuch'"),
        ("pose", ["--inlier-shares", "0.2", "2"], "--inlier-shares has 2.0"),
        ("roofline", ["--training", "nosuch"], "nosuch"),
        ("serve", ["--clients", "0"], "--clients is 0"),
        ("cold_start", ["--firsts", "0"], "--firsts is 0"),
        ("crops", ["--folder", "/nonexistent"], "/nonexistent"),
        ("scenes", ["--pack", "/nonexistent"], "/nonexistent"),
    ],
)
def test_what_cannot_be_measured_is_one_sentence(
    name: str,
    arguments: list[str],
    reason: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert reason in said(import_module(f"benchmarks.{name}").main, arguments, capsys, monkeypatch)


def test_files_are_tried_first_and_status_and_flags_pass(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[tuple[int, bool, Path | None]] = []

    def main(seed: int = 1, memory: bool = True, json: Path | None = None, picture: Path | None = None) -> int:
        called.append((seed, memory, json))
        return 1

    assert "cannot write" in said(main, ["--json", str(tmp_path)], capsys, monkeypatch)
    twice = str(tmp_path / "a.json")
    assert "to hold another result" in said(main, ["--json", twice, "--picture", twice], capsys, monkeypatch)
    assert not called
    monkeypatch.setattr(sys, "argv", ["benchmark", "--seed", "0", "--no-memory", "--json", str(tmp_path / "a.json")])
    with pytest.raises(SystemExit) as end:
        run(main)
    assert end.value.code == 1
    assert called == [(0, False, tmp_path / "a.json")]
