"""Kill commands at random moments, start them again, and see that nothing is lost and the results are the same.

python -m tests.attack.kills --kills 200 --seed 0 --json FILE [--only training] [--resume]

Each command first runs without a stop. Then it is killed (SIGKILL) a few times, at its start or while it writes, alone
or with the processes that it has started; after each kill what it left is looked at, at last it ends and is compared.
"""

from __future__ import annotations

import contextlib
import json as json_format
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import tyro
from tqdm import tqdm

from kmn_jax.errors import InputError
from kmn_jax.report import check_target, commit, print_table, write_json
from tests.attack.activities import ACTIVITIES, Activity
from tests.train.loop_sample import ENVIRONMENT, ONE_DEVICE

_ROOT = Path(__file__).parents[2]
_MOST_SECONDS = 3600  # of a command, on a machine that others use, too
_EARLY = 0.15  # share of kills before a command has written anything
_MOST_IN_A_ROW = 4


@dataclass
class Tally:
    """What came of the kills of one activity."""

    activity: str
    kills: int = 0
    before_writing: int = 0
    finished: int = 0  # runs that ended after kills, and were compared
    too_late: int = 0  # had ended before the signal came, which are no kills
    faults: list[str] = field(default_factory=list)
    leftovers: int = 0  # hidden files that lie there when a run has finished
    seconds: float = 0.0  # of the run without a stop
    writing: float = 0.0  # s of these from what it writes first
    duration: float = 0.0  # s of all killed runs, until they ended
    commit: str | None = None


def main(kills: int = 200, seed: int = 0, json: Path | None = None, only: str = "", resume: bool = False) -> int:
    """Kill, and return 1 if anything was lost or differs.

    Args:
        kills: how many, shared by all activities.
        seed: number that the moments follow from, as far as clocks allow.
        json: where counts and faults go, after each run that was killed and has ended.
        only: name of one activity; the others are left out.
        resume: go on with what that file has of activities without a fault, if it is from the same seed.
    """
    chosen = {name: activity for name, activity in ACTIVITIES.items() if only in ("", name)}
    if not chosen:
        raise InputError(f"there is no activity {only!r}: there are {', '.join(ACTIVITIES)}")
    check_target(json)
    tallies = _without_faults(json, seed) if resume and json is not None else {}
    shares = {name: kills // len(chosen) + (row < kills % len(chosen)) for row, name in enumerate(chosen)}
    with tqdm(total=kills, unit="kill") as bar:
        kill_all(chosen, shares, seed, tallies, bar, lambda: _write(json, tallies, seed))
    _write(json, tallies, seed)
    rows = [asdict(one) | {"faults": len(one.faults)} for one in tallies.values()]
    print_table(f"{sum(one.kills for one in tallies.values())} kills, seed {seed}", rows)
    for tally in tallies.values():
        for fault in tally.faults:
            print(f"{tally.activity}: {fault}")
    return int(any(tally.faults for tally in tallies.values()))


def _without_faults(path: Path, seed: int) -> dict[str, Tally]:
    """Return what an earlier run, from the same seed, has written of activities in which nothing was lost."""
    if not path.exists():
        return {}
    found = json_format.loads(path.read_text(encoding="utf-8"))
    tallies = [Tally(**row) for row in found["activities"] if found["seed"] == seed]
    return {tally.activity: tally for tally in tallies if not tally.faults}


def _write(path: Path | None, tallies: dict[str, Tally], seed: int) -> None:
    rows = sorted(map(asdict, tallies.values()), key=lambda row: list(ACTIVITIES).index(row["activity"]))
    sums = {"kills": sum(row["kills"] for row in rows), "faults": sum(len(row["faults"]) for row in rows)}
    write_json(path, {**sums, "activities": rows, "seed": seed})


def kill_all(
    activities: dict[str, Activity],
    shares: dict[str, int],
    seed: int,
    tallies: dict[str, Tally],
    bar: Any = None,
    save: Callable[[], None] = lambda: None,
) -> None:
    """Kill runs of activities, one in turn, until each has been killed as often as its share says."""
    with tempfile.TemporaryDirectory(prefix="kills-") as place:
        trials = []
        for number, (name, activity) in enumerate(activities.items()):
            tally = tallies.setdefault(name, Tally(name, commit=commit()))
            if bar is not None:
                bar.update(min(tally.kills, shares[name]))
            if tally.kills < shares[name]:
                trials.append(Trial(activity, Path(place, str(number)), tally))
        while left := [trial for trial in trials if trial.tally.kills < shares[trial.tally.activity]]:
            for trial in left:
                trial.run(shares[trial.tally.activity], seed, bar)
                save()


class Trial:
    """An activity that is killed, how it ends without, and what comes of it."""

    def __init__(self, activity: Activity, place: Path, tally: Tally) -> None:
        """Let the activity end without a stop."""
        self.activity, self.place, self.tally = activity, place, tally
        self.whole = place / "whole"
        self.whole.mkdir(parents=True)
        start = time.monotonic()
        _finish(activity, self.whole)
        tally.seconds = round(time.monotonic() - start, 1)
        if not tally.writing:
            tally.writing = round(_seconds_of_writing(activity, place / "again"), 3)

    def run(self, most: int, seed: int, bar: Any = None) -> None:
        """Kill one run a few times, until there are `most` kills; then let it end, and compare."""
        tally, start = self.tally, time.monotonic()
        random = Random(f"{seed} {tally.activity} {tally.kills} {tally.too_late}")
        when = f"run from kill {tally.kills} on"
        folder = Path(tempfile.mkdtemp(dir=self.place))
        for _ in range(min(random.randint(1, _MOST_IN_A_ROW), most - tally.kills)):
            before = tally.kills
            _kill(self.activity, folder, random, tally)
            if bar is not None:
                bar.update(tally.kills - before)
            _note(tally, f"{when}, kill {tally.kills}", self.activity.intact, folder, self.whole)
        try:
            _finish(self.activity, folder)
        except RuntimeError as error:
            tally.faults.append(f"{when}, after kill {tally.kills}: {error}")
        else:
            _note(tally, f"{when}, at its end", self.activity.same, folder, self.whole)
            tally.finished += 1
            tally.leftovers += sum(path.name.startswith(".") for path in folder.rglob("*"))
        tally.duration = round(tally.duration + time.monotonic() - start, 1)


def _note(tally: Tally, when: str, check: Any, folder: Path, whole: Path) -> None:
    try:
        check(folder, whole)
    except Exception as error:  # whatever a damaged file leads to
        tally.faults.append(f"{when}: {type(error).__name__}: {str(error)[:300]}")


def _start(command: Sequence[str], errors: Any = subprocess.DEVNULL) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        command,
        cwd=_ROOT,
        env=os.environ | ENVIRONMENT | {"XLA_FLAGS": ONE_DEVICE},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=errors,
        start_new_session=True,
    )


def _finish(activity: Activity, folder: Path) -> None:
    with tempfile.TemporaryFile() as errors:
        process = _start(activity.command(folder), errors)
        try:
            code = process.wait(timeout=_MOST_SECONDS)
        except subprocess.TimeoutExpired:
            _end(process, True)
            raise RuntimeError(f"it took longer than {_MOST_SECONDS} s") from None
        if code != 0:
            errors.seek(0)
            raise RuntimeError(f"it ended with code {code}: {errors.read().decode('utf-8', 'replace')[-300:]}")


def _seconds_of_writing(activity: Activity, folder: Path) -> float:
    """Return how long a run takes from what it writes first to its end, with everything compiled."""
    folder.mkdir()
    process = _start(activity.command(folder))
    while process.poll() is None and not activity.begun(folder):
        time.sleep(0.005)
    start = time.monotonic()
    process.wait(timeout=_MOST_SECONDS)
    return max(time.monotonic() - start, 0.05)


def _kill(activity: Activity, folder: Path, random: Random, tally: Tally) -> None:
    early, alone, moment = random.random() < _EARLY, random.random() < 0.3, random.random()
    going_on = activity.begun(folder)
    process = _start(activity.command(folder))
    start = time.monotonic()
    if early or going_on:  # the start takes seconds, in which what is there is read
        limit = (2 if early else 6 + tally.writing) * moment
    else:
        while process.poll() is None and not activity.begun(folder):
            time.sleep(0.002)
        start, limit = time.monotonic(), tally.writing * moment
    while process.poll() is None and time.monotonic() - start < limit:
        time.sleep(0.002)
    took = time.monotonic() - start
    _end(process, not alone)
    if process.returncode == -signal.SIGKILL:
        tally.kills += 1
        tally.before_writing += not activity.begun(folder)
    else:
        tally.too_late += 1
        if not early and not going_on:  # the machine does less besides than when this was measured
            tally.writing = round(min(tally.writing, max(took, 0.05)), 3)


def _end(process: subprocess.Popen[bytes], group: bool) -> None:
    """Kill a process, and those that it has started; the latter also where they would notice by themselves."""
    if not group:
        process.kill()
        process.wait()
        time.sleep(0.2)  # those that it has started write on for a moment
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main))
    except InputError as error:
        print(f"kills: {error}", file=sys.stderr)
        sys.exit(2)
