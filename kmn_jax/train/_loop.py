"""A training run: a folder, from which it can go on to the bit, and the steps between two stops.

The only module of training that acts: it draws batches, dispatches steps, writes files and listens to signals.

A run's folder holds `config.json`; `sessions.jsonl`, with commit, versions and devices; `metrics.jsonl`, the same as
`metrics.csv`; `checkpoints/`; `model.safetensors`, the running mean of the parameters at the lowest validation loss,
and `last.safetensors`, at the last stop. A copy of the folder can be resumed as well.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array

from kmn_jax.data import BatchIterator, SampleIndex
from kmn_jax.errors import InputError, require
from kmn_jax.files import write_whole
from kmn_jax.models import model_structure, save_model
from kmn_jax.report import check_target
from kmn_jax.train._checkpoint import Checkpoints
from kmn_jax.train._config import TrainConfig
from kmn_jax.train._lock import only_one
from kmn_jax.train._records import add_metrics, begin_metrics, check_same, write_config, write_session
from kmn_jax.train._sharding import (
    any_process,
    check_batch,
    data_mesh,
    from_first_process,
    jit_eval_step,
    jit_train_step,
    put_batch,
    put_whole,
)
from kmn_jax.train._snapshot import Snapshot
from kmn_jax.train._sources import ignore, trained_network, training_source, validation_source, warm_parameters
from kmn_jax.train._step import Metrics, Samples, create_state, index_of, mean_metrics, total_sums
from kmn_jax.train._stop import StopRequest
from kmn_jax.train._window import MEANS, Window

# What a resumed run may change: how long it is, where its pack lies, what it writes when, and the share of examples
# with random keypoints, as the last steps may be spent on those that the estimator uses.
_FREE = ("name", "pack", "num_steps", "validate_every", "checkpoint_every", "log_every", "examples.random_keypoints")
_READERS = 4  # threads that read images ahead
_AHEAD = 2  # steps that are dispatched before the metrics of one are read


class NotFiniteError(RuntimeError):
    """A loss or gradient was not finite. The message is one sentence for people."""


@dataclass(frozen=True)
class Outcome:
    """Where a run stands: `reason` says why it stopped before its last step, empty if it did not."""

    step: int
    reason: str
    best_loss: float | None  # the lowest validation loss
    best_step: int


class _Pending(NamedTuple):
    number: int
    samples: SampleIndex
    batches: bytes  # the state from which the batch was drawn
    metrics: Metrics
    stop: Array | bool


def train(
    config: TrainConfig,
    folder: str | Path,
    *,
    max_minutes: float | None = None,
    resume: bool = False,
    progress: bool = True,
    report: Callable[[str], None] | None = None,
) -> Outcome:
    """Train, from the beginning or with `resume` from the last checkpoint, until done or told to stop.

    SIGTERM, SIGINT and `max_minutes` stop it between two steps, with everything saved. Messages go to `report`, by
    default to stdout, above the progress bar.

    Raises:
        InputError: a folder with a run and no `resume`, or in which another process trains, a config that differs
            from the run's or is of fewer steps than it has made, double precision, data that cannot be used, batches
            that devices cannot share, or a full disk.
        NotFiniteError: a loss or gradient was not finite; state and batch are in the run's folder `nan`.
    """
    folder = Path(folder)
    stop = StopRequest(max_minutes)
    # By one process, or the others might find what it has just written.
    from_first_process(lambda: _check_free(folder, resume))
    require(not jax.config.values["jax_enable_x64"], "training is in single precision: turn JAX_ENABLE_X64 off")
    with stop, ExitStack() as held:
        run = _Run(config, folder, data_mesh(), stop, report or _print)
        from_first_process(lambda: held.enter_context(only_one(folder)))
        run.restore()
        return run.loop(progress)


def _check_free(folder: Path, resume: bool) -> None:
    # Without a checkpoint there is nothing to lose.
    if not resume and any((folder / "checkpoints").glob("*")):
        raise InputError(f"{folder} holds a run: resume it, or choose another folder")


class _Run:
    def __init__(
        self, config: TrainConfig, folder: Path, mesh: Mesh, stop: StopRequest, report: Callable[[str], None]
    ) -> None:
        self.config, self.folder, self.mesh, self.stop = config, folder, mesh, stop
        self.first = jax.process_index() == 0
        self.report = report if self.first else ignore
        size = config.pipeline.batch_size
        check_batch(size, config.step, mesh)
        self.training, self.validation = (
            source(config, mesh, lambda problem: self.report(f"left out: {problem}"))
            for source in (training_source, validation_source)
        )
        self.saved_graphdef = model_structure(trained_network(config)).graphdef
        optimizer, num_steps = config.optimizer, config.num_steps
        self.graphdef, state = create_state(config.step, optimizer.build(num_steps), warm_parameters(config))
        self.state = put_whole(state, mesh)
        self.train_step = jit_train_step(self.graphdef, optimizer, num_steps, config.step, mesh)
        self.eval_step = jit_eval_step(self.graphdef, config.step, mesh)
        self.rates = optimizer.rates(num_steps)
        read = self.training.read
        self.batches: BatchIterator[Samples] = BatchIterator(
            self.training.batches, read, self.training.digest, threads=_READERS if read else 0, ahead=_READERS
        )
        self.checkpoints = Checkpoints(folder / "checkpoints", report=self.report)
        self.pending: deque[_Pending] = deque()
        self.stopped = ""
        self.step = self.validated = self.best_step = 0
        self.saved = -1
        self.best_loss: float | None = None
        self.seconds_before, self.began = 0.0, time.monotonic()
        self.window = Window()

    def restore(self) -> None:
        """Go on from the last checkpoint, if there is one."""
        found = self.checkpoints.latest(self.state)
        if found is None:
            from_first_process(self._check_none)
        else:
            before = found.facts.get("config", {})
            check_same(self.folder, before, asdict(self.config), _FREE)
            self._take(found)
            length = self.config.num_steps
            require(
                self.step <= length,
                f"num_steps = {length}, but the run in {self.folder} has made {self.step} steps: choose more",
            )
            self.report(f"going on at step {self.step} of {length}")
            self._report_rate(before.get("num_steps", length))
        if self.first:
            check_target(self.folder / "config.json")
            write_config(self.folder, asdict(self.config))
            facts = {"training_objects": len(self.training.names), "validation_objects": len(self.validation.names)}
            write_session(self.folder, self.step, facts)
            begin_metrics(self.folder, self.step, self.validated)

    def _check_none(self) -> None:
        """See that a run without a usable checkpoint has none: it would begin anew and replace what can be mended."""
        if self.checkpoints.steps:
            steps = ", ".join(map(str, self.checkpoints.steps))
            raise InputError(
                f"all checkpoints in {self.checkpoints.folder} are damaged (steps {steps}): put back a copy of one, or"
                " choose another folder to begin anew"
            )

    def _report_rate(self, before: int) -> None:
        """Say what another length than before makes of the learning rate, which follows from it."""
        step, length = self.step, self.config.num_steps
        if step < length != before:
            rate = self.config.optimizer.rates(before)[min(step, before - 1)]
            self.report(
                f"the run was of {before} steps: its learning rate was {rate:.2g} here, {self.rates[step]:.2g} now"
            )

    def loop(self, progress: bool) -> Outcome:
        """Train until done or stopped."""
        from tqdm import tqdm

        config, size = self.config, self.config.pipeline.batch_size
        quiet = not (progress and self.first)
        total, done = config.num_steps * size, self.step * size
        interval = 1.0 if sys.stderr.isatty() else 30.0
        self.window = Window(self.window.saved())
        with tqdm(total=total, initial=done, unit=" samples", disable=quiet, mininterval=interval) as self.bar:
            while not self._at_boundary():
                self._advance()
        if self.first:
            save_model((self.saved_graphdef, self.state.average), self.folder / "last.safetensors")
        return Outcome(self.step, self.stopped, self.best_loss, self.best_step)

    def _at_boundary(self) -> bool:
        """Validate and save if it is time to, and tell whether the run ends here."""
        config, step = self.config, self.step
        last = step >= config.num_steps
        self.stopped = "" if last else self.stopped or self._reason()
        validate = step > self.validated and (last or step % config.validate_every == 0) and not self.stopped
        save = bool(self.stopped) or last or step % config.checkpoint_every == 0
        if not (validate or save):
            return False
        self._settle(0)
        began = time.monotonic()
        best = validate and self._validate()
        self.stopped = "" if last else self.stopped or self._reason()
        if best or ((save or self.stopped) and step != self.saved):
            self._save(best)
        self.window.pause(time.monotonic() - began)
        return last or bool(self.stopped)

    def _reason(self) -> str:
        # Several processes stop by their common vote, at the same step.
        return self.stop.reason if jax.process_count() == 1 else ""

    def _advance(self) -> None:
        state, samples = self.batches.get_state(), next(self.batches)
        with jax.transfer_guard("disallow"):
            number = put_whole(np.int32(self.step), self.mesh)
            batch = put_batch(samples, self.mesh)
            self.state, metrics = self.train_step(self.state, self.training.pack, batch, number)
            vote = any_process(bool(self.stop.reason), self.mesh)
        for array in jax.tree.leaves(metrics):
            array.copy_to_host_async()
        self.pending.append(_Pending(self.step, index_of(samples), state, metrics, vote))
        self.step += 1
        self._settle(_AHEAD)

    def _settle(self, ahead: int) -> None:
        """Read the metrics of all steps but the last ones."""
        config, size = self.config, self.config.pipeline.batch_size
        while len(self.pending) > ahead:
            done = self.pending.popleft()
            metrics: Metrics = jax.device_get(done.metrics)
            if not metrics.taken:
                self._fail(done, metrics)
            if jax.process_count() > 1 and bool(jax.device_get(done.stop)):
                self.stopped = self.stop.reason or "another process was told to stop"
            self.window.add(metrics, size)
            self.bar.update(size)
            step = done.number + 1
            if step % config.log_every and step != config.num_steps:
                continue
            means = self.window.means()
            self._write(step, "train", {**means, "learning_rate": float(self.rates[done.number])})
            self.bar.set_postfix_str(
                f"loss {means['loss']:.3f}, segmentation {means['segmentation_accuracy']:.3f}, keypoints"
                f" {means['keypoint_accuracy']:.3f}, rate {self.rates[done.number]:.1e}",
                refresh=False,
            )
            self.window = Window()

    def _validate(self) -> bool:
        """Validate the running mean of the parameters; tell whether it is the best. A stop breaks it off."""
        batches, found = self.validation.batches, []
        for number in range(len(batches)):
            if self._reason():
                return False
            with jax.transfer_guard("disallow"):
                batch = put_batch(batches[number], self.mesh)
                found.append(self.eval_step(self.state.average, self.validation.pack, batch))
            jax.block_until_ready(found[max(0, number - _AHEAD)])
        metrics = mean_metrics(total_sums(jax.device_get(found)))
        means = {name: float(getattr(metrics, name)) for name in MEANS}
        self._write(self.step, "validation", means)
        self.validated = self.step
        best = np.isfinite(means["loss"]) and (self.best_loss is None or means["loss"] < self.best_loss)
        self.report(
            f"step {self.step}: validation loss {means['loss']:.4f}, segmentation {means['segmentation_accuracy']:.4f},"
            f" keypoints {means['keypoint_accuracy']:.4f}{', the best so far' if best else ''}"
        )
        if best:
            self.best_loss, self.best_step = means["loss"], self.step
        return bool(best)

    def _write(self, step: int, split: str, values: dict[str, float]) -> None:
        if self.first:
            seen = step * self.config.pipeline.batch_size
            facts: dict[str, float | str] = {"step": step, "samples": seen, "split": split}
            add_metrics(self.folder, {**facts, **values, "seconds": self._seconds()})

    def _seconds(self) -> float:
        return self.seconds_before + time.monotonic() - self.began

    def _save(self, best: bool) -> None:
        # The model first: a run that is killed in between validates again, and writes both.
        if best and self.first:
            save_model((self.saved_graphdef, self.state.average), self.folder / "model.safetensors")
        self.checkpoints.save(self._snapshot(), best=best)
        self.saved = self.step

    def _snapshot(self) -> Snapshot:
        facts = {
            "config": asdict(self.config),
            "step": self.step,
            "samples": self.step * self.config.pipeline.batch_size,
            "seconds": self._seconds(),
            "validated": self.validated,
            "best_loss": self.best_loss,
            "best_step": self.best_step,
            "window": self.window.saved(),
        }
        return Snapshot(self.state, self.batches.get_state(), facts)

    def _take(self, found: Snapshot) -> None:
        facts: dict[str, Any] = found.facts
        self.batches.set_state(found.batches)
        self.state = found.state
        self.step = self.saved = int(facts["step"])
        self.validated, self.best_step = int(facts["validated"]), int(facts["best_step"])
        self.best_loss = facts["best_loss"]
        self.seconds_before, self.began = float(facts["seconds"]), time.monotonic()
        self.window = Window(facts["window"])

    def _fail(self, done: _Pending, metrics: Metrics) -> None:
        """Save the state before the step and its batch apart, and raise NotFiniteError."""
        apart = self.folder / "nan"
        names = [self.training.names[row] for row in done.samples.object]
        if self.first:
            shutil.rmtree(apart, ignore_errors=True)
        self.step = done.number
        Checkpoints(apart / "checkpoints").save(Snapshot(self.state, done.batches, self._snapshot().facts))
        samples = [
            {"object": name, "drop": int(drop), "key": key.tolist()}
            for name, drop, key in zip(names, done.samples.drop, done.samples.key, strict=True)
        ]
        facts = {"step": done.number, "loss": str(metrics.loss), "gradient_norm": str(metrics.gradient_norm)}
        path = apart / f"batch{jax.process_index()}.json"
        check_target(path)
        write_whole(path, json.dumps({**facts, "samples": samples}, indent=1).encode())
        some = ", ".join(dict.fromkeys(names[: 4 * self.config.pipeline.crops_per_object]))
        raise NotFiniteError(
            f"step {done.number}, with the objects {some}, gave loss {metrics.loss} and gradient norm"
            f" {metrics.gradient_norm}: the state before it and the batch are in {apart}, the last checkpoint is as it"
            " was; look for the cause there, or begin another run with other values"
        )


def _print(message: str) -> None:
    from tqdm import tqdm

    tqdm.write(message)
