"""Exact nearest neighbours: ours, one plain `top_k` in JAX, and PyTorch, of points in the network's order and shuffled.

python -m benchmarks.knn [--sizes 1024 2048 4096] [--widths 3 64] [--repeats 15] [--json FILE]
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.command import run
from benchmarks.network_cases import points_in_order
from benchmarks.timing import compile_for, time_in_turn
from kmn_jax.errors import require
from kmn_jax.geometry import k_nearest, neighbor_graph, squared_distances
from kmn_jax.report import print_table, write_json


def main(
    sizes: tuple[int, ...] = (1024, 2048, 4096),
    widths: tuple[int, ...] = (3, 64),
    k: int = 20,
    repeats: int = 15,
    json: Path | None = None,
) -> None:
    """Time all forms on the same clouds.

    Args:
        sizes: points, each a query and a candidate.
        widths: features of a point.
        k: neighbours.
        repeats: timed rounds.
        json: where results go.
    """
    require(k <= min(sizes), f"--k is {k}, but there are only {min(sizes)} points in the smallest of --sizes")
    rows = [row for size in sizes for width in widths for row in knn_rows(size, width, k, repeats)]
    print_table(f"{k} nearest neighbours", rows)
    write_json(json, {"knn": rows})


def knn_rows(size: int, width: int, k: int, repeats: int) -> list[dict[str, Any]]:
    """Time all forms on one cloud in two orders, and compare their neighbour sets with float64."""
    along_curve = points_in_order(size, width)
    shuffled = jax.random.permutation(jax.random.key(2), along_curve)
    return [
        {"points": size, "width": width, "order": order, **row}
        for order, x in (("along the curve", along_curve), ("shuffled", shuffled))
        for row in _rows(x, k, repeats)
    ]


def _rows(x: jax.Array, k: int, repeats: int) -> list[dict[str, Any]]:
    forms: dict[str, Callable[[jax.Array], jax.Array]] = {
        "neighbor_graph": lambda x: neighbor_graph(x, k),
        "k_nearest": lambda x: k_nearest(x, x, k),
        "one top_k": lambda x: jax.lax.top_k(-squared_distances(x, x), k)[1],
        "distances alone": lambda x: squared_distances(x, x),
    }
    ready = {name: compile_for(form, x).function for name, form in forms.items()}
    calls: dict[str, Callable[[], Any]] = {name: partial(f, x) for name, f in ready.items()}
    if importlib.util.find_spec("torch") is not None and jax.default_backend() == "cpu":
        calls["PyTorch"] = _torch_knn(x, k)
    exact = _exact(np.asarray(x, dtype=np.float64), k)
    times = time_in_turn(calls, repeats)
    return [
        {
            "form": name,
            "ms": steady.median_ms,
            "min ms": steady.minimum_ms,
            "x one top_k": times["one top_k"].median_ms / steady.median_ms,
            "neighbours right": None if name == "distances alone" else _share_right(np.asarray(calls[name]()), exact),
        }
        for name, steady in times.items()
    ]


def _torch_knn(x: jax.Array, k: int) -> Callable[[], np.ndarray]:
    import torch

    torch.set_num_threads(os.cpu_count() or 1)
    rows = torch.from_numpy(np.array(x))

    def run() -> np.ndarray:
        squares = (rows**2).sum(dim=1)
        return (2 * rows @ rows.T - squares[:, None] - squares[None, :]).topk(k).indices.numpy()

    return run


def _exact(x: np.ndarray, k: int) -> np.ndarray:
    squares = (x**2).sum(axis=1)
    distances = squares[:, None] + squares[None, :] - 2 * x @ x.T
    return np.argpartition(distances, k - 1, axis=1)[:, :k]


def _share_right(found: np.ndarray, exact: np.ndarray) -> float:
    pairs = zip(found, exact, strict=True)
    return float(np.mean([len(np.intersect1d(a, b)) for a, b in pairs]) / exact.shape[1])


if __name__ == "__main__":
    run(main)
