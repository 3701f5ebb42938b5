"""Whether anything has become slower: ratios of ours over plain forms in the same run, beside committed baselines.

python -m benchmarks.gate [--update] [--repeats 5] [--json FILE]

Ratios, as milliseconds of a busy or another machine say nothing; loose, as ratios vary there too. Each processor has a
baseline of its own, `--update` writes it on a machine with nothing else to do; others are held to the lowest of all.
"""

from __future__ import annotations

import json as json_format
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from benchmarks.command import run
from benchmarks.network_cases import Case, dense_jax_forward, head_features, make_case, match, points_in_order
from benchmarks.reference import dense_jax
from benchmarks.stages import SEARCH, network_call, small_crop
from benchmarks.timing import compile_for, time_in_turn
from kmn_jax.detection import poses_at
from kmn_jax.errors import InputError
from kmn_jax.geometry import k_nearest, neighbor_graph, squared_distances
from kmn_jax.models import released_object, released_scene
from kmn_jax.report import print_table, processor, write_json

BASELINES = Path(__file__).with_name("baselines")
LEAST = 0.6  # of the baseline's ratio: below, something has become slower
_TRAINED_POINTS = 512  # of the gradient: the dense one needs gigabytes for more


class Pair(NamedTuple):
    """Two calls: ours, and the plain form that it is measured against."""

    ours: Callable[[], Any]
    plain: Callable[[], Any]


def main(update: bool = False, repeats: int = 5, json: Path | None = None) -> int:
    """Compare, and return 1 if a ratio has fallen too far.

    Args:
        update: write the baseline of this processor, too.
        repeats: timed rounds of each pair.
        json: where the ratios go.
    """
    case = make_case(1)
    network = network_pair(case)
    pairs = {
        "network, cached object, over dense JAX": network,
        "gradient of the network over dense JAX": gradient_pair(case),
        "pair head over dense JAX": head_pair(case),
        "graph of 2048 coordinates over one top_k": neighbor_pair(points_in_order(2048, 3), neighbor_graph),
        "graph of 2048 features over one top_k": neighbor_pair(points_in_order(2048, 64), neighbor_graph),
        "20 nearest of 2048 coordinates over one top_k": neighbor_pair(
            jax.random.normal(jax.random.key(0), (2048, 3)), lambda x, k: k_nearest(x, x, k)
        ),
        "crop to refined pose over a dense forward": pose_pair(network.plain),
    }
    ratios = {name: times_faster(pair, repeats) for name, pair in pairs.items()}
    if update:
        write_json(BASELINES / f"{re.sub('[^a-z0-9]+', '-', processor().lower())}.json", {"ratios": ratios})
    baseline, of = baseline_for(processor(), read_baselines(BASELINES))
    ratios = looked_at_again(ratios, baseline, lambda name: times_faster(pairs[name], repeats))
    rows, slower = compared(ratios, baseline)
    print_table(f"how many times faster ours is, beside the baseline of {of}", rows)
    write_json(json, {"ratios": ratios})
    for name in slower:
        print(f"slower than it was: {name}", file=sys.stderr)
    return 1 if slower else 0


def read_baselines(folder: Path) -> dict[str, dict[str, float]]:
    """Return the ratios that were measured on each processor."""
    files = [json_format.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))]
    return {file["environment"]["processor"]: file["ratios"] for file in files}


def baseline_for(now: str, found: Mapping[str, Mapping[str, float]]) -> tuple[Mapping[str, float], str]:
    """Return the ratios to compare a processor's with, and whose they are: its own, or the lowest of all others."""
    if now in found:
        return found[now], now
    names = {name for ratios in found.values() for name in ratios}
    lowest = {name: min(ratios[name] for ratios in found.values() if name in ratios) for name in sorted(names)}
    return lowest, f"other processors ({', '.join(found)}), the lowest of each, as {now} has none"


def times_faster(pair: Pair, repeats: int) -> float:
    """Return how many times faster ours is, by medians of calls in turn."""
    times = time_in_turn(pair._asdict(), repeats)
    return times["plain"].median_ms / times["ours"].median_ms


def looked_at_again(
    ratios: Mapping[str, float], baseline: Mapping[str, float], measure: Callable[[str], float]
) -> dict[str, float]:
    """Measure up to twice more what has fallen too far: another process slows a call for a while, a change always."""
    best = dict(ratios)
    for _ in range(2):
        for name in compared(best, baseline)[1]:
            best[name] = max(best[name], measure(name))
    return best


def compared(ratios: Mapping[str, float], baseline: Mapping[str, float]) -> tuple[list[dict[str, Any]], list[str]]:
    """Return a row for each ratio, and the names of those that have fallen too far."""
    if set(ratios) != set(baseline):
        raise InputError(f"the baseline holds other ratios than were measured: {sorted(set(ratios) ^ set(baseline))}")
    rows = [
        {"pair": name, "ratio": ratio, "baseline": baseline[name], "least": LEAST * baseline[name]}
        for name, ratio in ratios.items()
    ]
    return rows, [name for name, ratio in ratios.items() if ratio < LEAST * baseline[name]]


def network_pair(case: Case) -> Pair:
    """The scene branch and the pair head, beside all branches: the dense form caches nothing."""
    return Pair(network_call(case), _ready(dense_jax_forward, case))


def gradient_pair(case: Case) -> Pair:
    """The gradient of the sum of squared logits of a smaller crop."""
    graphdef, length = case.model.graphdef, jnp.float32(1)
    clouds = case.crops[0, :_TRAINED_POINTS], case.clouds[0, :_TRAINED_POINTS]
    keypoints = jnp.arange(20) * (_TRAINED_POINTS // 20)

    def ours(parameters: nnx.State, crop: jax.Array, cloud: jax.Array) -> jax.Array:
        network = nnx.merge(graphdef, parameters)
        part = network.encode_object(cloud, keypoints, length)
        return _sum_of_squares(network.match(network.encode_scene(crop, length), part))

    def plain(parameters: Any, crop: jax.Array, cloud: jax.Array) -> jax.Array:
        crop, cloud = released_scene(crop, None), released_object(cloud)
        scene = dense_jax.encode_scene(crop, parameters)
        part = dense_jax.encode_object(cloud, keypoints, parameters)
        return _sum_of_squares(dense_jax.match(scene, part, parameters))

    return Pair(
        _ready(jax.grad(ours), case.parameters, *clouds),
        _ready(jax.grad(plain), nnx.to_pure_dict(case.parameters), *clouds),
    )


def head_pair(case: Case) -> Pair:
    """The pair head on drawn features."""
    features = head_features()
    return Pair(
        _ready(partial(match, case.model.graphdef), case.parameters, *features),
        _ready(dense_jax.match, *features, nnx.to_pure_dict(case.parameters)),
    )


def neighbor_pair(x: jax.Array, nearest: Callable[[jax.Array, int], jax.Array]) -> Pair:
    """Exact neighbours of points (n, c) among themselves."""
    return Pair(
        _ready(lambda x: nearest(x, 20), x), _ready(lambda x: jax.lax.top_k(-squared_distances(x, x), 20)[1], x)
    )


def pose_pair(forward: Callable[[], Any]) -> Pair:
    """The released network from a crop to the refined pose, beside one dense `forward` of the published network.

    With all draws, so that its work is the same for any key. Not the same result, but both take the same time on every
    run, which a rival's RANSAC does not.
    """
    model, part, cloud = small_crop()
    config = replace(SEARCH.of_network(model.config), enough=None)
    return Pair(lambda: poses_at(model, part, cloud, 0, 0, config), forward)


def _ready(function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    return partial(compile_for(function, *arguments).function, *arguments)


def _sum_of_squares(outputs: tuple[jax.Array, jax.Array]) -> jax.Array:
    segmentation, logits = outputs
    return (segmentation**2).sum() + (logits**2).sum()


if __name__ == "__main__":
    run(main)
