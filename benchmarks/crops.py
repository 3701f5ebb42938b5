"""From points to refined poses by a network: beside Open3D, at growing batches, and a whole bin in one call.

python -m benchmarks.crops [--batches 1 4 16 64] [--folder DATASET] [--weights FILE] [--json FILE]

Open3D's FPFH and RANSAC get the same crops; their poses are counted and timed without refinement and with the ICP that
all methods of an evaluation share, ours with the refinement of the same call.

A crop's stages are one compiled call, a bin's too: depth image in, ranked poses out. Beside a bin's call stands the
search in rounds of `PoseEstimator.detect`, which refines more poses, on more points, and compares turned forms of each.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.command import run
from benchmarks.network_cases import map_crops
from benchmarks.stages import SEARCH, small_crop
from benchmarks.timing import compile_for, time_in_turn
from experiments.bins import LEAST_VISIBLE, THRESHOLD, BinImage, bin_images
from experiments.evaluation.cases import Case, ObjectImages, Solver, draw_cases
from experiments.evaluation.methods import Ours
from experiments.evaluation.refinement import Refinement
from experiments.evaluation.rivals import missing
from experiments.evaluation.scores import pair_errors
from experiments.evaluation.sources import bop_objects
from experiments.evaluation.tuned import RIVALS
from kmn_jax.detection import (
    BinPosesConfig,
    PoseEstimator,
    bin_poses,
    device_calibration,
    device_part,
    poses_in_crop,
    search_crop,
)
from kmn_jax.models import Model
from kmn_jax.objects import ObjectModel
from kmn_jax.released import RELEASED
from kmn_jax.report import print_table, write_json

_RIVAL = "FPFH + RANSAC"


def main(
    batches: tuple[int, ...] = (1, 4, 16),
    folder: Path = Path("experiments/assets/small_test_set"),
    every: int = 1,
    seeds: int = 32,
    repeats: int = 9,
    weights: str = RELEASED,
    json: Path | None = None,
) -> None:
    """Run all tables.

    Args:
        batches: crops at once.
        folder: dataset in BOP format, with a bin in each image.
        every: every so many images of it.
        seeds: crops that a bin's call searches.
        repeats: timed rounds.
        weights: released network, or a .safetensors file.
        json: where results go.
    """
    estimator = PoseEstimator.from_pretrained(weights)
    same = [row for found in bop_objects(folder, "test", print) for row in same_crops(estimator.model, found, repeats)]
    print_table("the same crops, 1% noise, one after another", same)
    crops = [crop_row(estimator.model, batch, repeats) for batch in batches]
    print_table(f"crops to refined poses, `{weights}`", crops)
    config = BinPosesConfig(num_seeds=seeds)
    images = bin_images(folder, "test", estimator.model, every)
    bins = [bin_row(estimator, image, config, repeats) for image in images]
    print_table("whole bins", bins)
    totals = {key: sum(row[key] for row in bins) for key in ("visible", *_counted("call"), *_counted("rounds"))}
    print_table("all bins: poses, right ones, and visible copies that were found", [totals])
    write_json(json, {"same crops": same, "crops": crops, "bins": bins, "totals": totals})


def same_crops(model: Model, found: ObjectImages, repeats: int, count: int = 12) -> list[dict[str, Any]]:
    """Time ours, refined, and Open3D's FPFH and RANSAC, on crops of an object; count what each finds."""
    cases = list(draw_cases(found, count, 0.01))
    if not cases:
        return []
    solvers = {"ours, refined": Ours("ours", model).prepare(found.model)}
    module, make = RIVALS["fpfh"]
    if (reason := missing(module)) is None:
        solve = make().prepare(found.model)
        solvers |= {_RIVAL: solve, f"{_RIVAL} + ICP": _with(solve, Refinement(found.model))}
    else:
        print(f"skipped {_RIVAL}: {reason}")
    calls = {name: partial(_solved, solve, cases) for name, solve in solvers.items()}
    times = time_in_turn(calls, repeats)
    rows = []
    for name, call in calls.items():
        right = [
            pose is not None and _error(pose, case, found.model) < THRESHOLD
            for pose, case in zip(call(), cases, strict=True)
        ]
        rows.append(
            {
                "object": found.name,
                "method": name,
                "crops": len(cases),
                "right": sum(right),
                "ms a crop": times[name].median_ms / len(cases),
                f"x {_RIVAL}": times[_RIVAL].median_ms / times[name].median_ms if reason is None else None,
            }
        )
    return rows


def _with(solve: Solver, refine: Refinement) -> Solver:
    def refined(case: Case) -> np.ndarray | None:
        pose = solve(case)
        return None if pose is None else refine(case, pose)

    return refined


def _solved(solve: Solver, cases: Sequence[Case]) -> list[np.ndarray | None]:
    return [solve(case) for case in cases]


def _error(pose: np.ndarray, case: Case, model: ObjectModel) -> float:
    """Return the ADI to the nearest copy, in diameters."""
    pairs = np.stack([np.broadcast_to(pose, case.T_camera_object.shape), case.T_camera_object], axis=1)
    return float(pair_errors(pairs, model).min())


def crop_row(model: Model, batch: int, repeats: int) -> dict[str, Any]:
    """Time the same crop, many times at once, each with draws of its own."""
    _, part, cloud = small_crop(model)
    config = SEARCH.of_network(model.config)
    keys = jax.random.split(jax.random.key(0), batch)
    clouds = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (batch, *leaf.shape)), cloud)

    def solve(parameters: Any, part: Any, clouds: Any, keys: jax.Array) -> Any:
        def one(item: Any) -> Any:
            cloud, key = item
            crop = search_crop(cloud, 0, part.diameter, key, config)
            return poses_in_crop(model.graphdef, parameters, part, crop, key, config).poses

        return map_crops(one, (clouds, keys))

    ready = compile_for(solve, model.parameters, part, clouds, keys)
    call = partial(ready.function, model.parameters, part, clouds, keys)
    steady = time_in_turn({"crops": call}, repeats)["crops"]
    return {
        "batch": batch,
        "ms": steady.median_ms,
        "min ms": steady.minimum_ms,
        "crops/s": 1e3 * batch / steady.median_ms,
        "compile s": ready.trace_s + ready.lower_s + ready.compile_s,
        "temporary MB": ready.temporary_bytes / 1e6,
        "converged": f"{int(call().converged[:, 0].sum())} of {batch}",
    }


def bin_row(estimator: PoseEstimator, image: BinImage, config: BinPosesConfig, repeats: int) -> dict[str, Any]:
    """Time one call, and the search in rounds, on the same image; count what each finds."""
    model, scene = estimator.model, image.scene
    part, calibration = device_part(model, image.part), device_calibration(estimator.probabilities.found)
    measured = scene.image._replace(depth=jnp.asarray(scene.depth))
    inside, key = jnp.asarray(image.inside), jax.random.key(0)
    config = replace(config, search=config.search.of_network(model.config))
    call = partial(bin_poses, *model, part, calibration, measured, inside, key, config=config)
    found = jax.device_get(call())
    with jax.transfer_guard("disallow"):
        times = time_in_turn({"call": call}, repeats)["call"]
    poses = found.T_camera_object[found.mask & (found.probability >= estimator.config.accepted)]
    estimator.detect(image.part, image.scene)
    start = time.perf_counter()
    detected = estimator.detect(image.part, image.scene)
    seconds = time.perf_counter() - start
    likely = [pose.T_scene_object for pose in detected.poses if pose.probability >= estimator.config.accepted]
    return {
        "part": image.part.name,
        "copies": len(image.truth),
        "visible": int((image.visible >= LEAST_VISIBLE).sum()),
        "call ms": times.median_ms,
        **_tally("call", image, poses),
        "rounds ms": 1e3 * seconds,
        **_tally("rounds", image, np.array(likely, dtype=np.float32).reshape(-1, 4, 4)),
    }


def _counted(of: str) -> tuple[str, str, str]:
    return f"{of} poses", f"{of} right", f"{of} found"


def _tally(of: str, image: BinImage, poses: np.ndarray) -> dict[str, int]:
    """Count poses, right ones, and copies that can be seen and have a right one."""
    if not len(poses):
        return dict.fromkeys(_counted(of), 0)
    right = image.errors(poses) < THRESHOLD
    counts = len(poses), right.any(axis=1).sum(), (right.any(axis=0) & (image.visible >= LEAST_VISIBLE)).sum()
    return dict(zip(_counted(of), map(int, counts), strict=True))


if __name__ == "__main__":
    run(main)
