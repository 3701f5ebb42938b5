"""How tests compile, and where the programs are kept that they have compiled; imports nothing that is compiled with."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
from importlib.metadata import version
from pathlib import Path

_MOST_KEPT = 1e9  # bytes
_PLAIN_LOOPS = "--xla_cpu_use_fusion_emitters=false"
_LESS_OPTIMISED = "--xla_backend_optimization_level=1"
_IN_ONE_PIECE = "--xla_cpu_parallel_codegen_split_count=1"


def quick_flags() -> str:
    """Return XLA_FLAGS with which compiling for CPUs takes less than half of the time; flags that are given stay.

    Fused loops are made without MLIR, as in users' searches, LLVM optimises less, and no program is cut into pieces for
    several threads, as pytest's workers keep all cores busy; programs are about as fast. XLA ends a process for a flag
    that it does not know, so versions that are not known to have them go without.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    known = version("jaxlib").startswith("0.10.")
    given = {flag.partition("=")[0] for flag in flags.split()}
    wanted = (_PLAIN_LOOPS, _LESS_OPTIMISED, _IN_ONE_PIECE) if known else ()
    return " ".join([*flags.split(), *(flag for flag in wanted if flag.partition("=")[0] not in given)])


def with_devices(count: int) -> str:
    """Return the XLA_FLAGS of a process whose CPU is so many devices."""
    return f"{quick_flags()} --xla_force_host_platform_device_count={count}"


def kept_programs() -> str:
    """Return a folder of the checkout: one for each kind of processor, begun anew when it has grown large."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    kind = sorted({line for line in lines if line.startswith(("model name", "flags"))})
    name = hashlib.sha256("\n".join([platform.machine(), platform.processor(), *kind]).encode()).hexdigest()[:16]
    folder = Path(__file__).parents[2] / ".cache" / f"compiled_{name}"
    if sum(path.stat().st_size for path in folder.glob("*")) > _MOST_KEPT:
        shutil.rmtree(folder, ignore_errors=True)
    return str(folder)
