"""A part of the attack that takes seconds, and whether the attack itself sees what it is for.

All of it: `make attack`.
"""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kmn_jax.errors import InputError
from tests.attack import cases
from tests.attack.__main__ import classes_of, main, planned, table
from tests.attack.bombs import bombs
from tests.attack.cases import BAD, Case, as_row, damaged, judge, whole_folders
from tests.attack.faults import misbehave
from tests.attack.mutations import mutated_tree
from tests.attack.pool import outcomes
from tests.attack.targets import Target, targets

CASES = 500
SLOW = ("object-", "mesh-step", "scan-exr", "checkpoint")  # seconds a case: they, and bombs, are for `make attack`


@pytest.mark.timeout(600)
def test_readers_hold() -> None:
    chosen = [
        case
        for case in planned(CASES, seed=1)
        if case.number >= len(bombs().get(case.target, ())) and not case.target.startswith(SLOW)
    ]
    assert len({case.target for case in chosen}) > 40
    found = list(outcomes(chosen, workers=1))
    assert len(found) == len(chosen)
    assert classes_of(found) == []


def test_limits_end_a_case_and_its_worker_only() -> None:
    found = {
        outcome.case.number: outcome.kind for outcome in outcomes([Case("camera", n) for n in range(6)], 1, misbehave)
    }
    assert found == {0: "crash", 1: "memory", 2: "timeout", 3: "memory", 4: "timeout", 5: "valid"}


def test_a_case_is_the_same_whenever_it_is_made(tmp_path: Path) -> None:
    contents = []
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        wholes = whole_folders(tmp_path / name, ["mesh-text-ply", "scan-depth-png"])
        paths = [damaged(Case(target, 7), wholes / target) for target in ("mesh-text-ply", "scan-depth-png")]
        contents.append([path.read_bytes() for path in paths])
    assert contents[0] == contents[1]


def fails(folder: Path, path: Path) -> Any:
    raise KeyError("x")


def refuses(folder: Path, path: Path) -> Any:
    raise InputError("two\nlines")


def prints(folder: Path, path: Path) -> Any:
    os.write(2, b"a library's own words")  # as what is compiled does


def swells(folder: Path, path: Path) -> Any:
    raise InputError("it does not fit into memory")


@pytest.mark.parametrize(
    ("read", "kind"),
    [
        (fails, "exception"),
        (refuses, "message"),
        (prints, "printed"),
        (swells, "memory"),
        (lambda folder, path: {"a": [np.array([1.0, np.nan])]}, "not finite"),
        (lambda folder, path: (1.0, "a", None), "valid"),
    ],
)
def test_outcomes_are_told_apart(
    read: Any, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    wholes = whole_folders(tmp_path, ["camera"])
    changed: dict[str, Target] = {"camera": replace(targets()["camera"], read=read)}
    monkeypatch.setattr(cases, "targets", lambda: changed)
    outcome = judge(Case("camera", 99), wholes)
    assert outcome.kind == kind
    assert capfd.readouterr() == ("", "")
    assert as_row(outcome)["replay"] == "python -m tests.attack --replay camera:99:0"
    assert [row["kind"] for row in classes_of([outcome])] == [kind] * (kind in BAD)
    assert table([outcome])[0][kind] == 1


def test_every_sample_can_be_read(tmp_path: Path) -> None:
    slow = ("object-", "mesh-step", "scan-exr")
    names = [name for name in targets() if not name.startswith(slow)]
    wholes = whole_folders(tmp_path, names)
    for name in names:
        target = targets()[name]
        files = [path for pattern in target.files for path in (wholes / name).glob(pattern)]
        assert files, name
        target.read(wholes / name, files[0])


def test_cases_are_shared_by_all_formats_and_bombs_are_among_them() -> None:
    chosen = planned(1000, seed=0)
    counts = {name: sum(case.target == name for case in chosen) for name in targets()}
    assert all(counts[name] > len(bombs().get(name, ())) for name in targets())
    assert bombs().keys() <= targets().keys()
    assert counts["camera"] > 5 * counts["mesh-step"]
    with pytest.raises(InputError, match="no format is called like 'xyzzy'"):
        planned(10, 0, "xyzzy")


def test_a_failure_can_be_shown_again(tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    monkeypatch.setattr("tests.attack.__main__.limit_memory", lambda: None)
    assert main(replay="camera:50:3", keep=tmp_path) == 0
    assert "replay: python -m tests.attack --replay camera:50:3" in capfd.readouterr().out
    assert (tmp_path / "camera_50_3.json").exists()
    with pytest.raises(InputError, match="is no case: give FORMAT:NUMBER:SEED"):
        main(replay="nothing:1")


def test_trees_are_damaged_in_one_place() -> None:
    from random import Random

    whole = {"a": [1, {"b": 2}], "c": "d"}
    found = {mutated_tree(json.dumps(whole).encode(), Random(seed)) for seed in range(50)}
    assert len(found) > 30
    assert json.dumps(whole).encode() not in found
