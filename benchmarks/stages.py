"""Each stage of the scene branch and the pair head on its own, beside the time its arithmetic must take."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from benchmarks.network_cases import Case
from benchmarks.timing import Ceilings, compile_for, time_in_turn
from kmn_jax.geometry.knn import k_nearest

N, K, NEIGHBORS, FLOAT = 2048, 20, 20, 4


def measure_stages(case: Case, ceilings: Ceilings, repeats: int) -> list[dict[str, Any]]:
    """Return time, share of their sum, FLOP, least bytes, floor and gap of each stage at batch 1."""
    model = case.model
    xyz, x1 = case.crops[0][:, :3], _normal(0, N, 64)
    graph = jax.jit(lambda x: k_nearest(x, x, NEIGHBORS))(x1)
    local, scene, part = _normal(1, N, 192), _normal(2, N, 512), _normal(3, K, 128)

    def stage(function: Callable[..., Any], *arguments: jax.Array) -> Callable[[], Any]:
        ready = compile_for(lambda p, *a: function(nnx.merge(model.graphdef, p), *a), model.parameters, *arguments)
        return lambda: ready.function(model.parameters, *arguments)

    def knn(width: int) -> tuple[float, float]:
        return 2.0 * N * N * width, FLOAT * (N * width + N * NEIGHBORS)

    edges, selected = N * NEIGHBORS, FLOAT * N * NEIGHBORS
    # (call, FLOP, least bytes: inputs and outputs once, the N x k x 64 tensors of two-layer blocks once each way)
    cases: dict[str, tuple[Callable[[], Any], float, float]] = {
        "kNN on coordinates": (stage(lambda _, x: k_nearest(x, x, NEIGHBORS), xyz), *knn(3)),
        "kNN on features, first": (stage(lambda _, x: k_nearest(x, x, NEIGHBORS), x1), *knn(64)),
        "kNN on features, second": (stage(lambda _, x: k_nearest(x, x, NEIGHBORS), local[:, :64]), *knn(64)),
        "EdgeConv 1": (
            stage(lambda net, x, g: net.scene.edge1(x, g, "float32"), case.crops[0], graph),
            2.0 * (2 * N * 6 * 64 + edges * 64 * 64),
            FLOAT * (N * 70 + 2 * edges * 64) + selected,
        ),
        "EdgeConv 2": (
            stage(lambda net, x, g: net.scene.edge2(x, g, "float32"), x1, graph),
            2.0 * (2 * N * 64 * 64 + edges * 64 * 64),
            FLOAT * (N * 128 + 2 * edges * 64) + selected,
        ),
        "EdgeConv 3": (
            stage(lambda net, x, g: net.scene.edge3(x, g, "float32"), x1, graph),
            2.0 * 2 * N * 64 * 64 + 2.0 * edges * 64,
            FLOAT * N * 128 + selected,
        ),
        "global and output layers": (
            stage(lambda net, x: net.scene._with_global(x, "float32", None), local),
            2.0 * (N * 192 * 1024 + N * 192 * 512 + 1024 * 512),
            FLOAT * (N * (192 + 512) + 192 * 1024 + 1216 * 512),
        ),
        "pair head": (
            stage(lambda net, s, o: net.match(s, o), scene, part),
            2.0 * (N * 512 * 256 + N * 256 * 256 + N * 256 * 2) + 3.0 * N * K * 256,
            FLOAT * (N * (512 + 2 + K) + 1024 * 256),
        ),
    }
    times = time_in_turn({name: call for name, (call, _, _) in cases.items()}, repeats)
    total = sum(steady.median_ms for steady in times.values())
    rows = []
    for name, (_, flops, transferred) in cases.items():
        floor = ceilings.floor_ms(flops, transferred)
        rows.append(_row(name, times[name].median_ms, total, flops, transferred, floor))
    flops, transferred, floor = (sum(row[key] for row in rows) for key in ("GFLOP", "MB", "floor ms"))
    rows.append(_row("sum of the stages", total, total, 1e9 * flops, 1e6 * transferred, floor))
    return rows


def _row(name: str, ms: float, total: float, flops: float, transferred: float, floor: float) -> dict[str, Any]:
    return {
        "stage": name,
        "ms": ms,
        "share": ms / total,
        "GFLOP": flops / 1e9,
        "MB": transferred / 1e6,
        "floor ms": floor,
        "x floor": ms / floor,
    }


def _normal(seed: int, *shape: int) -> jax.Array:
    return jax.random.normal(jax.random.key(seed), shape, dtype=jnp.float32)
