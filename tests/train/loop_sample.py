"""Runs of seconds: a tiny network on the small pack, all that makes steps random; here or in processes of their own."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from configs import find_config
from kmn_jax.train import TrainConfig, create_state, read_metrics
from kmn_jax.train._checkpoint import Checkpoints
from kmn_jax.train._snapshot import Snapshot
from tests.reference.compiled import with_devices

ROOT = Path(__file__).parent.parent.parent

# Compiling takes most of the time, whatever the sizes: with few optimisations half as long, and what does not change
# between runs of the tests is kept.
COMPILED = {
    "jax_disable_most_optimizations": True,
    "jax_compilation_cache_dir": str(ROOT / ".cache" / "jax"),
    "jax_persistent_cache_min_compile_time_secs": 0.5,
}
# The same for processes.
ENVIRONMENT = {name.upper(): str(value) for name, value in COMPILED.items()} | {"JAX_PLATFORMS": "cpu"}
ONE_DEVICE = with_devices(1)

# What differs from the config "debug". None of `num_steps` to `checkpoint_every` is part of the compiled step. Of
# symmetric objects rounding decides which points are the farthest, so keypoints are drawn.
VALUES: dict[str, Any] = {
    "num_steps": 6,
    "validate_every": 3,
    "validation_samples": 4,
    "checkpoint_every": 2,
    "log_every": 4,
    "pack": str(ROOT / find_config("debug").pack),
    "network.num_scene_points": 64,
    "network.num_object_points": 64,
    "network.num_keypoints": 4,
    "network.num_neighbors": 4,
    "network.dropout": 0.2,
    "examples.crops.num_points": 64,
    "examples.crops.normals": "surface",
    "examples.random_keypoints": 1.0,
    "optimizer.schedule": "step",
    "optimizer.warmup_steps": 0,
    "optimizer.learning_rate": 1e-2,
    "optimizer.least_rate": 1e-3,
    "optimizer.decay_steps": 2,
    "pipeline.batch_size": 4,
    "average_decay": 0.5,
}
_CLOCKS = ("seconds", "samples_per_second")
_T = TypeVar("_T")


@functools.cache
def tiny(**changes: Any) -> TrainConfig:
    """Return the config "debug" with VALUES and other changes of fields of its own."""
    return _changed(find_config("debug"), VALUES | changes)


def flags(**changes: Any) -> list[str]:
    """Return the arguments of experiments.train that make the same config."""
    values = VALUES | changes
    return ["debug", *(part for name, value in values.items() for part in (f"--{name.replace('_', '-')}", str(value)))]


def run_train(*arguments: object, xla_flags: str = ONE_DEVICE) -> subprocess.Popen[str]:
    """Start `python -m experiments.train` with its own output."""
    return subprocess.Popen(
        [sys.executable, "-m", "experiments.train", *map(str, arguments)],
        cwd=ROOT,
        env=os.environ | ENVIRONMENT | {"XLA_FLAGS": xla_flags},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def newest(folder: Path) -> Snapshot:
    """Return the newest of a folder's checkpoints, which must be whole."""

    def fail(report: str) -> None:
        raise AssertionError(report)

    config = tiny()
    state = create_state(config.step, config.optimizer.build(config.num_steps))[1]
    found = Checkpoints(folder, report=fail).latest(state)
    assert found is not None
    return found


def assert_same_runs(one: Path, other: Path) -> None:
    """Compare all that two runs have come to and have written, to the bit, but for clocks."""
    assert_same_states(one, other)
    assert list(map(_timeless, read_metrics(one))) == list(map(_timeless, read_metrics(other)))


def assert_same_states(one: Path, other: Path) -> None:
    """Compare all that two runs have come to, to the bit, but for clocks."""
    found, wanted = newest(one / "checkpoints"), newest(other / "checkpoints")
    for array, like in zip(jax.tree.leaves(found.state), jax.tree.leaves(wanted.state), strict=True):
        assert np.asarray(array).tobytes() == np.asarray(like).tobytes()
    assert found.batches == wanted.batches
    assert _timeless(found.facts) == _timeless(wanted.facts)
    for name in ("last.safetensors", "model.safetensors"):
        assert (one / name).read_bytes() == (other / name).read_bytes()


def _timeless(row: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name not in _CLOCKS}


def _changed(config: _T, values: dict[str, Any]) -> _T:
    assert is_dataclass(config)
    nested: dict[str, dict[str, Any]] = {}
    own = {name: value for name, value in values.items() if "." not in name}
    for name, value in values.items():
        first, dot, rest = name.partition(".")
        if dot:
            nested.setdefault(first, {})[rest] = value
    own |= {name: _changed(getattr(config, name), rest) for name, rest in nested.items()}
    assert own.keys() <= {field.name for field in fields(config)}
    return replace(config, **own)  # type: ignore[type-var]
