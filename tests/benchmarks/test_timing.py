from __future__ import annotations

import json
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.memory import run_apart
from benchmarks.timing import Ceilings, compile_for, paused, time_in_turn
from kmn_jax.errors import InputError
from kmn_jax.report import check_target, print_table, write_json


def test_compilation_is_apart_from_running() -> None:
    ready = compile_for(lambda x: jnp.sin(x) @ x.T, jnp.ones((200, 200)))
    assert min(ready.trace_s, ready.lower_s, ready.compile_s) > 0
    np.testing.assert_allclose(ready.function(jnp.ones((200, 200)))[0, 0], 200 * np.sin(1), rtol=1e-5)


def test_rivals_run_in_turn_and_the_median_counts() -> None:
    calls: list[str] = []

    def rival(name: str, seconds: float):
        def run() -> jax.Array:
            calls.append(name)
            time.sleep(seconds)
            return jnp.zeros(1)

        return run

    times = time_in_turn({"slow": rival("slow", 0.02), "fast": rival("fast", 0.002)}, repeats=4)
    assert times["slow"].median_ms >= 20
    assert times["slow"].median_ms > 3 * times["fast"].median_ms
    assert calls.count("slow") >= 4 + 2  # of which two are untimed
    assert calls[:8] == ["slow"] * 4 + ["fast"] * 4, "an untimed call, then three timed ones"


def test_floor_is_the_larger_of_arithmetic_and_memory() -> None:
    ceilings = Ceilings(matmul_flops=1e9, matmul_bfloat16_flops=2e9, copy_bytes=1e8)
    assert ceilings.floor_ms(flops=1e9, transferred=1e6) == pytest.approx(1000)
    assert ceilings.floor_ms(flops=1e3, transferred=1e8) == pytest.approx(1000)


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's high-water mark is Linux's")
def test_peak_memory_sees_a_temporary_array() -> None:
    code = """
import numpy as np
from benchmarks.memory import _peak_above_use
print(_peak_above_use(lambda: np.ones(40_000_000 // 8).sum()))
"""
    result = run_apart(["-c", code])
    assert result.returncode == 0, result.stderr
    assert 38e6 < int(result.stdout) < 60e6


def test_results_carry_their_environment(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    print_table("title", [{"a": 1.23456, "b": None}])
    assert "| 1.23 | - |" in capsys.readouterr().out
    write_json(tmp_path / "out" / "r.json", {"rows": [{"a": np.float32(1)}]})
    written = json.loads((tmp_path / "out" / "r.json").read_text())
    assert written["rows"] == [{"a": 1.0}]
    assert {"device", "versions", "commit", "date", "command"} <= written["environment"].keys()
    with pytest.raises(InputError, match="cannot write"):
        check_target(tmp_path / "out")  # before anything is measured


def test_what_shares_the_device_is_stopped_while_it_is_timed(tmp_path: Path) -> None:
    with subprocess.Popen(["sleep", "60"]) as other, subprocess.Popen(["true"]) as ended:
        ended.wait()
        path = tmp_path / "ids"
        path.write_text(f"{other.pid}\n{ended.pid}\n")

        def status() -> str:
            return Path(f"/proc/{other.pid}/stat").read_text().rsplit(")", 1)[1].split()[0]

        try:
            with suppress(RuntimeError), paused(path):
                during = status()
                raise RuntimeError("timing failed")
            assert during == "T"
            assert status() != "T"
        finally:
            other.kill()
    with paused(None):  # nothing to stop
        pass
