"""Programs as XLA optimizes them for TPUs, without machine code for them, of which nothing is counted.

libtpu optimizes a training step of `base` for 256 chips within half a minute on two cores, but makes machine code for
each of its two thousand kernels after that, tens of thousands of instructions for a gather: that is what took longer
than anyone waited. Before it does so, it writes down the optimized program and the memory for it, if it is asked to.
"""

from __future__ import annotations

import re
import time
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.compiled_programs import programs
from benchmarks.compiled_targets import TARGETS, devices_of, prepare
from kmn_jax.errors import InputError
from kmn_jax.platforms import for_any_platform

_PROGRAM = "*.after_optimizations.txt"
_MEMORY = "*.after_optimizations-buffer-assignment.txt"
_LAST = "*.after_optimizations_after_buffer_assignment.txt"  # written after both, which then are whole
_ARGUMENTS = re.compile(r"^allocation \d+: size (\d+), parameter", re.MULTILINE)
_TEMPORARY = re.compile(r"^allocation \d+: size (\d+), preallocated-temp:", re.MULTILINE)  # others lie on the chip
_POLL_S = 0.5


def optimized(target: str, name: str) -> tuple[str, dict[str, Any]]:
    """Return the text of a program as it is before machine code is made, and its memory.

    Another process compiles it, and is ended once it has written these. Raises InputError if it ends without them.
    """
    start = time.perf_counter()
    with TemporaryDirectory() as folder:
        compiler = get_context("spawn").Process(target=_compile, args=(target, name, folder), daemon=True)
        compiler.start()
        try:
            while not (written := list(Path(folder).glob(_LAST))) and compiler.is_alive():
                compiler.join(_POLL_S)
        finally:
            compiler.kill()
            compiler.join()
        if not written and not list(Path(folder).glob(_LAST)):
            raise InputError(f"{name!r} was not compiled for {target}: what stands above is why")
        text, memory = (next(Path(folder).glob(file)).read_text() for file in (_PROGRAM, _MEMORY))
    return text, {"until optimized s": time.perf_counter() - start} | megabytes(memory)


def megabytes(memory: str) -> dict[str, float]:
    """Return what a program takes of a device's main memory, from libtpu's list of its allocations."""
    found = {"temporary MB": _TEMPORARY, "argument MB": _ARGUMENTS}
    return {name: sum(int(size) for size in pattern.findall(memory)) / 1e6 for name, pattern in found.items()}


def _compile(target: str, name: str, folder: str) -> None:
    where = TARGETS[target]
    prepare(where)
    program = next(program for program in programs(where.devices) if program.name == name)
    function, arguments = program.make(devices_of(where))
    with for_any_platform():
        lowered = function.lower(*arguments)
    lowered.compile(compiler_options={"xla_dump_to": folder})
