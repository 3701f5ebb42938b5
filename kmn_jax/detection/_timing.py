"""Wall time by stage, with what JAX spends on compiling counted apart."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import jax.monitoring

from kmn_jax.detection._result import Timing

# What JAX reports of tracing, lowering and compiling; reading a compiled program from the cache counts too.
_COMPILING = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)


class Clock:
    """Times stages one after the other; what runs meanwhile in other threads is not told apart."""

    def __init__(self) -> None:
        self._total = _compile_seconds()
        self._stages: dict[str, float] = {}
        self._compile = 0.0

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage."""
        start, compiled = time.perf_counter(), self._total[0]
        try:
            yield
        finally:
            spent, compiling = time.perf_counter() - start, self._total[0] - compiled
            compiling = min(compiling, spent)  # traces within traces are reported twice
            self._stages[stage] = self._stages.get(stage, 0.0) + spent - compiling
            self._compile += compiling

    @property
    def timing(self) -> Timing:
        """What was measured so far."""
        return Timing(dict(self._stages), self._compile)


@cache
def _compile_seconds() -> list[float]:
    """Return the place where the process adds up its seconds of compiling."""
    total = [0.0]

    def add(event: str, duration_secs: float, **_: str | int) -> None:
        if event in _COMPILING:
            total[0] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(add)
    return total
