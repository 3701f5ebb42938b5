"""Training steps, data included, beside a dense PyTorch step of the published network: `python -m benchmarks.training`.

Ours makes its samples inside the step, from the scenes of the small pack; the PyTorch step is given ready clouds, in
its favour. Both go forward, backward and update all parameters.
"""

from __future__ import annotations

import gc
import importlib.util
import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.command import run
from benchmarks.network_cases import make_case
from benchmarks.timing import time_in_turn
from configs import find_config
from kmn_jax.data import SampleBatches
from kmn_jax.models import Compute
from kmn_jax.report import print_table, write_json
from kmn_jax.train import (
    TrainConfig,
    create_state,
    data_mesh,
    jit_make_samples,
    jit_train_step,
    put_batch,
    put_whole,
    split_cpu,
    training_source,
)

_PACK = "experiments/assets/small_pack"
_COMPARED = 4  # crops in the batch that is compared with PyTorch
_BATCHES = 8  # that are drawn and used in turn
_OBJECTS, _DROPS = 1507, 20  # of the training pack


def main(
    base_batches: tuple[int, ...] | None = None,
    small_batches: tuple[int, ...] | None = None,
    arithmetic: tuple[Compute, ...] | None = None,
    repeats: int = 6,
    torch: bool = True,
    json: Path | None = None,
) -> None:
    """Run all rows.

    Args:
        base_batches: crops of a step of `base`; by default what suits the device.
        small_batches: the same for `small`.
        arithmetic: of `base`; by default float32 on CPUs, else float32, tf32 and bfloat16.
        repeats: timed steps of each.
        torch: run the dense PyTorch step.
        json: where results go.
    """
    split_cpu(2)
    on_cpu = jax.default_backend() == "cpu"
    counts = sorted({1, len(jax.devices())})
    base, small = find_config("base"), find_config("small")
    computes = arithmetic or (("float32",) if on_cpu else ("float32", "tf32", "bfloat16"))
    results: dict[str, Any] = {"published": published_rows(repeats, counts[-1], torch)}
    print_table(f"the published network, a batch of {_COMPARED}", results["published"])
    batches = {
        "base": base_batches or ((4, 8, 16) if on_cpu else (14, 32, 64, 128, 256)),
        "small": small_batches or ((8, 16, 32) if on_cpu else (64, 256)),
    }
    for config in (base, small):
        rows = []
        for compute in computes if config is base else (config.network.compute,):
            changed = replace(config, network=replace(config.network, compute=compute))
            for batch in batches[config.name]:
                for devices in counts:
                    rows += throughput_rows(of_batch(changed, batch, on_cpu), devices, repeats)
        results[config.name] = rows
        print_table(f"{config.name}, steps with their data", rows)
    results["indices"] = index_rows(repeats)
    print_table("what a host gives to steps that make their samples: indices, drawn by one thread", results["indices"])
    write_json(json, results)


def index_rows(repeats: int) -> list[dict[str, Any]]:
    """Time the drawing of indices for batches of `base`, of the training pack's size, as one of several hosts."""
    config = find_config("base").pipeline
    rows = []
    for batch, hosts in ((128, 1), (1024, 1), (32_768, 64)):
        batches = SampleBatches(replace(config, batch_size=batch), _OBJECTS, _DROPS, 0, hosts)
        following = map(batches.__getitem__, count(1))
        steady = time_in_turn({"draw": partial(next, following)}, repeats)["draw"]
        share = batch // hosts
        rows.append(
            {
                "batch": batch,
                "hosts": hosts,
                "ms": steady.median_ms,
                "samples/s": 1e3 * share / steady.median_ms,
                "bytes of a sample": sum(column.nbytes for column in batches[0]) / share,
            }
        )
    return rows


def of_batch(config: TrainConfig, batch: int, on_cpu: bool) -> TrainConfig:
    """Return the config with another batch, computed as suits the device, on the small pack."""
    each = next(count for count in (4, 2, 1) if batch % (2 * count) == 0 or count == 1)
    return replace(
        config,
        pack=_PACK,
        examples=replace(config.examples, crops_per_scene=min(each, config.examples.crops_per_scene)),
        pipeline=replace(config.pipeline, batch_size=batch, crops_per_object=each),
        crops_at_once=1 if on_cpu else None,
        validation_samples=each,
    )


def steps(config: TrainConfig, devices: int) -> tuple[Callable[[], Any], Callable[[], Any], int]:
    """Return a training step, the making of its samples alone, and the step's temporary bytes."""
    mesh = data_mesh(jax.devices()[:devices])
    source = training_source(config, mesh)
    graphdef, state = create_state(config.step, config.optimizer.build(config.num_steps))
    batches = [put_batch(source.batches[number], mesh) for number in range(_BATCHES)]
    train = jit_train_step(graphdef, config.optimizer, config.num_steps, config.step, mesh)
    make = jit_make_samples(config.step, mesh)
    held = [put_whole(state, mesh)]
    done = {"steps": 0, "batches": 0}
    memory = train.lower(held[0], source.pack, batches[0], put_whole(np.int32(0), mesh)).compile().memory_analysis()  # type: ignore[attr-defined]

    def step() -> Any:
        number = done["steps"]
        done["steps"] += 1
        held[0], metrics = train(held[0], source.pack, batches[number % _BATCHES], put_whole(np.int32(number), mesh))
        assert metrics.taken, "the step was refused: its loss is not finite"
        return metrics

    def data() -> Any:
        done["batches"] += 1
        return make(source.pack, batches[done["batches"] % _BATCHES])

    return step, data, int(getattr(memory, "temp_size_in_bytes", 0))


def throughput_rows(config: TrainConfig, devices: int, repeats: int) -> list[dict[str, Any]]:
    """Time a step of a config, and the share of it that makes the samples."""
    step, data, temporary = steps(config, devices)
    times = time_in_turn({"step": step, "data": data}, repeats)
    gc.collect()
    return [
        {
            "config": config.name,
            "arithmetic": config.network.compute,
            "batch": config.pipeline.batch_size,
            "devices": devices,
            "step ms": times["step"].median_ms,
            "samples/s": 1e3 * config.pipeline.batch_size / times["step"].median_ms,
            "data ms": times["data"].median_ms,
            "data share": times["data"].median_ms / times["step"].median_ms,
            "temporary MB": temporary / 1e6,
        }
    ]


def published_rows(repeats: int, devices: int, torch: bool) -> list[dict[str, Any]]:
    """Time steps of the published network, with its dropout of every pair and with ours, and PyTorch's in turn."""
    on_cpu = jax.default_backend() == "cpu"
    paper = of_batch(find_config("paper"), _COMPARED, on_cpu)
    shared = replace(paper, network=replace(paper.network, pair_dropout="shared"))
    calls = {
        "ours, dropout of a point": steps(shared, devices)[0],
        "ours, dropout of every pair": steps(paper, devices)[0],
    }
    rival = torch_step(_COMPARED) if torch else None
    if rival is not None:
        calls["dense PyTorch"] = rival
    times = time_in_turn(calls, repeats, limit_s=300)
    baseline = times.get("dense PyTorch")
    return [
        {
            "step": name,
            "batch": _COMPARED,
            "data": "given" if name == "dense PyTorch" else "made in the step",
            "ms": steady.median_ms,
            "min ms": steady.minimum_ms,
            "samples/s": 1e3 * _COMPARED / steady.median_ms,
            "x PyTorch": baseline.median_ms / steady.median_ms if baseline else None,
        }
        for name, steady in times.items()
    ]


def torch_step(batch: int) -> Callable[[], None] | None:
    """Return the dense PyTorch step on ready clouds, with all cores; None without torch.

    Examples go one after the other, as the dense network needs 2 GB of activations for each.
    """
    if importlib.util.find_spec("torch") is None:
        return None
    import torch
    from torch.nn.functional import cross_entropy

    from benchmarks.reference.dense_torch import DenseKeyMatchNet

    device = "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"
    torch.set_num_threads(os.cpu_count() or 1)
    network = DenseKeyMatchNet().to(device).train()
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-4, weight_decay=1e-4)
    case, rng = make_case(batch), np.random.default_rng(0)

    def clouds(values: jax.Array) -> Any:
        return torch.from_numpy(np.array(values).swapaxes(1, 2).copy()).to(device)

    scenes, parts = clouds(case.crops), clouds(case.clouds)
    keypoints = torch.from_numpy(np.array(case.keypoint_indices)).to(device)
    on_object = torch.from_numpy(rng.integers(0, 2, (batch, 2048))).to(device)
    nearest = torch.from_numpy(rng.integers(0, 20, (batch, 2048))).to(device)

    def step() -> None:
        optimizer.zero_grad()
        for row in range(batch):
            segmentation, logits = network(scenes[row : row + 1], parts[row : row + 1], keypoints)
            inside = on_object[row] > 0
            loss = 0.2 * cross_entropy(segmentation, on_object[row])
            (loss + 0.8 * cross_entropy(logits[inside], nearest[row][inside])).div(batch).backward()
        optimizer.step()
        if device == "cuda":
            torch.cuda.synchronize()

    return step


if __name__ == "__main__":
    run(main)
