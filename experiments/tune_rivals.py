"""Settings of the rivals side by side, to choose from: `python -m experiments.tune_rivals validation`.

On validation bins, never on test sets. Recall and time as in an evaluation, under outputs/tuning/NAME.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.evaluate import Options, compare, released_or_own, run
from experiments.evaluation.methods import Method
from experiments.evaluation.rivals import FastGlobal, FeatureSettings, Fpfh, Kiss, PointPairs, missing
from experiments.evaluation.tuned import RIVALS

# Of each rival, voxels without smoothing and with it; finer where the coarse end of a first look was the worse one.
_VOXELS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "fpfh": ((0.03, 0.04, 0.05, 0.065), (0.03, 0.04, 0.05, 0.065)),
    "fgr": ((0.015, 0.02, 0.025, 0.03), (0.025,)),
    "kiss": ((0.015, 0.025), (0.01, 0.015, 0.02)),
}
_PAIRS = tuple((sampling, share) for sampling in (0.1, 0.07) for share in (0.2, 0.05))  # of PPF


def methods_of(name: str) -> dict[str, Method]:
    """Return a rival with each of the settings."""
    methods: list[Any] = []
    for smooth in (False, True):
        of_smooth = ", smoothed" if smooth else ""
        if name == "ppf":
            features = replace(PointPairs().features, smooth=smooth)
            methods += [
                PointPairs(f"PPF {sampling:g} {share:g}{of_smooth}", sampling, share, features)
                for sampling, share in _PAIRS
            ]
            continue
        for voxel in _VOXELS[name][smooth]:
            title = f"{name} {voxel:g}{of_smooth}"
            features = FeatureSettings(voxel=voxel, smooth=smooth)
            if name == "kiss":
                finer = replace(features, voxel=voxel / 1.5) if smooth else None
                methods.append(Kiss(title, voxel, finer))
            else:
                methods.append((Fpfh if name == "fpfh" else FastGlobal)(title, features))
    return {method.name.replace(" ", "_").replace(",", ""): method for method in methods}


def tune(options: Options) -> Path:
    """Compare all settings of the rivals that are among the config's methods; return the path of the report's page."""
    names = [name for name in options.config.methods if name in RIVALS]
    skipped = {name: reason for name in names if (reason := missing(RIVALS[name][0])) is not None}
    methods = {key: method for name in names if name not in skipped for key, method in methods_of(name).items()}
    folder = options.output or Path("outputs") / "tuning" / options.config.name
    return compare(replace(options, output=folder), released_or_own(options.config.weights), methods, skipped)


def main(arguments: list[str] | None = None) -> int:
    """Tune: 0 is success, 2 bad input, in one sentence on stderr."""
    return run("tune_rivals", __doc__ or "", tune, arguments)


if __name__ == "__main__":
    sys.exit(main())
