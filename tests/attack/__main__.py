"""Attack readers with damaged files of every format: `python -m tests.attack --cases 20000 --seed 0 --json FILE`.

Every case is read in a worker process with 20 s of the processor and 4 GB. Failures are kept in a folder, and each can
be shown again by its name: `python -m tests.attack --replay FORMAT:NUMBER:SEED`.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro
from tqdm import tqdm

from kmn_jax.errors import InputError
from kmn_jax.report import check_target, commit, print_table, processor, write_json
from tests.attack.bombs import bombs
from tests.attack.cases import (
    BAD,
    BYTES,
    GOOD,
    SECONDS,
    Case,
    Outcome,
    as_row,
    damaged,
    judge,
    limit_memory,
    whole_folders,
)
from tests.attack.pool import outcomes
from tests.attack.targets import targets


def main(
    cases: int = 20_000,
    seed: int = 0,
    json: Path | None = None,
    only: str = "",
    workers: int | None = None,
    keep: Path = Path("outputs/attack"),
    replay: str | None = None,
) -> int:
    """Attack, and return 1 if a reader failed.

    Args:
        cases: how many, over all formats; the slower a format is read, the fewer it gets.
        seed: number that all damage follows from.
        json: where counts and failures go.
        only: text that is part of the names of formats; the others are left out.
        workers: processes; as many as there are cores unless given.
        keep: folder for the files that readers failed on.
        replay: FORMAT:NUMBER:SEED, one case, read in this process.
    """
    if replay is not None:
        return _replay(replay, keep)
    check_target(json)
    chosen = planned(cases, seed, only)
    start = time.perf_counter()
    found: list[Outcome] = []
    for outcome in tqdm(outcomes(chosen, workers or os.cpu_count() or 1), total=len(chosen), unit="case"):
        found.append(outcome)
        if outcome.kind in BAD:
            save(outcome.case, keep)
    seconds = time.perf_counter() - start
    print_table(f"{len(found)} cases in {seconds:.0f} s, seed {seed}", table(found))
    failures = [as_row(outcome) for outcome in found if outcome.kind in BAD]
    classes = classes_of(found)
    print_table("Failures", classes)
    write_json(json, {**facts(found, seconds, seed), "classes": classes, "failures": failures})
    return 1 if failures else 0


def planned(cases: int, seed: int, only: str = "") -> list[Case]:
    """Return so many cases over all formats, bombs first, formats in turn."""
    chosen = {name: target for name, target in targets().items() if only in name}
    if not chosen:
        raise InputError(f"no format is called like {only!r}: there are {', '.join(targets())}")
    shares = sum(target.share for target in chosen.values())
    counts = {
        name: max(len(bombs().get(name, ())) + 1, round(cases * target.share / shares))
        for name, target in chosen.items()
    }
    rows = [
        ((number + 0.5) / count, Case(name, number, seed)) for name, count in counts.items() for number in range(count)
    ]
    return [case for _, case in sorted(rows, key=lambda row: row[0])]


def table(found: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return counts of outcomes for each format, the slowest case and the largest."""
    rows = []
    for name in targets():
        own = [outcome for outcome in found if outcome.case.target == name]
        if own:
            counts = Counter(outcome.kind for outcome in own)
            limits = {"most s": max(o.seconds for o in own), "most MB": max(o.megabytes for o in own)}
            rows.append({"format": name, "cases": len(own), **{kind: counts[kind] for kind in (*GOOD, *BAD)}, **limits})
    return rows


def classes_of(found: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return failures that are alike, the first of each with its command."""
    classes: dict[tuple[str, ...], list[Outcome]] = {}
    for outcome in found:
        if outcome.kind in BAD:
            said = outcome.said.partition(":")[0] if outcome.kind == "exception" else ""
            classes.setdefault((outcome.case.target, outcome.kind, outcome.where, said), []).append(outcome)
    return [
        {
            "format": key[0],
            "kind": key[1],
            "count": len(alike),
            "where": key[2],
            "said": alike[0].said.partition("\n")[0][:100],
            "replay": as_row(alike[0])["replay"],
        }
        for key, alike in sorted(classes.items())
    ]


def facts(found: Sequence[Outcome], seconds: float, seed: int) -> dict[str, Any]:
    """Return counts, and where and how they were found."""
    return {
        "cases": len(found),
        "counts": {kind: sum(outcome.kind == kind for outcome in found) for kind in (*GOOD, *BAD)},
        "seed": seed,
        "seconds": round(seconds),
        "limits": {"seconds": SECONDS, "bytes": BYTES},
        "processor": processor(),
        "cores": os.cpu_count(),
        "commit": commit(),
        "formats": table(found),
    }


def save(case: Case, keep: Path) -> Path:
    """Keep a damaged file, named by format, number and seed."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        targets()[case.target].prepare(folder)
        path = damaged(case, folder)
        keep.mkdir(parents=True, exist_ok=True)
        return Path(shutil.copyfile(path, keep / f"{str(case).replace(':', '_')}{path.suffix}"))


def _replay(text: str, keep: Path) -> int:
    name, _, rest = text.partition(":")
    number, _, seed = rest.partition(":")
    if name not in targets() or not number.isdigit() or not (seed or "0").isdigit():
        raise InputError(f"{text} is no case: give FORMAT:NUMBER:SEED, formats are {', '.join(targets())}")
    case = Case(name, int(number), int(seed or 0))
    print(f"the damaged file: {save(case, keep)}", flush=True)
    limit_memory()
    with tempfile.TemporaryDirectory() as folder:
        outcome = judge(case, whole_folders(Path(folder), [name]))
    for key, value in as_row(outcome).items():
        print(f"{key}: {value}")
    return 1 if outcome.kind in BAD else 0


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main))
    except InputError as error:
        print(f"attack: {error}", file=sys.stderr)
        sys.exit(2)
