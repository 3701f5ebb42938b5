"""The network against its dense forms in JAX and PyTorch: time, agreement, memory.

python -m benchmarks.network [--batches 1 4 16 64] [--repeats 15] [--json FILE]
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from benchmarks.command import run
from benchmarks.memory import peak_of_each
from benchmarks.network_cases import (
    Case,
    cached_forward,
    dense_jax_forward,
    encode_objects,
    head_features,
    make_case,
    match,
    torch_forward,
)
from benchmarks.reference import dense_jax
from benchmarks.timing import Compiled, compile_for, time_in_turn
from kmn_jax.models import Compute
from kmn_jax.report import print_table, write_json


def main(
    batches: tuple[int, ...] = (1, 4, 16, 64),
    repeats: int = 15,
    dense_up_to: int = 4,
    memory: bool = True,
    json: Path | None = None,
) -> None:
    """Run all rows.

    Args:
        batches: crops at once.
        repeats: timed rounds; every round runs every rival.
        dense_up_to: largest batch at which the dense forms take part (they need 0.5 GB a crop).
        memory: peak memory of one forward, each rival in a process of its own (Linux CPU only).
        json: where results go.
    """
    rows = [row for batch in batches for row in forward_rows(batch, repeats, batch <= dense_up_to)]
    print_table("network forward, N = M = 2048, K = 20, k = 20", rows)
    results: dict[str, Any] = {"forward": rows, "pair_head": pair_head_rows(repeats)}
    print_table("pair head, batch 1", results["pair_head"])
    if memory and jax.default_backend() == "cpu":
        results["memory"] = memory_rows()
        print_table("peak memory of one forward beyond weights and inputs, batch 1", results["memory"])
    write_json(json, results)


def forward_rows(batch: int, repeats: int, dense: bool) -> list[dict[str, Any]]:
    """Time all rivals at one batch size, in turn, and compare their logits with a dense float32 forward."""
    case = make_case(batch)
    on_cpu = jax.default_backend() == "cpu"
    arithmetic: tuple[Compute, ...] = ("float32", "bfloat16") if on_cpu else ("float32", "tf32", "bfloat16")
    compiled: dict[str, tuple[Compiled, tuple[Any, ...]]] = {}
    for compute in arithmetic:
        model = case.with_compute(compute)
        parts = jax.jit(partial(encode_objects, model.graphdef))(model.parameters, case)
        compiled[f"ours, cached object, {compute}"] = (
            compile_for(partial(cached_forward, model.graphdef), model.parameters, case.crops, parts),
            (model.parameters, case.crops, parts),
        )
    compiled["ours, object encoded too"] = (
        compile_for(partial(_whole, case.model.graphdef), case.parameters, case),
        (case.parameters, case),
    )
    if dense:
        compiled["dense JAX"] = (compile_for(dense_jax_forward, case), (case,))
    calls: dict[str, Callable[[], Any]] = {
        name: partial(ready.function, *arguments) for name, (ready, arguments) in compiled.items()
    }
    torch_call = torch_forward(case) if dense else None
    if torch_call is not None:
        calls["dense PyTorch"] = torch_call
    reference = [np.asarray(x) for x in jax.jit(dense_jax_forward)(case.first())]
    times = time_in_turn(calls, repeats)
    baseline = times.get("dense PyTorch")
    rows = []
    for name, steady in times.items():
        outputs = [np.asarray(x)[0] for x in calls[name]()]
        ready = compiled[name][0] if name in compiled else None
        rows.append(
            {
                "batch": batch,
                "form": name,
                "ms": steady.median_ms,
                "min ms": steady.minimum_ms,
                "crops/s": 1e3 * batch / steady.median_ms,
                "x PyTorch": baseline.median_ms / steady.median_ms if baseline else None,
                "compile s": ready.trace_s + ready.lower_s + ready.compile_s if ready else None,
                "temporary MB": ready.temporary_bytes / 1e6 if ready else None,
                "logits within 1e-4": _share_within(outputs, reference),
                "RMS error": _rms(outputs, reference),
            }
        )
    return rows


def pair_head_rows(repeats: int) -> list[dict[str, Any]]:
    """Time the separated pair head beside its dense JAX form, on the same features."""
    case = make_case(1)
    parameters = nnx.to_pure_dict(case.parameters)
    scene, part = head_features()
    ours = compile_for(partial(match, case.model.graphdef), case.parameters, scene, part)
    dense = compile_for(dense_jax.match, scene, part, parameters)
    calls = {
        "ours": lambda: ours.function(case.parameters, scene, part),
        "dense JAX": lambda: dense.function(scene, part, parameters),
    }
    times = time_in_turn(calls, repeats)
    difference = [float(jnp.abs(a - b).max()) for a, b in zip(calls["ours"](), calls["dense JAX"](), strict=True)]
    return [
        {
            "form": name,
            "ms": steady.median_ms,
            "x dense": times["dense JAX"].median_ms / steady.median_ms,
            "temporary MB": ready.temporary_bytes / 1e6,
            "largest difference": max(difference),
        }
        for (name, steady), ready in zip(times.items(), (ours, dense), strict=True)
    ]


def memory_rows() -> list[dict[str, Any]]:
    """Measure the peak of resident memory over one forward, each rival in its own process."""
    peaks = peak_of_each(("ours, cached object", "dense JAX", "dense PyTorch"))
    reference = peaks.get("dense PyTorch")
    return [
        {"form": name, "MB": peak / 1e6, "share of PyTorch": peak / reference if reference else None}
        for name, peak in peaks.items()
    ]


def _whole(graphdef: nnx.GraphDef, parameters: nnx.State, case: Case) -> Any:
    return cached_forward(graphdef, parameters, case.crops, encode_objects(graphdef, parameters, case))


def _share_within(outputs: list[np.ndarray], reference: list[np.ndarray]) -> float:
    close = [np.abs(a - b) < 1e-4 * np.ptp(b) for a, b in zip(outputs, reference, strict=True)]
    return float(np.concatenate([x.ravel() for x in close]).mean())


def _rms(outputs: list[np.ndarray], reference: list[np.ndarray]) -> float:
    """Return the larger root mean square error of the two outputs, over the output's range."""
    pairs = zip(outputs, reference, strict=True)
    return max(float(np.sqrt(np.mean((a - b) ** 2)) / np.ptp(b)) for a, b in pairs)


if __name__ == "__main__":
    run(main)
