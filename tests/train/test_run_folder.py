"""A run's folder on a full disk, with a signal besides, and with a second process."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from kmn_jax.errors import InputError
from kmn_jax.train import train
from kmn_jax.train._checkpoint import Checkpoints
from kmn_jax.train._lock import only_one
from kmn_jax.train._loop import Outcome
from kmn_jax.train._records import add_metrics
from tests.train.loop_sample import assert_same_runs, newest, tiny
from tests.train.snapshot_sample import abstract_state, assert_same, random_snapshot

pytestmark = [
    pytest.mark.usefixtures("compiled"),
    pytest.mark.filterwarnings("ignore:Error .*ing persistent compilation cache:UserWarning"),
]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 16 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode != 0:
        pytest.skip("a small file system cannot be mounted: run as root")
    yield disk
    subprocess.run(["umount", "--lazy", str(disk)], check=True)


def fill(disk: Path, leaving: int = 0) -> None:
    """Take all space but so many bytes."""
    free = shutil.disk_usage(disk).free
    with contextlib.suppress(OSError), (disk / "filler").open("wb") as file:
        file.write(b"\0" * (free - leaving))


def quietly(folder: Path, report: Callable[[str], Any] = str, resume: bool = True) -> Outcome:
    return train(tiny(), folder, resume=resume, progress=False, report=report)


def test_a_full_disk_and_a_signal_lose_nothing(whole: tuple[Path, Outcome], small_disk: Path) -> None:
    folder = small_disk / "run"

    def fill_and_terminate(message: str) -> None:
        if message.startswith("step 3"):
            fill(small_disk)
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(InputError, match="No space left on device"):
        quietly(folder, fill_and_terminate)
    assert int(newest(folder / "checkpoints").state.step) == 2
    with pytest.raises(InputError, match="No space left on device"):
        quietly(folder)  # nothing can be written, but nothing is lost by the attempt
    with pytest.raises(InputError, match=r"cannot write .*metrics\.jsonl: No space left on device"):
        add_metrics(folder, {"step": 1, "split": "train" * 2000})
    (small_disk / "filler").unlink()
    assert quietly(folder) == whole[1]
    assert_same_runs(folder, whole[0])


# Threads of orbax, too, meet the full disk, and say so after the loop that they belong to has ended.
@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::pytest.PytestUnhandledThreadExceptionWarning"
)
def test_a_checkpoint_that_does_not_fit_is_told_and_the_one_before_kept(
    small_disk: Path, caplog: pytest.LogCaptureFixture
) -> None:
    checkpoints, free = Checkpoints(small_disk / "run"), shutil.disk_usage(small_disk).free
    checkpoints.save(random_snapshot(1))
    size = free - shutil.disk_usage(small_disk).free
    fill(small_disk, leaving=size // 2)
    with pytest.raises(InputError, match="cannot save step 2 to"):
        checkpoints.save(random_snapshot(2))
    assert [record for record in caplog.records if record.name == "absl"] == []  # tracebacks of orbax's threads
    assert_same(Checkpoints(small_disk / "run", report=str).latest(abstract_state()), random_snapshot(1))
    (small_disk / "filler").unlink()
    checkpoints.save(random_snapshot(2))
    assert_same(Checkpoints(small_disk / "run").latest(abstract_state()), random_snapshot(2))


def test_a_second_process_is_refused_before_it_writes(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with only_one(folder), pytest.raises(InputError, match="another process trains in"):
        quietly(folder)
    assert list(folder.iterdir()) == []
    with only_one(folder):  # which is free again
        pass
