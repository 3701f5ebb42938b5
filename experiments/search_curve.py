"""How many copies are found in how much time, by how thoroughly is searched: `python -m experiments.search_curve`.

Each image of the world bins for validation is searched with all settings in turn, so that they are compared on the same
images and in the same minutes; the first one twice, as most is compiled with it. Settings differ from what users get in
what their names say. Copies are counted as by `experiments.detect_worlds`, by probabilities that are fitted to these
bins as they are searched for users: other settings may find more than they are given credit for. Ctrl+C ends it with
the images so far.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tqdm import tqdm

from experiments.bins import WorldImage, world_images
from experiments.calibrate import SHIPPED
from experiments.compare_runs import interval_over_scans
from experiments.detect_bins import PRECISION, Tally
from experiments.detect_worlds import found_in
from experiments.evaluation.plots import as_png, new_figure
from kmn_jax.detection import EVIDENCE, FAST, THOROUGH, DetectConfig, Probabilities, load_probabilities
from kmn_jax.errors import InputError
from kmn_jax.files import write_whole
from kmn_jax.models import Model, load_pretrained
from kmn_jax.report import check_target, print_table, write_json

PLAIN = "as it is"


def _with_crops(config: DetectConfig, **changes: Any) -> DetectConfig:
    return replace(config, search=replace(config.search, crops=replace(config.search.crops, **changes)))


_USUAL = DetectConfig()
SETTINGS = {
    "fast": FAST,
    "fast, patience 4": replace(FAST, patience=4),
    "fast, all finely": replace(FAST, patience=None),
    PLAIN: _USUAL,
    "best alone": replace(_USUAL, next_best=0, sure=0.0),
    "patience 2": replace(_USUAL, patience=2),
    "goes on from 0.5": replace(_USUAL, promising=0.5),
    "goes on from 0.2": replace(_USUAL, promising=0.2),
    "four draws": _with_crops(_USUAL, num_draws=4),
    "1,024 points a draw": _with_crops(_USUAL, num_points=1024),
    "thorough": THOROUGH,
    "thorough, 2,048 points a draw": _with_crops(THOROUGH, num_points=2048),
    "thorough, eight draws": _with_crops(THOROUGH, num_draws=8),
}


@dataclass(frozen=True)
class Options:
    """What to search."""

    folder: Path = Path("outputs/worlds/validation")
    calibration: Path = SHIPPED
    settings: tuple[str, ...] = tuple(SETTINGS)
    every: int = 5  # use every so many images
    json: Path | None = None
    picture: Path | None = None  # .png file


def run(options: Options) -> list[dict[str, Any]]:
    """Search, print and return a row for each setting."""
    check_target(options.json, options.picture)
    unknown = [name for name in options.settings if name not in SETTINGS]
    if unknown or PLAIN not in options.settings:
        wrong = (
            f"no settings are called {unknown[0]!r}"
            if unknown
            else f"{PLAIN!r}, which others are compared with, is missing"
        )
        raise InputError(f"{wrong}: choose among {', '.join(SETTINGS)}")
    model = load_pretrained()
    probabilities = load_probabilities(options.calibration, EVIDENCE)
    searched: list[dict[str, Tally]] = []
    with suppress(KeyboardInterrupt):
        for image in tqdm(world_images(options.folder, model, options.every), unit="image"):
            if not searched:
                for name in options.settings:
                    _searched(model, probabilities, image, name)  # compiles
            first = len(searched) % len(options.settings)  # which is not always the same: it warms the caches
            order = options.settings[first:] + options.settings[:first]
            searched.append({name: _searched(model, probabilities, image, name) for name in order})
    if not searched:
        raise InputError(f"no image of {options.folder} was searched: it holds none, or Ctrl+C came too soon")
    rows = [_row(name, searched) for name in options.settings]
    print_table("Copies found, and time", rows)
    write_json(options.json, {"settings": rows})
    if options.picture is not None:
        write_whole(options.picture, curve(rows))
    return rows


def _searched(model: Model, probabilities: Probabilities, image: WorldImage, name: str) -> Tally:
    _, found = found_in(model, probabilities, image.part, image.scan, SETTINGS[name])
    return Tally.of(image, found)


def _row(name: str, searched: Sequence[dict[str, Tally]]) -> dict[str, Any]:
    """Return the numbers of a setting, beside the search as it is in the same images.

    Times are those of searching, which begins where the scan is read and the part is prepared.
    """
    together = Tally()
    for image in searched:
        together.extend(image[name])
    counted = together.row(name, name, _USUAL.accepted)
    names = ("images", "copies", "recall", f"recall at precision {PRECISION}", "precision")
    row = {"search": name} | {key: counted[key] for key in names}
    found, plain = (np.array([image[one].num_found(_USUAL.accepted) for image in searched]) for one in (name, PLAIN))
    low, high = interval_over_scans((found - plain).astype(float), np.array([image[name].copies for image in searched]))
    row["difference of recall, 95%"] = f"{low:+.3f} to {high:+.3f}"
    took = np.array([[image[name].seconds[0], image[PLAIN].seconds[0]] for image in searched])
    took = took[(took > 0).all(axis=1)]  # scans that are refused take none
    if not len(took):
        return row | {"median s": None, "90% s": None, "times as long": None}
    times = {"median s": np.median(took[:, 0]), "90% s": np.percentile(took[:, 0], 90)}
    times["times as long"] = np.median(took[:, 0] / took[:, 1])
    return row | {key: float(value) for key, value in times.items()}


def curve(rows: Sequence[dict[str, Any]]) -> bytes:
    """Return a picture of recall over time."""
    figure, canvas = new_figure((6.5, 4))
    axis = figure.add_subplot()
    for row in (row for row in rows if row["median s"] is not None):
        place = (row["median s"], row["recall"])
        axis.scatter(*place, marker="*" if row["search"] == PLAIN else "o", label=row["search"])
    axis.set(xlabel="seconds of searching (median)", ylabel=f"recall from {_USUAL.accepted} on")
    axis.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize="small")
    return as_png(canvas)


if __name__ == "__main__":
    try:
        run(tyro.cli(Options))
    except InputError as problem:
        sys.exit(f"error: {problem}")
