from __future__ import annotations

import csv
import json
import os
import shlex
import shutil
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from experiments.train import main
from kmn_jax.errors import InputError
from kmn_jax.models import load_model
from kmn_jax.train import (
    NotFiniteError,
    OptimizerConfig,
    data_mesh,
    jit_train_step,
    read_metrics,
    train,
    training_source,
)
from kmn_jax.train import _loop as loop
from kmn_jax.train._checkpoint import Checkpoints
from kmn_jax.train._loop import Outcome
from tests.train.loop_sample import ONE_DEVICE, assert_same_runs, assert_same_states, flags, newest, run_train, tiny

pytestmark = [
    pytest.mark.usefixtures("compiled"),
    pytest.mark.filterwarnings("ignore:Error .*ing persistent compilation cache:UserWarning"),
]


@pytest.fixture(autouse=True)
def one_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the command leave the devices of this process as they are."""
    monkeypatch.setenv("XLA_FLAGS", ONE_DEVICE)


@pytest.fixture(autouse=True)
def one_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trace the step once for runs of all lengths: of a schedule of steps it is the same."""

    def of_usual_length(graphdef: Any, optimizer: OptimizerConfig, num_steps: int, *more: Any) -> Any:
        assert optimizer.schedule == "step"
        return jit_train_step(graphdef, optimizer, tiny().num_steps, *more)

    monkeypatch.setattr(loop, "jit_train_step", of_usual_length)


def train_quietly(folder: Path, resume: bool = False, **changes: Any) -> Outcome:
    return train(tiny(**changes), folder, resume=resume, progress=False, report=lambda message: None)


def digest(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def damage(checkpoint: Path) -> None:
    """Flip a bit of the largest file."""
    path = max((path for path in checkpoint.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_a_run_writes_config_versions_metrics_and_models(whole: tuple[Path, Outcome]) -> None:
    folder, outcome = whole
    config = json.loads((folder / "config.json").read_text())
    assert config["network"]["num_scene_points"] == 64
    assert config["optimizer"]["learning_rate"] == 1e-2
    session = json.loads((folder / "sessions.jsonl").read_text())
    assert session["versions"]["jax"] == jax.__version__
    assert session["step"] == 0
    written = [(row["split"], row["step"], row["samples"]) for row in read_metrics(folder)]
    assert written == [("validation", 3, 12), ("train", 4, 16), ("train", 6, 24), ("validation", 6, 24)]
    losses = {row["step"]: row["loss"] for row in read_metrics(folder) if row["split"] == "validation"}
    assert outcome == Outcome(6, "", min(losses.values()), min(losses, key=losses.__getitem__))
    rates = [row["learning_rate"] for row in read_metrics(folder) if row["split"] == "train"]
    np.testing.assert_allclose(rates, [1e-2 * 0.7, 1e-2 * 0.7**2], rtol=1e-6)
    with (folder / "metrics.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    for row, line in zip(read_metrics(folder), table, strict=True):
        assert float(line["loss"]) == pytest.approx(row["loss"], rel=1e-6)
        assert {name for name, text in line.items() if text} == set(row)
    average = newest(folder / "checkpoints").state.average
    for found, wanted in zip(
        jax.tree.leaves(load_model(folder / "last.safetensors").parameters), jax.tree.leaves(average), strict=True
    ):
        np.testing.assert_array_equal(found, wanted)
    assert load_model(folder / "model.safetensors").config == tiny().network


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_resume_after_a_signal_is_bitwise(whole: tuple[Path, Outcome], tmp_path: Path, number: signal.Signals) -> None:
    folder, handler = tmp_path / "run", signal.getsignal(number)

    def stop_at_validation(message: str) -> None:
        if message.startswith("step 3"):
            os.kill(os.getpid(), number)

    stopped = train(tiny(), folder, progress=False, report=stop_at_validation)
    assert (stopped.step, stopped.reason) == (3, f"{number.name} came")
    assert signal.getsignal(number) == handler
    assert json.loads(newest(folder / "checkpoints").batches)["next_batch"] == 3
    # What a process that was killed later on would have left.
    later = {"step": 4, "split": "train", "loss": 99.0}
    for name, text in (("metrics.jsonl", json.dumps(later) + '\n{"step": 5, "spl'), ("metrics.csv", "4,16,train,99\n")):
        with (folder / name).open("a") as file:
            file.write(text)
    with pytest.raises(InputError, match="holds a run: resume it"):
        train(tiny(), folder)
    with pytest.raises(InputError, match=r"random_seed = 0, not 1: resume with the same"):
        train(tiny(random_seed=1), folder, resume=True)
    reports: list[str] = []
    outcome = train(tiny(), folder, resume=True, progress=False, report=reports.append)
    assert reports[0] == "going on at step 3 of 6"
    assert outcome == whole[1]
    assert_same_runs(folder, whole[0])
    assert (folder / "metrics.csv").read_text().count("\n") == 5
    assert [json.loads(line)["step"] for line in (folder / "sessions.jsonl").read_text().splitlines()] == [0, 3]


def test_a_killed_and_a_terminated_process_leave_a_run_to_go_on_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    long = {"num_steps": 20, "validate_every": 10, "checkpoint_every": 3, "log_every": 2}
    train_quietly(tmp_path / "whole", **long)
    folder, random = tmp_path / "a run", np.random.default_rng()
    command = [*flags(**long), "--folder", str(folder), "--resume"]

    def wait(fewest: int, ended: Callable[[], object]) -> None:
        """Wait for some moment while the run has this row, of 12 that it writes, or one of the next."""
        rows = max(random.integers(fewest, fewest + 3), len(read_metrics(folder)) + 1)
        while len(read_metrics(folder)) < rows and not ended():
            time.sleep(0.02)
        time.sleep(random.uniform(0, 0.3))

    with run_train(*command) as process:
        wait(1, lambda: process.poll() is not None)
        process.send_signal(signal.SIGKILL)
        _, errors = process.communicate(timeout=200)
    assert "Traceback" not in errors, errors
    assert process.returncode == -signal.SIGKILL, errors

    # Then this process, which has traced the step; a signal that comes too late does not end it.
    before, ended = signal.signal(signal.SIGTERM, signal.SIG_IGN), threading.Event()

    def terminate() -> None:
        wait(5, ended.is_set)
        os.kill(os.getpid(), signal.SIGTERM)

    sender = threading.Thread(target=terminate)
    sender.start()
    capsys.readouterr()
    try:
        assert main(command) == 0
    finally:
        ended.set()
        sender.join()
        signal.signal(signal.SIGTERM, before)
    output, errors = capsys.readouterr()
    assert "Traceback" not in errors, errors
    assert "because SIGTERM came" in output, output
    name, again = output.splitlines()[-1].split(" because SIGTERM came; go on with: python -m experiments.train ")
    assert name.startswith("stopped after step ")
    assert main(shlex.split(again)) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("done: 20 steps; best validation loss")
    assert_same_runs(folder, tmp_path / "whole")


@pytest.mark.parametrize("place", ["before the checkpoint", "after the checkpoint", "before the last model"])
def test_a_kill_between_two_files_loses_none(
    whole: tuple[Path, Outcome], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    class Killed(BaseException):
        pass

    def after(function: Callable[..., Any], steps: int) -> Callable[..., Any]:
        def killed(*arguments: Any, **named: Any) -> None:
            nonlocal steps
            function(*arguments, **named)
            steps -= 1
            if steps == 0:
                raise Killed

        return killed

    if place == "after the checkpoint":
        monkeypatch.setattr(Checkpoints, "save", after(Checkpoints.save, 3))  # steps 0, 2 and 3
    else:
        models = 1 if place == "before the checkpoint" else 2
        monkeypatch.setattr(loop, "save_model", after(loop.save_model, models))
    with pytest.raises(Killed):
        train_quietly(tmp_path / "run")
    monkeypatch.undo()
    assert train_quietly(tmp_path / "run", resume=True) == whole[1]
    assert_same_runs(tmp_path / "run", whole[0])


def test_a_damaged_checkpoint_is_reported_and_the_one_before_used(
    whole: tuple[Path, Outcome], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(whole[0], tmp_path / "run")
    paths = sorted((folder / "checkpoints").iterdir())
    damage(paths[-1])
    reports: list[str] = []
    outcome = train(tiny(), folder, resume=True, progress=False, report=reports.append)
    assert reports[0].startswith(f"{paths[-1]} is damaged and is not used: ")
    assert reports[1] == f"going on at step {int(paths[-2].name.split('-')[1])} of 6"
    assert outcome == whole[1]
    assert_same_runs(folder, whole[0])
    for path in (folder / "checkpoints").iterdir():
        damage(path)
    before = digest(folder)
    capsys.readouterr()
    assert main([*flags(), "--folder", str(folder), "--resume"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"train: all checkpoints in {folder / 'checkpoints'} are damaged (steps ")
    assert error.count("\n") == 1
    assert digest(folder) == before


def test_no_time_left_saves_and_a_copied_folder_goes_on_elsewhere(
    whole: tuple[Path, Outcome], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    told: list[str] = []

    def call(folder: Path, *arguments: object, num_steps: int = 6) -> tuple[int, str, str]:
        code = main([*flags(num_steps=num_steps), "--folder", str(folder), *map(str, arguments)])
        output, errors = capsys.readouterr()
        told.append(output)
        return code, output.splitlines()[-1].partition(";")[0] if output else "", errors

    assert call(here, "--max-minutes", "0")[:2] == (0, "stopped after step 0 of 6 because 0 minutes are over")
    assert call(here, "--resume", num_steps=3)[:2] == (0, "done: 3 steps")
    shutil.copytree(here, there)
    shutil.rmtree(here)
    code, _, errors = call(there)
    assert code == 2
    assert errors == f"train: {there} holds a run: resume it, or choose another folder\n"
    assert call(there, "--resume")[:2] == (0, "done: 6 steps")
    assert "the run was of 3 steps: its learning rate was" in told[-1]
    assert [row["step"] for row in read_metrics(there)] == [3, 3, 4, 6, 6]  # the run of three wrote its own last row
    assert_same_states(there, whole[0])


def test_checkpoints_know_their_config(whole: tuple[Path, Outcome], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(whole[0], folder)
    (folder / "config.json").unlink()
    with pytest.raises(InputError, match="holds a run: resume it"):
        train(tiny(), folder)
    with pytest.raises(InputError, match="holds a run with random_seed = 0, not 1"):
        train(tiny(random_seed=1), folder, resume=True)
    written = digest(folder)
    with pytest.raises(InputError, match=r"num_steps = 5, but the run in .* has made 6 steps: choose more"):
        train(tiny(num_steps=5), folder, resume=True)
    assert digest(folder) == written
    # What the last steps are spent on may change.
    train(tiny(**{"examples.random_keypoints": 0.5}), folder, resume=True)


def test_a_run_that_cannot_begin_leaves_its_folder_free(tmp_path: Path) -> None:
    config = tiny(**{"network.num_object_points": 8192})
    for _ in range(2):
        with pytest.raises(InputError, match=r"has 4096 surfels an object, but network.num_object_points = 8192"):
            train(config, tmp_path / "run", progress=False)
    assert not (tmp_path / "run" / "config.json").exists()


def test_a_step_that_is_not_finite_stops_the_run(
    whole: tuple[Path, Outcome], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    compile_step, folder, before = loop.jit_train_step, tmp_path / "run", dict[str, bytes]()

    def poisoned(*arguments: Any) -> Callable[..., Any]:
        step = compile_step(*arguments)

        def call(state: Any, pack: Any, batch: Any, number: jax.Array) -> Any:
            if int(jax.device_get(number)) == 3:  # the front halves of the objects are broken and out of sight
                before.update(digest(folder / "checkpoints"))
                points, bits = np.array(pack.points), np.array(pack.bits)
                points[:, : points.shape[1] // 2], bits[..., : bits.shape[3] // 2] = np.nan, 0
                pack = pack._replace(points=jax.device_put(points), bits=jax.device_put(bits))
            return step(state, pack, batch, number)

        return call

    monkeypatch.setattr(loop, "jit_train_step", poisoned)
    capsys.readouterr()
    assert main([*flags(), "--folder", str(folder)]) == 1
    errors = capsys.readouterr().err.splitlines()
    source = training_source(tiny(), data_mesh())
    batch = source.batches[3]
    wanted = [source.names[row] for row in batch.object]
    assert errors[-1].startswith("train: step 3, with the objects " + wanted[0])
    assert "gave loss nan and gradient norm nan: the state before it and the batch are in" in errors[-1]
    assert not any("Traceback" in line for line in errors)
    with pytest.raises(NotFiniteError, match="step 3, "):
        train_quietly(folder, resume=True)
    assert before
    assert digest(folder / "checkpoints") == before
    kept = newest(folder / "nan" / "checkpoints")
    assert int(kept.state.step) == 3
    assert json.loads(kept.batches)["next_batch"] == 3
    found = json.loads((folder / "nan" / "batch0.json").read_text())
    assert (found["step"], found["loss"]) == (3, "nan")
    assert [sample["object"] for sample in found["samples"]] == wanted
    assert [sample["drop"] for sample in found["samples"]] == batch.drop.tolist()
    assert [sample["key"] for sample in found["samples"]] == batch.key.tolist()
    # The state is that before the failed step: with whole data the run goes on from it as if nothing had been.
    monkeypatch.undo()
    again = tmp_path / "again"
    again.mkdir()
    shutil.copytree(folder / "nan" / "checkpoints", again / "checkpoints")
    shutil.copyfile(folder / "model.safetensors", again / "model.safetensors")
    assert train_quietly(again, resume=True).step == 6
    assert_same_states(again, whole[0])
