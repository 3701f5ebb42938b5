"""How long it takes that begins with nothing in memory: `kmn detect`, and a search from Python, in fresh processes.

python -m benchmarks.cold_start [--times 5] [--json FILE]

The first process ever finds an empty cache and compiles everything; those after it read what is kept. The part is a CAD
file, which is kept as well, or an object card. A search from Python, which keeps nothing, compiles each
time. Times are of the whole process, Python's start and imports included.
"""

from __future__ import annotations

import json as jsons
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.command import run
from kmn_jax.errors import InputError
from kmn_jax.report import print_table, write_json

_PART = Path("experiments/assets/industrial/gear_motor.stl")
_SCENE = Path("experiments/assets/small_test_set/test/000002/depth/000000.png")
_PYTHON = f"""
import json
from kmn_jax import PoseEstimator

estimator = PoseEstimator.from_pretrained()
timing = estimator.detect(estimator.prepare({str(_PART)!r}), {str(_SCENE)!r}).timing
print(json.dumps({{"total_s": timing.total, "compile_s": timing.compile}}))
"""


def main(times: int = 5, firsts: int = 1, json: Path | None = None) -> None:
    """Time fresh processes.

    Args:
        times: processes of each kind that begin with a filled cache.
        firsts: processes that begin with an empty one, and searches from Python.
        json: file for the results.
    """
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        card = Path(scratch) / "part.kmn"
        empty = [_run(Path(scratch) / f"cache{number}", _PART) for number in range(firsts)]
        cache = Path(scratch) / "cache0"
        _kmn(cache, "prepare", str(_PART), "-o", str(card))
        rows.append(_row("first ever, CAD file", empty))
        rows.append(_row("later, CAD file", [_run(cache, _PART) for _ in range(times)]))
        rows.append(_row("later, object card", [_run(cache, card) for _ in range(times)]))
        rows.append(_row("from Python, nothing kept, CAD file", [_run_python() for _ in range(firsts)]))
    print_table("a detection in a fresh process", rows)
    write_json(json, {"processes": rows})


def _row(name: str, runs: list[tuple[float, dict[str, float]]]) -> dict[str, Any]:
    whole = [seconds for seconds, _ in runs]
    return {
        "process": name,
        "times": len(runs),
        "median s": statistics.median(whole),
        "least s": min(whole),
        "of it compiling or reading programs": statistics.median(timing["compile_s"] for _, timing in runs),
        "of it the rest of the command": statistics.median(
            timing["total_s"] - timing["compile_s"] for _, timing in runs
        ),
    }


def _run(cache: Path, part: Path) -> tuple[float, dict[str, float]]:
    """Return the seconds of a whole process, and what it says of them."""
    result = cache.with_suffix(".json")
    start = time.perf_counter()
    _kmn(cache, "detect", "--object", str(part), "--scene", str(_SCENE), "--json", str(result))
    seconds = time.perf_counter() - start
    timing: dict[str, float] = jsons.loads(result.read_text())["timing"]
    return seconds, timing


def _run_python() -> tuple[float, dict[str, float]]:
    """Return the seconds of a process that searches from Python, and what the result says of them."""
    start = time.perf_counter()
    printed = _python("a search from Python", None, "-c", _PYTHON)
    seconds = time.perf_counter() - start
    timing: dict[str, float] = jsons.loads(printed)
    return seconds, timing


def _kmn(cache: Path, *arguments: str) -> None:
    _python(f"kmn {arguments[0]}", cache, "-m", "kmn_jax.cli", *arguments)


def _python(name: str, cache: Path | None, *arguments: str) -> str:
    """Return what a process prints that keeps its programs in a cache, or none. Raises InputError if it fails."""
    environment = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    if cache is not None:
        environment["JAX_COMPILATION_CACHE_DIR"] = str(cache)
    done = subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True)
    if done.returncode:
        raise InputError(f"{name} failed: {done.stderr.strip()}")
    return done.stdout


if __name__ == "__main__":
    run(main)
