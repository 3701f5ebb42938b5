"""How time and memory grow with each size, fitted: points, keypoints, crops, hypotheses, seeds of a bin, devices.

python -m benchmarks.scaling [--repeats 9] [--json FILE] [--picture FILE.png]

Fits are non-negative sums of a constant, a part in proportion to the size and one to its square; the bend is where the
square overtakes the rest.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from flax import nnx
from jaxtyping import Float

from benchmarks.command import run
from benchmarks.network_cases import cached_forward, encode_objects, head_features, make_case, match
from benchmarks.stages import SEARCH, small_case, small_crop
from benchmarks.synthetic import synthetic_matches
from benchmarks.timing import Compiled, compile_for, time_in_turn
from benchmarks.training import of_batch, throughput_rows
from configs import find_config
from experiments.evaluation.plots import as_png, new_figure
from kmn_jax.detection import map_real, poses_in_crop, search_crop, spread_seeds
from kmn_jax.models import load_pretrained
from kmn_jax.objects import arrays_of, make_part, save_part
from kmn_jax.pose import RansacConfig, ransac
from kmn_jax.released import RELEASED
from kmn_jax.report import print_table, write_json
from kmn_jax.train import split_cpu

_CELLS, _SCAN_EVERY, _SCAN_SEEDS = 1000, 10, 16  # a fleet: robots, seconds a pick, crops of a scan
_OBJECTS = 10_000  # of a catalogue


class Sweep(NamedTuple):
    """Calls of one kind at growing sizes."""

    what: str
    size: str
    compiled: Mapping[int, tuple[Compiled, tuple[Any, ...]]]


class Growth(NamedTuple):
    """Milliseconds = constant + linear * size + square * size^2."""

    constant: float
    linear: float
    square: float

    def at(self, size: float) -> float:
        """Return the milliseconds at a size."""
        return self.constant + self.linear * size + self.square * size * size

    @property
    def bend(self) -> float | None:
        """The size from which on the square is the larger part; None if there is no square."""
        if self.square <= 0:
            return None
        half = self.linear / (2 * self.square)
        return float(half + np.sqrt(half**2 + self.constant / self.square))


def main(repeats: int = 9, json: Path | None = None, picture: Path | None = None) -> None:
    """Run all sweeps.

    Args:
        repeats: timed rounds of each size.
        json: where results go.
        picture: where the plot goes.
    """
    split_cpu(2)
    rows: list[dict[str, Any]] = []
    fits: list[dict[str, Any]] = []
    series: list[tuple[Sweep, list[float], Growth]] = []
    for make in (point_sweep, keypoint_sweep, batch_sweep, hypothesis_sweep, seed_sweep):
        sweep = make()
        times = time_in_turn(
            {str(size): partial(ready.function, *arguments) for size, (ready, arguments) in sweep.compiled.items()},
            repeats,
        )
        ms = [times[str(size)].median_ms for size in sweep.compiled]
        growth = fitted(list(sweep.compiled), ms)
        series.append((sweep, ms, growth))
        for (size, (ready, _)), each in zip(sweep.compiled.items(), ms, strict=True):
            megabytes = ready.temporary_bytes / 1e6
            rows.append({"what": sweep.what, "size": sweep.size, "n": size, "ms": each, "temporary MB": megabytes})
        fits.append(
            {
                "what": sweep.what,
                "size": sweep.size,
                "constant ms": growth.constant,
                "ms for each": growth.linear,
                "ms for its square": growth.square,
                "bend": growth.bend,
            }
        )
    devices = device_rows(repeats)
    objects = catalogue_rows()
    (searches,) = (growth for sweep, _, growth in series if sweep.size == "seeds")
    plan = plan_rows(searches, objects[0])
    print_table("time and temporary memory", rows)
    print_table("fits", fits)
    print_table("training over devices, here parts of one CPU", devices)
    print_table("what an object takes", objects)
    print_table("on paper, from these: what a fleet and a catalogue would need", plan)
    write_json(json, {"rows": rows, "fits": fits, "devices": devices, "objects": objects, "plan": plan})
    if picture is not None:
        picture.write_bytes(_plot(series))


def fitted(sizes: Sequence[int], ms: Sequence[float]) -> Growth:
    """Return the growth that fits best, errors counted as shares of each time."""
    from scipy.optimize import nnls

    n = np.array(sizes, dtype=float)
    columns = np.stack([np.ones_like(n), n, n**2], axis=1) / np.array(ms)[:, None]
    scale = columns.max(axis=0)
    solution, _ = nnls(columns / scale, np.ones(len(n)))
    return Growth(*(float(value) for value in solution / scale))


def point_sweep() -> Sweep:
    """The published network with a cached object, over the points of a crop."""
    case = make_case(1)
    parts = encode_objects(case.model.graphdef, case.parameters, case)
    cases = {n: (case.parameters, case.crops[:, :n], parts) for n in (256, 512, 1024, 2048)}
    return _sweep("network", "points", partial(cached_forward, case.model.graphdef), cases)


def keypoint_sweep() -> Sweep:
    """The pair head over keypoints."""
    case = make_case(1)
    cases = {count: (case.parameters, *head_features(count)) for count in (5, 20, 80, 320)}
    return _sweep("pair head", "keypoints", partial(match, case.model.graphdef), cases)


def batch_sweep() -> Sweep:
    """The published network with a cached object, over crops at once."""
    case = make_case(16)
    parts = encode_objects(case.model.graphdef, case.parameters, case)
    cases = {n: (case.parameters, case.crops[:n], parts[:n]) for n in (1, 2, 4, 8, 16)}
    return _sweep("network", "crops", partial(cached_forward, case.model.graphdef), cases)


def hypothesis_sweep() -> Sweep:
    """RANSAC over hypotheses, each scored against 2048 matches."""
    key = jax.random.key(0)
    matches, _ = synthetic_matches(key)
    compiled = {}
    for count in (125, 500, 2000, 8000):
        config = RansacConfig(num_hypotheses=count, num_candidates=16_384)
        compiled[count] = (compile_for(lambda k, m, c=config: ransac(k, m, c), key, matches), (key, matches))
    return Sweep("RANSAC", "hypotheses", compiled)


def seed_sweep() -> Sweep:
    """Crops of one scan, from points to refined poses, over their number."""
    model, part, cloud = small_crop()
    config = SEARCH.of_network(model.config)

    def poses(parameters: nnx.State, part: Any, cloud: Any, keys: Any) -> Any:
        rows, real = spread_seeds(cloud, cloud.mask, len(keys))

        def one(row: Any, key: Any) -> Any:
            crop = search_crop(cloud, row, part.diameter, key, config)
            return poses_in_crop(model.graphdef, parameters, part, crop, key, config).poses

        return map_real(one, real, rows, keys)

    keys = {count: jax.random.split(jax.random.key(0), count) for count in (1, 4, 16, 64)}
    return _sweep("crops to poses", "seeds", poses, {n: (model.parameters, part, cloud, k) for n, k in keys.items()})


def device_rows(repeats: int) -> list[dict[str, Any]]:
    """Time a training step of `small` on each number of devices."""
    on_cpu = jax.default_backend() == "cpu"
    config = of_batch(find_config("small"), 16, on_cpu)
    counts = [count for count in (1, 2, 4, 8) if count <= len(jax.devices())]
    return [row for count in counts for row in throughput_rows(config, count, repeats)]


def catalogue_rows() -> list[dict[str, Any]]:
    """Measure what one object of a catalogue takes on disk and on the device, and how long it takes to encode."""
    model = load_pretrained()
    found, _ = small_case()
    part = make_part(found, model)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "part.kmn"
        save_part(part, path)
        stored = path.stat().st_size
    held = sum(leaf.nbytes for leaf in jax.tree.leaves(arrays_of(model, part)))
    ms = time_in_turn({"encode": lambda: make_part(found, model)}, 9)["encode"].median_ms
    return [{"network": RELEASED, "card kB": stored / 1e3, "on the device kB": held / 1e3, "encode ms": ms}]


def plan_rows(search: Growth, each: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what a fleet of cells and a catalogue of objects would need of machines like this one.

    Args:
        search: how the time of a scan grows with its seeds.
        each: a row of `catalogue_rows`.
    """
    scan_ms = search.at(_SCAN_SEEDS)
    scans = _CELLS / _SCAN_EVERY
    return [
        {"what": f"a scan, {_SCAN_SEEDS} seeds: ms", "needed": scan_ms},
        {"what": f"{_CELLS} cells, a scan every {_SCAN_EVERY} s: scans a second", "needed": scans},
        {"what": "their searches: machines that do nothing else", "needed": scans * scan_ms / 1e3},
        {"what": f"{_OBJECTS} objects: GB of cards on disk", "needed": _OBJECTS * each["card kB"] / 1e6},
        {"what": "held on the device: MB", "needed": _OBJECTS * each["on the device kB"] / 1e3},
        {"what": "encoding all after the network has changed: minutes", "needed": _OBJECTS * each["encode ms"] / 60e3},
    ]


def _sweep(what: str, size: str, function: Callable[..., Any], cases: Mapping[int, tuple[Any, ...]]) -> Sweep:
    return Sweep(what, size, {n: (compile_for(function, *arguments), arguments) for n, arguments in cases.items()})


def _plot(series: Sequence[tuple[Sweep, list[float], Growth]]) -> bytes:
    figure, canvas = new_figure((3.2 * len(series), 3.4))
    for axes, (sweep, ms, growth) in zip(figure.subplots(1, len(series)), series, strict=True):
        sizes = list(sweep.compiled)
        places: Float[np.ndarray, " p"] = np.geomspace(sizes[0], sizes[-1], 50)
        axes.loglog(sizes, ms, "o", ms=5, color="C0")
        axes.loglog(places, [growth.at(place) for place in places], lw=1.2, color="C0")
        memory = [ready.temporary_bytes / 1e6 for ready, _ in sweep.compiled.values()]
        axes.loglog(sizes, memory, "s:", ms=4, lw=1, color="C1")
        axes.set_title(sweep.what, fontsize=10)
        axes.set_xlabel(sweep.size)
        axes.minorticks_off()
        axes.set_xticks(sizes, [str(size) for size in sizes])
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("ms (blue), temporary MB (orange)")
    return as_png(canvas)


if __name__ == "__main__":
    run(main)
