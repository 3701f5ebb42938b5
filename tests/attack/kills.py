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
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import tyro
from tqdm import tqdm

from kmn_jax.errors import InputError
from kmn_jax.report import check_target, commit, print_table, processor, write_json
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
    too_late: int = 0  # had ended before the signal came
    faults: list[str] = field(default_factory=list)
    leftovers: int = 0  # hidden files that lie there when a run has finished
    seconds: float = 0.0  # of the run without a stop
    duration: float = 0.0  # s, of all
    commit: str | None = None


def main(kills: int = 200, seed: int = 0, json: Path | None = None, only: str = "", resume: bool = False) -> int:
    """Kill, and return 1 if anything was lost or differs.

    Args:
        kills: how many, shared by all activities.
        seed: number that the moments follow from, as far as clocks allow.
        json: where counts and faults go, after each activity.
        only: name of one activity; the others are left out.
        resume: keep what is in that file of activities that were killed as often from the same seed without a fault.
    """
    chosen = {name: activity for name, activity in ACTIVITIES.items() if only in ("", name)}
    if not chosen:
        raise InputError(f"there is no activity {only!r}: there are {', '.join(ACTIVITIES)}")
    check_target(json)
    done = _without_faults(json, seed) if resume and json is not None else {}
    with tqdm(total=kills, unit="kill") as bar:
        for row, (name, activity) in enumerate(chosen.items()):
            share = kills // len(chosen) + (row < kills % len(chosen))
            if name in done and done[name].kills == share:
                bar.update(share)
            else:
                done[name] = killed(name, activity, share, Random(f"{seed} {name}"), bar)
            tallies = list(done.values())
            sums = {"kills": sum(one.kills for one in tallies), "faults": sum(len(one.faults) for one in tallies)}
            machine = {"processor": processor(), "cores": os.cpu_count()}
            write_json(json, {**sums, "activities": list(map(asdict, tallies)), "seed": seed, **machine})
    print_table(f"{sums['kills']} kills, seed {seed}", [asdict(one) | {"faults": len(one.faults)} for one in tallies])
    for tally in tallies:
        for fault in tally.faults:
            print(f"{tally.activity}: {fault}")
    return int(sums["faults"] > 0)


def _without_faults(path: Path, seed: int) -> dict[str, Tally]:
    """Return what an earlier run, from the same seed, has written of activities in which nothing was lost."""
    if not path.exists():
        return {}
    found = json_format.loads(path.read_text(encoding="utf-8"))
    tallies = [Tally(**row) for row in found["activities"] if found["seed"] == seed]
    return {tally.activity: tally for tally in tallies if not tally.faults}


def killed(name: str, activity: Activity, kills: int, random: Random, bar: Any = None) -> Tally:
    """Kill runs of an activity so many times, and let each of them end after a few kills."""
    tally, begin = Tally(name, commit=commit()), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="kills-") as place:
        whole = Path(place, "whole")
        whole.mkdir()
        start = time.monotonic()
        _finish(activity, whole)
        tally.seconds = round(time.monotonic() - start, 1)
        writes = _seconds_of_writing(activity, Path(place, "again"))
        number = 0
        while tally.kills < kills:
            folder = Path(place, str(number))
            folder.mkdir()
            number += 1
            for _ in range(min(random.randint(1, _MOST_IN_A_ROW), kills - tally.kills)):
                _kill(activity, folder, writes, random, tally)
                if bar is not None:
                    bar.update()
                _note(tally, f"run {number}, kill {tally.kills}", activity.intact, folder, whole)
            try:
                _finish(activity, folder)
            except RuntimeError as error:
                tally.faults.append(f"run {number}, after kill {tally.kills}: {error}")
                continue
            _note(tally, f"run {number}, at its end", activity.same, folder, whole)
            tally.finished += 1
            tally.leftovers += sum(path.name.startswith(".") for path in folder.rglob("*"))
    tally.duration = round(time.monotonic() - begin, 1)
    return tally


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


def _kill(activity: Activity, folder: Path, writes: float, random: Random, tally: Tally) -> None:
    early, alone, moment = random.random() < _EARLY, random.random() < 0.3, random.random()
    going_on = activity.begun(folder)
    process = _start(activity.command(folder))
    start = time.monotonic()
    if early or going_on:  # the start takes seconds, in which what is there is read
        limit = (2 if early else 6 + writes) * moment
    else:
        while process.poll() is None and not activity.begun(folder):
            time.sleep(0.002)
        start, limit = time.monotonic(), writes * moment
    while process.poll() is None and time.monotonic() - start < limit:
        time.sleep(0.002)
    tally.kills += 1
    tally.too_late += process.poll() is not None
    tally.before_writing += not activity.begun(folder)
    _end(process, not alone)
    assert process.returncode is not None


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
