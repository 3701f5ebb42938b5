"""The harness of kills finds what a kill loses, on commands of milliseconds."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from kmn_jax.errors import InputError
from tests.attack import kills
from tests.attack.activities import ACTIVITIES, Activity
from tests.attack.kills import Tally, Trial, kill_all, main

# Writes ten lines with pauses: each whole in a file of its own, or into one file that a restart begins anew.
WHOLE = """
import os, sys, time
for row in range(10):
    path = os.path.join(sys.argv[1], f"{row}.txt")
    if not os.path.exists(path):
        with open(path + ".half", "w") as file:
            file.write(f"line {row}")
        os.rename(path + ".half", path)
        time.sleep(0.02)
"""
TORN = """
import os, sys, time
with open(os.path.join(sys.argv[1], "all.txt"), "a") as file:
    for row in range(10):
        print(f"line {row}", file=file, flush=True)
        time.sleep(0.02)
"""


class Writing:
    """An activity that writes text files."""

    def __init__(self, program: str) -> None:
        self.program = program

    def command(self, folder: Path) -> list[str]:
        return [sys.executable, "-S", "-c", self.program, str(folder)]

    def begun(self, folder: Path) -> bool:
        return any(folder.iterdir())

    def intact(self, folder: Path, whole: Path) -> None:
        for path in folder.glob("*.txt"):
            assert path.read_bytes() == (whole / path.name).read_bytes(), f"{path.name} is torn"

    def same(self, folder: Path, whole: Path) -> None:
        contents = [{path.name: path.read_bytes() for path in place.glob("*.txt")} for place in (folder, whole)]
        assert contents[0] == contents[1], "the end differs"


class Known(Random):
    """Draws known numbers."""

    def __init__(self, numbers: tuple[float, ...]) -> None:
        super().__init__(0)
        self.numbers = iter(numbers)

    def random(self) -> float:
        return next(self.numbers)


def killed(activity: Activity, kills: int) -> Tally:
    tallies: dict[str, Tally] = {}
    kill_all({"one": activity}, {"one": kills}, 0, tallies)
    return tallies["one"]


def test_what_is_written_whole_survives() -> None:
    tally = killed(Writing(WHOLE), 6)
    assert (tally.kills, tally.faults) == (6, [])
    assert tally.finished > 0


def test_what_has_ended_before_is_no_kill(tmp_path: Path) -> None:
    tally = Tally("one", writing=1000.0)
    program = "import pathlib, sys\npathlib.Path(sys.argv[1], 'a').touch()"
    trial = Trial(Writing(program), tmp_path, tally)
    (folder := tmp_path / "one").mkdir()
    kills._kill(trial.activity, folder, Known((0.9, 0.9, 0.9)), tally)
    assert (tally.kills, tally.too_late) == (0, 1)
    assert tally.writing < 100


def test_what_is_torn_is_found() -> None:
    tally = killed(Writing(TORN), 6)
    assert any("all.txt is torn" in fault for fault in tally.faults)
    assert any("the end differs" in fault for fault in tally.faults)


def test_a_command_that_cannot_go_on_is_a_fault() -> None:
    program = "import os, sys\nos.mkdir(sys.argv[1] + '/a')\nimport time\ntime.sleep(0.3)"
    tally = killed(Writing(program), 2)
    assert tally.finished == 0
    assert any("it ended with code 1" in fault and "FileExistsError" in fault for fault in tally.faults)


def test_activities_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(ACTIVITIES) >= {"training", "pack building", "prepare", "evaluation", "serve"}
    with pytest.raises(InputError, match="there is no activity 'cooking'"):
        main(only="cooking")


def test_what_was_killed_without_a_fault_is_not_killed_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kills, "ACTIVITIES", {"first": Writing(TORN), "second": Writing(WHOLE)})
    path, turns = tmp_path / "kills.json", list[str]()

    class Counted(Trial):
        def __init__(self, activity: Activity, place: Path, tally: Tally) -> None:
            self.tally = tally

        def run(self, most: int, seed: int, bar: object = None) -> None:
            if len(turns) == 6:
                raise KeyboardInterrupt
            turns.append(self.tally.activity)
            self.tally.kills += 1
            if len(turns) == 1:
                self.tally.faults.append("torn")

    monkeypatch.setattr(kills, "Trial", Counted)
    assert main(4, 0, path) == 1
    with pytest.raises(KeyboardInterrupt):
        main(6, 0, path, resume=True)
    assert turns == ["first", "second", "first", "second", "first", "second"]
    turns[:] = ["no fault"]
    assert main(6, 0, path, resume=True) == 0
    assert turns[1:] == ["first", "first"]
    found = json.loads(path.read_text())
    assert (found["kills"], found["faults"], found["seed"]) == (6, 0, 0)
    main(2, 1, path, resume=True)  # another seed, other moments
    assert turns[3:] == ["first", "second"]


@pytest.mark.parametrize("name", ACTIVITIES)
def test_commands_are_in_the_folder(name: str, tmp_path: Path) -> None:
    activity: object = ACTIVITIES[name]
    command: Callable[[Path], list[str]] = activity.command  # type: ignore[attr-defined]
    assert any(str(tmp_path) in word for word in command(tmp_path))
    assert not ACTIVITIES[name].begun(tmp_path)
