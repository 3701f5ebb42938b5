"""What XLA makes of the programs that matter on devices that are not there: kernels, bytes, loops, times on paper.

python -m benchmarks.compiled --target h200 [--only "network, 64"] [--texts FOLDER] [--measure] [--json FILE]

Needs the environment of `make compile-env`: run it by .venv-compile/bin/python. Nothing is run, so every time is
computed: a floor from the vendor's ceilings, and what is expected from the guesses in `compiled_targets.py`, both with
kernels one after the other. Loops whose length only the data knows are taken to make `trips` trips. Of TPUs, whose
programs the host starts once, a launch is a kernel within the program, and no machine code is made.

With `--measure` the programs are compiled for the device that is there, counted the same, and also timed, on drawn
numbers: what was expected beside what is.
"""

from __future__ import annotations

import gzip
import json as json_module
import re
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.command import run
from benchmarks.compiled_counts import Counts, Kernel, count
from benchmarks.compiled_hlo import parse_module
from benchmarks.compiled_programs import Program, programs
from benchmarks.compiled_targets import TARGETS, Target, devices_of, prepare, seconds, seconds_of
from benchmarks.compiled_tpu import optimized
from benchmarks.timing import paused, time_in_turn
from kmn_jax.errors import InputError
from kmn_jax.files import check_inputs
from kmn_jax.geometry import ask_for_fast_selection
from kmn_jax.platforms import for_any_platform
from kmn_jax.report import check_target, print_table, write_json

_NAMED = 5  # of the longest terms of a program
_REPEATS = 9


def main(
    target: str = "h200",
    only: tuple[str, ...] = (),
    trips: int = 8,
    texts: Path | None = None,
    measure: bool = False,
    pause: Path | None = None,
    json: Path | None = None,
) -> None:
    """Compile programs and count them.

    Args:
        target: devices to compile for: h100, h200, h200x8, v5e-1, v5e-16, v5e-256 or v6e-8.
        only: parts of the names of programs; without any, all.
        trips: of loops whose length only the data knows.
        texts: folder for compiled programs' texts, from which those that are there already are counted again.
        measure: run them on the device that is there, of which `target` only gives the ceilings.
        pause: a file with the ids of processes that are stopped while a program is timed, as they use the device, too.
        json: where results go; written after each program.
    """
    if target not in TARGETS:
        raise InputError(f"there is no target {target!r}: choose {', '.join(TARGETS)}")
    check_inputs(pause)
    check_target(texts and texts / target / "text")
    where = TARGETS[target]
    if measure:
        ask_for_fast_selection()
    else:
        prepare(where)
    found, devices = programs(where.devices), jax.devices()[: where.devices] if measure else devices_of(where)
    if len(devices) < where.devices:
        raise InputError(f"{target} are {where.devices} devices, but there are only {len(devices)} here")
    chosen = [program for program in found if not only or any(part in program.name for part in only)]
    if not chosen:
        raise InputError(f"no program's name holds {only}: there are {', '.join(program.name for program in found)}")
    rows: list[dict[str, Any]] = []
    details: dict[str, Any] = {}
    for program in chosen:
        if measure:
            text, facts = _compiled(program, devices, True, pause)
        else:
            on_tpu = where.platform == "tpu"
            make = partial(optimized, target, program.name) if on_tpu else partial(_compiled, program, devices)
            text, facts = _kept(program, make, texts and texts / target)
        counts = count(parse_module(text), trips)
        rows.append(_row(program, counts, facts, where))
        details[program.name] = _details(counts, where) | facts
        print_table(program.name, [rows[-1]])
        print_table("its longest terms", details[program.name]["longest"])
        write_json(json, {"target": target, "assumed trips": trips, "programs": rows, "details": details})
    print_table(f"programs compiled for {target}", rows)


def _kept(
    program: Program, make: Callable[[], tuple[str, dict[str, Any]]], folder: Path | None
) -> tuple[str, dict[str, Any]]:
    """Return the text of a compiled program and what is known of it; from a folder if they are there."""
    if folder is None:
        return make()
    name = re.sub(r"\W+", "-", program.name)
    kept = folder / f"{name}.hlo.gz"
    if kept.exists():
        with gzip.open(kept, "rt") as file:
            first, text = file.read().split("\n", 1)
        return text, json_module.loads(first)
    text, facts = make()
    kept.parent.mkdir(parents=True, exist_ok=True)
    with gzip.open(kept, "wt") as file:
        file.write(json_module.dumps(facts) + "\n" + text)
    return text, facts


def _compiled(
    program: Program, devices: list[Any], measure: bool = False, pause: Path | None = None
) -> tuple[str, dict[str, Any]]:
    """Return the text of a compiled program, its memory and perhaps its time."""
    start = time.perf_counter()
    function, arguments = program.make(devices)
    with for_any_platform():
        lowered = function.lower(*arguments)
    after_lower = time.perf_counter()
    compiled = lowered.compile()
    memory = compiled.memory_analysis()
    facts = {
        "lower s": after_lower - start,
        "compile s": time.perf_counter() - after_lower,
        "temporary MB": memory.temp_size_in_bytes / 1e6,
        "argument MB": memory.argument_size_in_bytes / 1e6,
    }
    if measure:
        with paused(pause):
            facts |= _measured(compiled, arguments, program.goes_on)
    return compiled.as_text(), facts


def _measured(compiled: Callable[..., Any], arguments: tuple[Any, ...], goes_on: bool) -> dict[str, float]:
    """Return the time of a program on drawn numbers."""
    drawn = list(drawn_like(arguments))

    def call() -> Any:
        result = compiled(*drawn)
        if goes_on:
            drawn[0] = result[0]
        return result

    times = time_in_turn({"": call}, _REPEATS)[""]
    return {"measured ms": times.median_ms, "measured min ms": times.minimum_ms}


def drawn_like(shapes: Any) -> Any:
    """Return arrays of such shapes and places: normal numbers, small whole ones, and masks that are all true."""

    def draw(number: int, leaf: Any) -> jax.Array:
        rng = np.random.default_rng(number)
        if leaf.dtype == np.bool_:
            values = np.ones(leaf.shape, np.bool_)
        elif np.issubdtype(leaf.dtype, np.integer):
            values = np.ones(leaf.shape, leaf.dtype)
        else:
            values = np.abs(rng.standard_normal(leaf.shape, dtype=np.float32)) + np.float32(0.1)
        return jax.device_put(values, leaf.sharding)

    leaves, structure = jax.tree.flatten(shapes)
    return jax.tree.unflatten(structure, [draw(number, leaf) for number, leaf in enumerate(leaves)])


def _row(program: Program, counts: Counts, facts: dict[str, Any], target: Target) -> dict[str, Any]:
    floor, expected = (seconds(counts, rates, target.devices) for rates in (target.floor, target.expected))
    kinds = counts.kinds
    sorts = [kernel for kernel in counts.kernels if kernel.sort_stages]
    longest = max(counts.loops, key=lambda loop: loop.trips, default=None)
    return {
        "program": program.name,
        "launches": counts.launches,
        "fusions": sum(number for kind, number in kinds.items() if kind.startswith("fusion")),
        "library": sum(number for kind, number in kinds.items() if kind.startswith("library")),
        "sorts": sum(kernel.times for kernel in sorts),
        "loops": sum(loop.times for loop in counts.loops),
        "longest loop": longest.trips if longest else 0,
        "waits": sum(counts.waits.values()),
        "to host": sum(counts.host_transfers.values()),
        "GB moved": counts.moved / 1e9,
        "GFLOP": sum(counts.operations.values()) / 1e9,
        "collectives MB": counts.collective_bytes / 1e6,
        "temporary MB": facts["temporary MB"],
        "argument MB": facts["argument MB"],
        "floor ms": 1e3 * floor,
        "expected ms": 1e3 * expected,
        f"expected {program.item}s/s": program.items / expected,
    } | ({} if "measured ms" not in facts else _beside(facts["measured ms"], 1e3 * expected, program))


def _beside(measured_ms: float, expected_ms: float, program: Program) -> dict[str, float]:
    return {
        "measured ms": measured_ms,
        f"measured {program.item}s/s": 1e3 * program.items / measured_ms,
        "x expected": measured_ms / expected_ms,
    }


def _details(counts: Counts, target: Target) -> dict[str, Any]:
    return {
        "kinds": dict(counts.kinds),
        "operations": counts.operations,
        "loops": [vars(loop) for loop in counts.loops],
        "waits": dict(counts.waits),
        "host transfers": dict(counts.host_transfers),
        "longest": _longest(counts, target),
    }


def _longest(counts: Counts, target: Target) -> list[dict[str, Any]]:
    """Return the operations of the source that take longest, kernels of one kind and origin together."""
    groups: dict[tuple[str, str], list[Kernel]] = {}
    for kernel in counts.kernels:
        groups.setdefault((kernel.origin, kernel.kind), []).append(kernel)

    def taken(kernels: list[Kernel], of: Callable[[Kernel], float]) -> float:
        return sum(kernel.times * of(kernel) for kernel in kernels)

    rows: list[dict[str, Any]] = [
        {
            "origin": origin,
            "kind": kind,
            "launches": sum(kernel.times for kernel in kernels),
            "GB": taken(kernels, lambda kernel: kernel.bytes) / 1e9,
            "expected ms": 1e3 * taken(kernels, lambda kernel: seconds_of(kernel, target.expected, target.devices)),
        }
        for (origin, kind), kernels in groups.items()
    ]
    return sorted(rows, key=lambda row: row["expected ms"], reverse=True)[:_NAMED]


if __name__ == "__main__":
    run(main)
