"""Every stage beside the time that its arithmetic or its memory must take, here and on an H200.

python -m benchmarks.roofline [--repeats 15] [--json FILE]

Floors here come from a matrix product and a copy measured in the same run; those of an H200 from the same two measured
on one (a bfloat16 product and a copy) and, for float32 outside of matrix units, the vendor's figure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax

from benchmarks.command import run
from benchmarks.network_cases import make_case
from benchmarks.stages import Stage, network_call, network_stages, pose_stages, training_stages
from benchmarks.timing import Ceilings, measure_ceilings, time_in_turn
from benchmarks.work import Work, total
from configs import find_config
from kmn_jax.released import RELEASED
from kmn_jax.report import print_table, write_json

# Measured on such a machine: 8192 x 8192 bfloat16 products of random data, and device-to-device copies. The first, of
# float32 without matrix units, is the vendor's.
H200 = Ceilings(matmul_flops=67e12, matmul_bfloat16_flops=788e12, copy_bytes=4.3e12)

_WHOLE = "all in one call"


def main(repeats: int = 15, training: tuple[str, ...] = ("small", "base"), json: Path | None = None) -> None:
    """Print three tables.

    Args:
        repeats: timed rounds of each stage.
        training: configs of which a training step is timed.
        json: where results go.
    """
    for name in training:
        find_config(name)  # before anything is measured
    ceilings = measure_ceilings()
    print(
        f"ceilings here: {ceilings.matmul_flops / 1e9:.0f} GFLOP/s in float32,"
        f" {ceilings.matmul_bfloat16_flops / 1e9:.0f} in bfloat16, {ceilings.copy_bytes / 1e9:.0f} GB/s"
    )
    results: dict[str, Any] = {"ceilings": asdict(ceilings), "H200": asdict(H200)}
    case = make_case(1)
    tables = {
        "network": ("network with cached object features, N = 2048, batch 1", network_stages(case), network_call(case)),
        "pose": (f"`{RELEASED}`, from a scan to the refined pose of one crop", pose_stages(), None),
        "training": ("training", training_stages(training, jax.default_backend() == "cpu"), None),
    }
    for key, (title, stages, whole) in tables.items():
        results[key] = roofline_rows(stages, ceilings, repeats, whole)
        print_table(title, results[key])
    write_json(json, results)


def roofline_rows(
    stages: Mapping[str, Stage], ceilings: Ceilings, repeats: int, whole: Callable[[], Any] | None
) -> list[dict[str, Any]]:
    """Time stages in turn; if there is a call of them all, the last rows are their sum and this call."""
    calls = {name: stage.call for name, stage in stages.items()}
    times = time_in_turn(calls if whole is None else {**calls, _WHOLE: whole}, repeats)
    rows = [_row(name, times[name].median_ms, stage.work, ceilings) for name, stage in stages.items()]
    if whole is not None:
        together = total(stage.work for stage in stages.values())
        # One after the other, each at its own limit.
        floors = {column: sum(row[column] for row in rows) for column in ("floor ms", "H200 floor us")}
        for name, ms in (("sum of the stages", sum(row["ms"] for row in rows)), (_WHOLE, times[_WHOLE].median_ms)):
            row = _row(name, ms, together, ceilings) | floors
            rows.append(row | {"x floor": ms / floors["floor ms"], "bound": None})
    return rows


def _row(name: str, ms: float, work: Work, ceilings: Ceilings) -> dict[str, Any]:
    floor = work.floor_ms(ceilings)
    return {
        "stage": name,
        "GFLOP": work.flops / 1e9,
        "MB": work.moved / 1e6,
        "FLOP/byte": work.intensity,
        "bound": work.bound(ceilings),
        "floor ms": floor,
        "ms": ms,
        "x floor": ms / floor,
        "H200 floor us": 1e3 * work.floor_ms(H200, low_precision=True),
    }


if __name__ == "__main__":
    run(main)
