"""The script for a lent machine: what it brings back fits, and what is compiled once is given to the next call."""

from __future__ import annotations

import os
import subprocess
import tarfile
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "on_device.sh"
MOST_FILES, MOST_BYTES = 8, 16 * 2**20  # that such a machine gives back

# Takes the place of Python: writes what a benchmark would, and as large programs as XLA compiles.
_PYTHON = """#!/bin/bash
[ "$1" = -m ] || { echo "no jax"; exit 0; }
ls "$JAX_COMPILATION_CACHE_DIR" | sed 's/^/knows /'
[ "$2" != benchmarks.pose ] || exit 3
while [ "$1" != --json ]; do shift; done
echo "{}" >"$2"
for number in 1 2 3 4 5; do
  head -c 7000000 /dev/urandom >"$JAX_COMPILATION_CACHE_DIR/$(basename "$2" .json)-$number"
done
"""


@pytest.fixture
def call(tmp_path: Path) -> str:
    (tmp_path / "bin").mkdir()
    python = tmp_path / "bin" / "python3"
    python.write_text(_PYTHON)
    python.chmod(0o755)
    return f"{tmp_path / 'bin'}:{os.environ['PATH']}"


def run(path: str, *arguments: str) -> str:
    done = subprocess.run(
        ["bash", SCRIPT, *arguments], capture_output=True, text=True, env={"PATH": path, "MOST_PIECES": "2"}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_what_comes_back_fits_and_goes_on(call: str, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    run(call, "-", "-", str(first), "compiled", "pose", "knn")
    files = sorted(first.iterdir())
    assert [file.name for file in files] == ["cache.tar.aa", "cache.tar.ab", "results.tar.gz"]
    assert len(files) <= MOST_FILES
    assert max(file.stat().st_size for file in files) <= MOST_BYTES
    with tarfile.open(first / "results.tar.gz") as results:
        names = {Path(name).name for name in results.getnames()}
        said = results.extractfile("./pose.txt")
        assert said is not None
        assert "pose did not end well" in said.read().decode()
    assert names >= {"compiled.json", "compiled.txt", "knn.json", "knn.txt", "pose.txt"}

    known = {line for line in run(call, "-", str(first), str(second), "pose").splitlines() if line.startswith("knows")}
    assert len(known) == 4  # as many as two pieces hold, the newest ones
    assert {line.split("-")[0] for line in known} == {"knows knn"}
