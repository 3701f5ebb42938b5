"""Peak resident memory of one forward, measured by the kernel in a process of its own (Linux).

Allocators are told to give large blocks back at once, the high-water mark is reset after compilation and a
warm-up run, and what counts is how far it then rises above the memory in use, at most in three runs.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).parent.parent
_PAUSE_S = 0.2  # in which what was freed is given back
_GIVE_BACK = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}


def peak_of_each(forms: Sequence[str]) -> dict[str, int]:
    """Return the peak in bytes by form, leaving out forms that cannot run here."""
    peaks = {}
    for form in forms:
        result = run_apart(["-m", "benchmarks.memory", form])
        if result.returncode != 0:
            last = result.stderr.strip().splitlines()[-1:] or ["no message"]
            print(f"{form}: memory not measured: {last[0]}")
            continue
        peaks[form] = int(result.stdout.split()[-1])
    return peaks


def run_apart(arguments: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run Python in a process whose allocator keeps no large block that was freed."""
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=_ROOT, env=os.environ | _GIVE_BACK, capture_output=True, text=True)


def _peak_above_use(run: Callable[[], Any]) -> int:
    """Return the largest rise of three runs: where the last run's memory is not given back yet, there is none."""
    run()
    rises = []
    for _ in range(3):
        time.sleep(_PAUSE_S)
        Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark
        before = _status("VmRSS")
        run()
        rises.append(_status("VmHWM") - before)
    return max(rises)


def _status(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return 1024 * int(line.split()[1])
    raise RuntimeError(f"the kernel does not report {field}")


def _runner(form: str) -> Callable[[], Any]:
    import jax

    from benchmarks.network_cases import dense_jax_forward, make_case, torch_forward
    from kmn_jax.models import encode_object, encode_scene, match

    case = make_case(1)
    if form == "dense PyTorch":
        call = torch_forward(case)
        if call is None:
            raise SystemExit("torch is not installed")
        return call
    if form == "dense JAX":
        dense = jax.jit(dense_jax_forward)
        return lambda: jax.block_until_ready(dense(case))
    model, crop = case.model, case.crops[0]
    part = encode_object(model, case.clouds[0], case.keypoint_indices)
    return lambda: jax.block_until_ready(match(model, encode_scene(model, crop), part))


if __name__ == "__main__":
    print(_peak_above_use(_runner(sys.argv[1])))
