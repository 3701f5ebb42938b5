"""The pose solver: RANSAC and ICP beside Open3D's on the same matches, Kabsch beside an SVD, time and success.

python -m benchmarks.pose [--draws 100] [--repeats 15] [--json FILE]
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.command import run
from benchmarks.synthetic import box_surface, synthetic_matches
from benchmarks.timing import compile_for, time_in_turn
from experiments.evaluation.rivals import OverMatches
from kmn_jax.errors import require
from kmn_jax.geometry import from_rotation_translation, pose_error, random_rotation, rotate_vectors, transform_points
from kmn_jax.pose import IcpConfig, Matches, RansacConfig, icp, kabsch, ransac
from kmn_jax.report import print_table, write_json

DIAMETER = 50.0


def main(
    draws: int = 100,
    inlier_shares: tuple[float, ...] = (0.2, 0.1, 0.05),
    batches: tuple[int, ...] = (1, 4, 16, 64),
    repeats: int = 15,
    json: Path | None = None,
) -> None:
    """Run all tables.

    Args:
        draws: problems for each success rate.
        inlier_shares: shares of right matches among 2048, at 1% noise.
        batches: matches sets solved at once, for throughput.
        repeats: timed rounds.
        json: where results go.
    """
    for share in inlier_shares:
        require(0 < share <= 1, f"--inlier-shares has {share}, but shares must be above 0 and up to 1")
    success = [row for share in inlier_shares for row in success_rows(share, draws)]
    print_table("2048 matches, 1% noise; success: rotation < 3 degrees and translation < 2% of the diameter", success)
    throughput = [row for batch in batches for row in ransac_rows(batch, repeats)]
    print_table("RANSAC, 1000 hypotheses x 2048 matches, 20% inliers", throughput)
    fits = kabsch_rows(repeats)
    print_table("Kabsch, many problems at once", fits)
    refinement = icp_rows(min(draws, 40), repeats)
    print_table("ICP from 5 degrees and 3% of the diameter off, 2048 x 2048 points, 1% noise", refinement)
    write_json(json, {"success": success, "ransac": throughput, "kabsch": fits, "icp": refinement})


def success_rows(inlier_share: float, draws: int) -> list[dict[str, Any]]:
    """Solve `draws` problems by each solver, one after the other, and count the right poses."""
    make = jax.jit(partial(synthetic_matches, inlier_share=inlier_share, noise=0.01, diameter=DIAMETER))
    problems = [make(key) for key in jax.random.split(jax.random.key(int(1000 * inlier_share)), draws)]
    solvers: dict[str, Callable[[jax.Array, Matches], Any]] = {
        "ours": lambda key, matches: ransac(key, matches).T_scene_object,
        "ours, no normal check": lambda key, matches: (
            ransac(key, matches, RansacConfig(use_normals=False)).T_scene_object
        ),
    }
    if importlib.util.find_spec("open3d") is not None:
        solvers |= {
            "Open3D, 5,000 iterations": lambda key, matches: _open3d_ransac(matches),
            "Open3D, 5,000 iterations + ICP": lambda key, matches: _with_icp(matches, _open3d_ransac(matches)),
        }
    keys = jax.random.split(jax.random.key(1), draws)
    rows = []
    for name, solve in solvers.items():
        jax.block_until_ready(solve(keys[0], problems[0][0]))
        errors, times = [], []
        for key, (matches, truth) in zip(keys, problems, strict=True):
            start = time.perf_counter()
            estimate = jax.block_until_ready(solve(key, matches))
            times.append(1e3 * (time.perf_counter() - start))
            angle, distance = pose_error(jnp.asarray(estimate, dtype=jnp.float32), truth)
            errors.append((float(jnp.rad2deg(angle)), float(distance) / DIAMETER))
        angles, distances = np.array(errors).T
        rows.append(
            {
                "inliers": inlier_share,
                "solver": name,
                "success": f"{int(((angles < 3) & (distances < 0.02)).sum())} of {draws}",
                "median degrees": float(np.median(angles)),
                "median % of diameter": 100 * float(np.median(distances)),
                "median ms": float(np.median(times)),
            }
        )
    return rows


def ransac_rows(batch: int, repeats: int) -> list[dict[str, Any]]:
    """Time the compiled solver on a batch."""
    keys = jax.random.split(jax.random.key(0), batch)
    matches, _ = jax.jit(jax.vmap(partial(synthetic_matches, diameter=DIAMETER)))(keys)
    on_cpu = jax.default_backend() == "cpu"

    def solve(keys: jax.Array, matches: Matches) -> Any:
        return jax.lax.map(lambda pair: ransac(*pair), (keys, matches)) if on_cpu else jax.vmap(ransac)(keys, matches)

    ready = compile_for(solve, keys, matches)
    steady = time_in_turn({"ours": lambda: ready.function(keys, matches)}, repeats)["ours"]
    return [
        {
            "batch": batch,
            "ms": steady.median_ms,
            "min ms": steady.minimum_ms,
            "ms each": steady.median_ms / batch,
            "compile s": ready.trace_s + ready.lower_s + ready.compile_s,
            "temporary MB": ready.temporary_bytes / 1e6,
        }
    ]


def kabsch_rows(repeats: int) -> list[dict[str, Any]]:
    """Time the closed form beside the textbook SVD, for triplets as RANSAC has them and for larger sets."""
    rows = []
    for problems, points in ((1000, 3), (100, 100), (1, 2048)):
        source_key, pose_key = jax.random.split(jax.random.key(points))
        source = jax.random.normal(source_key, (problems, points, 3))
        rotation = jax.vmap(random_rotation)(jax.random.split(pose_key, problems))
        target = jnp.einsum("pij,pnj->pni", rotation, source) + 1
        forms = {"ours": kabsch, "SVD": _svd_fit}
        ready = {name: compile_for(jax.vmap(form), source, target).function for name, form in forms.items()}
        times = time_in_turn({name: partial(f, source, target) for name, f in ready.items()}, repeats)
        for name, steady in times.items():
            fit = ready[name](source, target)
            residual = jax.vmap(transform_points)(fit, source) - target
            rows.append(
                {
                    "problems": problems,
                    "points": points,
                    "form": name,
                    "ms": steady.median_ms,
                    "x SVD": times["SVD"].median_ms / steady.median_ms,
                    "largest residual": float(jnp.abs(residual).max()),
                }
            )
    return rows


def icp_rows(draws: int, repeats: int) -> list[dict[str, Any]]:
    """Refine perturbed poses by each method; time one, report the median error of `draws`."""
    problems = [_icp_problem(key) for key in jax.random.split(jax.random.key(3), draws)]
    solvers: dict[str, Callable[[Any], Any]] = {
        "ours, point to plane": partial(_our_icp, method="point_to_plane"),
        "ours, point to point": partial(_our_icp, method="point_to_point"),
    }
    if importlib.util.find_spec("open3d") is not None:
        solvers |= {
            "Open3D, point to plane": partial(_open3d_icp, plane=True),
            "Open3D, point to point": partial(_open3d_icp, plane=False),
        }
    times = time_in_turn({name: partial(solve, problems[0]) for name, solve in solvers.items()}, repeats)
    rows = []
    for name, solve in solvers.items():
        poses = [jnp.asarray(solve(problem), dtype=jnp.float32) for problem in problems]
        errors = [pose_error(pose, problem["truth"]) for pose, problem in zip(poses, problems, strict=True)]
        rows.append(
            {
                "solver": name,
                "ms": times[name].median_ms,
                "median degrees": float(np.median([np.rad2deg(float(angle)) for angle, _ in errors])),
                "median % of diameter": float(np.median([100 * float(d) / DIAMETER for _, d in errors])),
            }
        )
    return rows


def _icp_problem(key: jax.Array) -> dict[str, jax.Array]:
    keys = jax.random.split(key, 7)
    object_points, object_normals = box_surface(keys[0], 2048, DIAMETER)
    truth = from_rotation_translation(random_rotation(keys[1]), DIAMETER * jax.random.normal(keys[2], (3,)))
    points, normals = box_surface(keys[3], 2048, DIAMETER)
    axis = jax.random.normal(keys[4], (3,))
    twist = jnp.deg2rad(5.0) * axis / jnp.linalg.norm(axis)
    zero = jnp.zeros(())
    skew = jnp.array([[zero, -twist[2], twist[1]], [twist[2], zero, -twist[0]], [-twist[1], twist[0], zero]])
    shift = jax.random.normal(keys[5], (3,))
    offset = from_rotation_translation(jax.scipy.linalg.expm(skew), 0.03 * DIAMETER * shift / jnp.linalg.norm(shift))
    noise = 0.01 * DIAMETER * jax.random.normal(keys[6], points.shape)
    return {
        "object_points": object_points,
        "object_normals": object_normals,
        "scene_points": transform_points(truth, points) + noise,
        "scene_normals": rotate_vectors(truth, normals),
        "truth": truth,
        "start": truth @ offset,
    }


def _our_icp(problem: dict[str, jax.Array], method: Any) -> jax.Array:
    return icp(
        problem["object_points"],
        problem["scene_points"],
        problem["start"],
        DIAMETER,
        scene_normals=problem["scene_normals"],
        config=IcpConfig(method=method),
    ).T_scene_object


def _svd_fit(source: jax.Array, target: jax.Array) -> jax.Array:
    """The textbook form: SVD of the cross-covariance, last column flipped against reflections."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = jnp.linalg.svd((target - b[None, :]).T @ (source - a[None, :]))
    sign = jnp.sign(jnp.linalg.det(u @ vt))
    rotation = (u * jnp.stack([jnp.ones(()), jnp.ones(()), sign])[None, :]) @ vt
    return from_rotation_translation(rotation, b - rotation @ a)


def _open3d_cloud(points: Any, normals: Any = None) -> Any:
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.asarray(points, dtype=np.float64)))
    if normals is not None:
        cloud.normals = open3d.utility.Vector3dVector(np.asarray(normals, dtype=np.float64))
    return cloud


def _open3d_ransac(matches: Matches) -> np.ndarray:
    """Open3D's RANSAC on matches; the published gate of 5 mm is a tenth of this object's diameter."""
    found = OverMatches(gate=0.1)(jax.device_get(matches), DIAMETER, 0)
    return np.eye(4) if found is None else found


def _with_icp(matches: Matches, pose: np.ndarray) -> np.ndarray:
    import open3d

    registration = open3d.pipelines.registration
    source, target = _open3d_cloud(matches.object_points), _open3d_cloud(matches.scene_points)
    criteria = registration.ICPConvergenceCriteria(max_iteration=10)
    estimation = registration.TransformationEstimationPointToPoint()
    return np.asarray(
        registration.registration_icp(source, target, 0.1 * DIAMETER, pose, estimation, criteria).transformation
    )


def _open3d_icp(problem: dict[str, jax.Array], plane: bool) -> np.ndarray:
    import open3d

    registration = open3d.pipelines.registration
    estimation = (
        registration.TransformationEstimationPointToPlane()
        if plane
        else registration.TransformationEstimationPointToPoint()
    )
    result = registration.registration_icp(
        _open3d_cloud(problem["object_points"]),
        _open3d_cloud(problem["scene_points"], problem["scene_normals"]),
        0.1 * DIAMETER,
        np.asarray(problem["start"], dtype=np.float64),
        estimation,
        registration.ICPConvergenceCriteria(max_iteration=50),
    )
    return np.asarray(result.transformation)


if __name__ == "__main__":
    run(main)
