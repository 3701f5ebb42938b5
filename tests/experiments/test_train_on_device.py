"""The script that trains on a lent machine: runs go on beside other calls, and what comes back can be carried."""

from __future__ import annotations

import io
import os
import subprocess
import tarfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "experiments" / "train_on_device.sh"
MOST_FILES, MOST_BYTES = 8, 16 * 2**20  # that such a machine gives back

# Takes the place of Python: a run that has a checkpoint, and saves another one when it is told to stop.
_PYTHON = """#!/bin/bash
run=$5
mkdir -p "$run/checkpoints/step-1" "$run/checkpoints/step-2"
echo "{\\"step\\": 1, \\"steps\\": \\"$*\\"}" >>"$run/metrics.jsonl"
head -c 9000000 /dev/urandom >"$run/checkpoints/step-1/state"
touch -d "1 hour ago" "$run/checkpoints/step-1"
[ "$3" != bad ] || { echo "ValueError: no pack"; exit 1; }
save() {
  cp "$run/checkpoints/step-1/state" "$run/checkpoints/step-2/state"
  echo weights >"$run/last.safetensors"
  exit 0
}
trap save TERM
while true; do sleep 0.05; done
"""


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[dict[str, str]]:
    (tmp_path / "bin").mkdir()
    python = tmp_path / "bin" / "python3"
    python.write_text(_PYTHON)
    python.chmod(0o755)
    (tmp_path / "state" / "tree").mkdir(parents=True)  # in place of a copy of the checkout
    yield {"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}", "KMN_DEVICE": str(tmp_path / "state")}
    subprocess.run(["pkill", "-KILL", "-f", "--", f"--folder {tmp_path}"], check=False)


def call(machine: dict[str, str], *arguments: str) -> str:
    done = subprocess.run(["bash", SCRIPT, *arguments], capture_output=True, text=True, env=machine, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


def wait_for(path: Path, text: str = "") -> None:
    for _ in range(200):
        if path.exists() and text in path.read_bytes().decode(errors="replace"):
            return
        time.sleep(0.05)
    raise AssertionError(f"{path} was not written, or without {text!r}")


def packed(folder: Path) -> list[str]:
    """Return the names of what was packed into a folder, in pieces that can be given back."""
    pieces = sorted(folder.iterdir())
    assert len(pieces) <= MOST_FILES
    assert max(piece.stat().st_size for piece in pieces) <= MOST_BYTES
    with tarfile.open(fileobj=io.BytesIO(b"".join(piece.read_bytes() for piece in pieces))) as whole:
        return whole.getnames()


def test_a_pack_comes_in_parts(machine: dict[str, str], tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / "made" / name).mkdir(parents=True)
        (tmp_path / "made" / name / "object").write_text(name)
        (tmp_path / name).mkdir()
        with tarfile.open(tmp_path / name / "pack.tar.xz", "w:xz") as archive:
            archive.add(tmp_path / "made" / name, f"surfels/objects/{name}")
        call(machine, "take", str(tmp_path / name))
    packs = tmp_path / "state" / "tree" / "outputs" / "packs"
    assert [(packs / "surfels" / "objects" / name / "object").read_text() for name in "ab"] == ["a", "b"]


def test_runs_outlive_the_call_and_come_back_whole(machine: dict[str, str], tmp_path: Path) -> None:
    state = tmp_path / "state"
    call(machine, "start", "2", "long", "bad", "short")
    for name in ("long", "bad", "short"):  # the third one when one of the first two has ended
        wait_for(state / "runs" / name / "metrics.jsonl")
    (state / "runs" / "short" / "model.safetensors").write_text("weights so far")
    said = call(machine, "look", str(tmp_path / "back"))
    assert "bad did not end well" in said
    assert "ValueError: no pack" in said
    assert {"runs/short/model.safetensors", "runs/long/metrics.jsonl"} <= set(packed(tmp_path / "back"))

    call(machine, "steps", "long", "700")
    wait_for(state / "runs" / "long" / "checkpoints" / "step-2" / "state")
    wait_for(state / "runs" / "long" / "metrics.jsonl", "--num-steps 700")
    call(machine, "stop", str(tmp_path / "back"))

    names = packed(tmp_path / "back")
    assert {"runs/long/last.safetensors", "runs/short/last.safetensors", "logs/bad.log"} <= set(names)
    assert [name for name in names if "checkpoints" in name] == ["runs/long/checkpoints/step-2/state"]
