"""A few steps on one or several devices; as a process, on all devices that there are, printed as JSON."""

from __future__ import annotations

import json
from typing import Any

import jax
import numpy as np

from kmn_jax.train import (
    TrainConfig,
    create_state,
    data_mesh,
    jit_train_step,
    put_batch,
    put_whole,
    training_source,
)
from kmn_jax.train._step import TrainState
from tests.train.loop_sample import tiny

SHARED = {"pipeline.batch_size": 16}  # a group for each of eight devices
STEPS = 6


def losses(config: TrainConfig, devices: list[jax.Device]) -> dict[str, Any]:
    """Return the metrics of each step and the squared norm of the parameters after it."""
    mesh = data_mesh(devices)
    source = training_source(config, mesh)
    graphdef, state = create_state(config.step, config.optimizer.build(config.num_steps))
    state = put_whole(state, mesh)
    step = jit_train_step(graphdef, config.optimizer, config.num_steps, config.step, mesh)
    found, norms, rows = [], [], 0
    for number in range(STEPS):
        batch = put_batch(source.batches[number], mesh)
        rows = batch.object.addressable_shards[0].data.shape[0]
        state, metrics = step(state, source.pack, batch, put_whole(np.int32(number), mesh))
        found.append([float(value) for value in jax.device_get(metrics)])
        norms.append(squared_norm(state))
    return {"devices": mesh.size, "rows": rows, "metrics": found, "norms": norms}


def squared_norm(state: TrainState) -> float:
    """Return the sum of the squares of all parameters."""
    return sum(float(np.sum(np.square(leaf))) for leaf in jax.tree.leaves(jax.device_get(state.parameters)))


if __name__ == "__main__":
    print(json.dumps(losses(tiny(**SHARED), jax.devices())))
