from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.train import data_mesh, initialize_distributed, read_metrics, split_cpu, train
from kmn_jax.train._sharding import check_batch
from kmn_jax.train._window import MEANS
from tests.reference.compiled import with_devices
from tests.train.loop_sample import ENVIRONMENT, ROOT, flags, newest, run_train, tiny
from tests.train.sharded_run import SHARED, losses, squared_norm

pytestmark = [
    pytest.mark.usefixtures("compiled"),
    pytest.mark.filterwarnings("ignore:Error .*ing persistent compilation cache:UserWarning"),
]


@pytest.fixture(scope="module")
def one(compiled: None) -> dict[str, Any]:
    """Six steps on one device."""
    return losses(tiny(**SHARED), jax.devices()[:1])


def assert_alike(found: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Compare two trainings that differ in nothing but rounding."""
    metrics = np.array(wanted["metrics"])
    assert metrics[:, -1].all()
    assert np.ptp(metrics[:, 0]) > 0.01
    # Sums in another order round differently, and so do the parameters of the next steps.
    np.testing.assert_allclose(found["metrics"][0], metrics[0], rtol=2e-6)
    np.testing.assert_allclose(found["metrics"], metrics, rtol=2e-3)
    np.testing.assert_allclose(found["norms"], wanted["norms"], rtol=1e-4)


def test_crops_one_after_the_other_train_alike(one: dict[str, Any]) -> None:
    assert_alike(losses(tiny(**SHARED, crops_at_once=1), jax.devices()[:1]), one)


@pytest.mark.timeout(600)
def test_one_and_eight_devices_train_alike(one: dict[str, Any]) -> None:
    process = subprocess.run(
        [sys.executable, "-m", "tests.train.sharded_run"],
        cwd=ROOT,
        env=os.environ | ENVIRONMENT | {"XLA_FLAGS": with_devices(8)},
        capture_output=True,
        text=True,
        timeout=580,
    )
    assert process.returncode == 0, process.stderr
    eight = json.loads(process.stdout.splitlines()[-1])
    assert (one["devices"], one["rows"]) == (1, 16)
    assert (eight["devices"], eight["rows"]) == (8, 2)
    assert_alike(eight, one)


@pytest.mark.timeout(600)
def test_two_processes_go_on_with_a_run_as_one_would_and_stop_together(one: dict[str, Any], tmp_path: Path) -> None:
    changes = {**SHARED, "log_every": 1, "validate_every": 100, "checkpoint_every": 100, "num_steps": 100}
    folder = tmp_path / "run"
    assert train(tiny(**changes), folder, max_minutes=0.0, progress=False).step == 0
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    with ExitStack() as stack:
        both = []
        for number, time in enumerate(([], ["--max-minutes", 0])):
            joined = ["--coordinator", f"localhost:{port}", "--processes", 2, "--process", number]
            both.append(
                stack.enter_context(run_train(*flags(**changes), "--folder", folder, "--resume", *joined, *time))
            )
            stack.callback(both[-1].kill)
        ended = [process.communicate(timeout=580) for process in both]
    for process, (output, errors) in zip(both, ended, strict=True):
        assert process.returncode == 0, output + errors
    # The loop stops at the same step in both, since one has no time left.
    reasons = [output.splitlines()[-1].partition(";")[0] for output, _ in ended]
    assert reasons == [
        f"stopped after step 3 of 100 because {reason}"
        for reason in ("another process was told to stop", "0 minutes are over")
    ]
    rows = read_metrics(folder)
    assert [(row["step"], row["split"]) for row in rows] == [(1, "train"), (2, "train"), (3, "train")]
    found = np.array([[row[name] for name in (*MEANS, "gradient_norm")] for row in rows])
    wanted = np.array(one["metrics"])[:3, [0, 1, 2, 3, 4, 6]]
    np.testing.assert_allclose(found[0], wanted[0], rtol=2e-6)
    np.testing.assert_allclose(found, wanted, rtol=2e-3)
    saved = newest(folder / "checkpoints")
    assert json.loads(saved.batches)["next_batch"] == 3
    np.testing.assert_allclose(squared_norm(saved.state), one["norms"][2], rtol=1e-4)


def test_batches_that_devices_cannot_share_are_refused() -> None:
    mesh = data_mesh(jax.devices()[:1] * 3)
    for at_once in (None, 1, 2, 4):
        check_batch(12, tiny(**{"pipeline.batch_size": 12, "crops_at_once": at_once}).step, mesh)
    with pytest.raises(InputError, match=r"a batch of 8, in groups of 2 .* by 3 devices .* a multiple of 6"):
        check_batch(8, tiny(**{"pipeline.batch_size": 8, "crops_at_once": 1}).step, mesh)
    with pytest.raises(InputError, match="that take 4 at once: choose a batch_size that is a multiple of 12"):
        check_batch(18, tiny(**{"pipeline.batch_size": 18, "crops_at_once": 4}).step, mesh)


def test_processes_are_joined_only_where_there_are_any(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[Any, ...]] = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda *arguments: calls.append(arguments))
    for name in ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE", "JOB_COMPLETION_INDEX"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("SLURM_NTASKS", "8")  # of a batch script, of whose tasks none has been started
    assert not initialize_distributed()
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "1")
    assert not initialize_distributed()
    assert calls == []
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "8")
    assert initialize_distributed()
    assert calls == [(None, None, None)]
    assert initialize_distributed("host:1234", 2, 1)
    assert calls[1:] == [("host:1234", 2, 1)]
    with pytest.raises(InputError, match="belong together: give all"):
        initialize_distributed("host:1234", 2)
    with pytest.raises(InputError, match="process = 2 must be from 0 to below processes = 2"):
        initialize_distributed("host:1234", 2, 2)


@pytest.mark.parametrize(("groups", "devices"), [(8, 4), (6, 3), (7, 1), (4, 4)])
def test_cores_become_devices_that_can_share_a_batch(
    groups: int, devices: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[tuple[str, int]] = []
    monkeypatch.setattr(jax.config, "update", lambda *arguments: found.append(arguments))
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(5)), raising=False)
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=3")
    split_cpu(groups)
    assert found == []
    monkeypatch.delenv("XLA_FLAGS")
    split_cpu(groups)
    assert found == [("jax_num_cpu_devices", devices)]
