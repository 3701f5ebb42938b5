"""How two evaluations of the same crops differ: `python -m experiments.compare_runs BEFORE AFTER --dataset FOLDER`.

Both are folders that `experiments.evaluate` wrote, such as of two states of the code. Recall is compared crop by crop;
intervals come from drawing whole scans again, as crops of one scan are not independent.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from jaxtyping import Float, Int

from experiments.evaluation.predictions import Export
from experiments.evaluation.scores import THRESHOLD, cells_of, pooled
from experiments.evaluation.sources import bop_objects
from experiments.made_data import require_made
from kmn_jax.errors import InputError
from kmn_jax.report import print_table, write_json

_DRAWS = 2000


@dataclass(frozen=True)
class Options:
    """What to compare."""

    before: Annotated[Path, tyro.conf.Positional]
    after: Annotated[Path, tyro.conf.Positional]
    dataset: Path  # in BOP format, of the objects of both
    methods: tuple[str, ...] = ("ours",)  # that both have
    noises: tuple[float, ...] = (0.0, 0.01, 0.05)
    split: str = "test"
    json: Path | None = None


def compare(options: Options) -> list[dict[str, Any]]:
    """Return a row for each method and noise. Raises InputError if the crops of both are not the same."""
    require_made(options.dataset)
    models = {found.name: found.model for found in bop_objects(options.dataset, options.split, print)}
    titles = {name: name for name in options.methods}
    folders = [_opened(folder, options.noises) for folder in (options.before, options.after)]
    before, after = (cells_of(folder, models, titles, options.noises) for folder in folders)
    _check_crops(folders, list(models), options.noises)
    rows = []
    for method in dict.fromkeys(cell.method for cell in before):
        for noise in options.noises:
            one, other = (
                pooled([cell for cell in cells if (cell.method, cell.noise) == (method, noise)], "all objects")
                for cells in (before, after)
            )
            right, now = one.errors < THRESHOLD, other.errors < THRESHOLD
            low, high = _interval(now.astype(float) - right, one.scenes)
            rows.append(
                {
                    "method": method,
                    "noise": noise,
                    "crops": len(right),
                    "recall before": float(right.mean()),
                    "recall after": float(now.mean()),
                    "difference": float(now.mean() - right.mean()),
                    "95% interval": f"{low:+.3f} to {high:+.3f}",
                }
            )
    return rows


def _opened(folder: Path, noises: tuple[float, ...]) -> Export:
    """Return a folder of an evaluation. Raises InputError if it is none, or without crops of a noise."""
    try:
        found = Export(folder, json.loads((folder / "recipe.json").read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise InputError(f"{folder} is no folder of an evaluation ({error}): name one that evaluate wrote") from None
    lacking = [f"{noise:g}" for noise in noises if not any(folder.glob(f"*/*.noise{noise:g}.safetensors"))]
    if lacking:
        raise InputError(f"{folder} has no crops with a noise of {', '.join(lacking)}: name what it has by --noises")
    return found


def _check_crops(folders: list[Export], objects: list[str], noises: tuple[float, ...]) -> None:
    """Raise InputError if the crops of both folders are not the same."""
    for name, noise in ((name, noise) for name in objects for noise in noises):
        names, others = (folder.truth(name, noise).names for folder in folders)
        if names != others:
            raise InputError(
                f"the crops of {name} at noise {noise:g} are not the same: evaluate the same dataset twice"
            )


def _interval(difference: Float[np.ndarray, " c"], scan: np.ndarray) -> tuple[float, float]:
    """Return the middle 95% of the mean difference over scans drawn again."""
    _, which = np.unique(scan, return_inverse=True)
    return interval_over_scans(np.bincount(which, difference), np.bincount(which))


def interval_over_scans(sums: Float[np.ndarray, " s"], counts: Int[np.ndarray, " s"]) -> tuple[float, float]:
    """Return the middle 95% of a mean over scans drawn again, given the sum and the number of values in each scan.

    Scans may have none; so may, if they are few, all that are drawn, whose mean is then zero.
    """
    rows = np.random.default_rng(0).integers(0, len(counts), (_DRAWS, len(counts)))
    low, high = np.percentile(sums[rows].sum(axis=1) / np.maximum(counts[rows].sum(axis=1), 1), [2.5, 97.5])
    return float(low), float(high)


def main(arguments: list[str] | None = None) -> int:
    """Compare: 0 is success, 2 bad input, in one sentence on stderr."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        rows = compare(options)
    except InputError as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 2
    print_table("Recall of the same crops", rows)
    write_json(options.json, {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
