"""The one timing kernel: compilation apart from running, rivals in turn, device and versions beside every number.

Rules, each against a mistake that changes results: an asynchronous call is timed to `block_until_ready`;
tracing, compiling and the first run are no part of what is timed, and told apart where they are told; rivals run in
turn within one loop, so that a machine that slows down slows all of them; each turn begins with a pause and an untimed
call, since the rival before may still be freeing memory and leave threads spinning; the median of the repeats counts.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_TIMED_A_TURN = 3
_PAUSE_S = 0.05


@dataclass(frozen=True)
class Compiled:
    """A compiled function with what it took to get there, in seconds, and its temporary memory in bytes."""

    function: Callable[..., Any]
    trace_s: float
    lower_s: float
    compile_s: float
    temporary_bytes: int


@dataclass(frozen=True)
class Steady:
    """Steady-state times of one candidate, in milliseconds."""

    median_ms: float
    minimum_ms: float


def compile_for(function: Callable[..., Any], *arguments: Any) -> Compiled:
    """Trace, lower and compile, each timed on its own, and run once. `function` may be jitted already."""
    jitted = function if hasattr(function, "trace") else jax.jit(function)
    start = time.perf_counter()
    traced = jitted.trace(*arguments)
    after_trace = time.perf_counter()
    lowered = traced.lower()
    after_lower = time.perf_counter()
    compiled = lowered.compile()
    after_compile = time.perf_counter()
    jax.block_until_ready(compiled(*arguments))
    memory = compiled.memory_analysis()
    return Compiled(
        compiled,
        after_trace - start,
        after_lower - after_trace,
        after_compile - after_lower,
        int(getattr(memory, "temp_size_in_bytes", 0)),
    )


def time_in_turn(
    candidates: Mapping[str, Callable[[], Any]], repeats: int = 15, limit_s: float = 120.0
) -> dict[str, Steady]:
    """Time each candidate three times a round for `repeats` timings in all; stop early after `limit_s`."""
    times: dict[str, list[float]] = {name: [] for name in candidates}
    begin = time.perf_counter()
    while min(map(len, times.values())) < repeats:
        for name, candidate in candidates.items():
            time.sleep(_PAUSE_S)
            jax.block_until_ready(candidate())
            for _ in range(_TIMED_A_TURN):
                start = time.perf_counter()
                jax.block_until_ready(candidate())
                times[name].append(1e3 * (time.perf_counter() - start))
        if time.perf_counter() - begin > limit_s:
            break
    return {name: Steady(float(np.median(t)), float(np.min(t))) for name, t in times.items()}


@contextmanager
def paused(path: Path | None) -> Iterator[None]:
    """Stop the processes whose ids a file holds, and let them go on afterwards, those that have not ended."""
    ids = [int(word) for word in path.read_text().split()] if path else []

    def send(number: int) -> None:
        for process in ids:
            with suppress(ProcessLookupError):
                os.kill(process, number)

    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(1)) if ids else None  # or they would stay stopped
    try:
        send(signal.SIGSTOP)
        if ids:
            time.sleep(0.3)  # what they have sent to the device ends
        yield
    finally:
        send(signal.SIGCONT)
        if ids:
            signal.signal(signal.SIGTERM, before)


@dataclass(frozen=True)
class Ceilings:
    """What this device reaches on the two simplest operations; floors are computed from them."""

    matmul_flops: float  # float32 at full precision, FLOP/s
    matmul_bfloat16_flops: float  # FLOP/s
    copy_bytes: float  # bytes read plus bytes written, per second

    def floor_ms(self, flops: float, transferred: float, low_precision: bool = False) -> float:
        """Return the larger of arithmetic time, in float32 or bfloat16, and memory time."""
        rate = self.matmul_bfloat16_flops if low_precision else self.matmul_flops
        return 1e3 * max(flops / rate, transferred / self.copy_bytes)


def measure_ceilings() -> Ceilings:
    """Measure a large matrix product and a large copy, on random data."""
    on_cpu = jax.default_backend() == "cpu"
    size, length = (2048, 2**26) if on_cpu else (8192, 2**30)
    a = jax.random.normal(jax.random.key(0), (size, size))
    half = a.astype(jnp.bfloat16)
    x = jax.random.normal(jax.random.key(1), (length,))
    highest = compile_for(lambda m: jnp.matmul(m, m, precision=jax.lax.Precision.HIGHEST), a).function
    low = compile_for(lambda m: jnp.matmul(m, m), half).function
    copy = jax.jit(lambda v: v + 1, donate_argnums=0)  # in place: fresh pages would cost more than the copy
    buffer = [x]

    def copy_in_place() -> jax.Array:
        buffer[0] = copy(buffer[0])
        return buffer[0]

    times = time_in_turn({"f32": lambda: highest(a), "bf16": lambda: low(half), "copy": copy_in_place}, 9)
    flops = 2.0 * size**3
    return Ceilings(
        flops / (1e-3 * times["f32"].median_ms),
        flops / (1e-3 * times["bf16"].median_ms),
        8.0 * length / (1e-3 * times["copy"].median_ms),
    )
