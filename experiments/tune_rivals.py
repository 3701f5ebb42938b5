"""Settings of the rivals side by side, to choose from: `python -m experiments.tune_rivals validation`.

On validation bins, never on test sets. Recall and time as in an evaluation, under outputs/tuning/NAME.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from experiments.evaluate import Options, compare, released_or_own, run
from experiments.evaluation.cases import Method
from experiments.evaluation.methods import ONE_RANSAC, Ours
from experiments.evaluation.rivals import FastGlobal, FeatureSettings, Fpfh, Kiss, OverMatches, PointPairs
from experiments.evaluation.tuned import without_package
from kmn_jax.errors import InputError
from kmn_jax.models import Model

# Voxels without smoothing and with it; finer where the coarse end of a first look was the worse one.
_VOXELS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "fpfh": ((0.03, 0.04, 0.05, 0.065), (0.03, 0.04, 0.05, 0.065)),
    "kiss": ((0.015, 0.025), (0.01, 0.015, 0.02)),
}
_TUPLES = ((0.025, 1000, 0.95), (0.05, 3000, 0.9))  # of FGR: gate, tuples, their scale; the first are its authors'
_PAIRS = ((0.1, 0.05, 0.05), (0.07, 0.05, 0.05), (0.07, 0.1, 0.05))  # of PPF: model, scene, share of reference points
_GATES = (0.06, 0.1, 0.15)  # of Open3D's RANSAC over our matches; the first is the published one
_SMOOTHED = ("", ", smoothed")  # in titles


def methods_of(name: str, model: Model) -> dict[str, Method]:
    """Return a rival with each of the settings."""
    methods: Iterable[Method]
    if name == "ours_open3d":
        one = ONE_RANSAC
        methods = [Ours(f"Open3D RANSAC {gate:g}", model, one, search=OverMatches(gate=gate)) for gate in _GATES]
    elif name == "ppf":
        methods = [_point_pairs(*setting, smooth) for smooth in (False, True) for setting in _PAIRS]
    elif name == "fgr":
        methods = _fast_global()
    else:
        methods = [_of_voxel(name, voxel, smooth) for smooth in (False, True) for voxel in _VOXELS[name][smooth]]
    return {method.name.replace(" ", "_").replace(",", ""): method for method in methods}


def _point_pairs(sampling: float, voxel: float, share: float, smooth: bool) -> PointPairs:
    title = f"PPF {sampling:g} {voxel:g} {share:g}{_SMOOTHED[smooth]}"
    return PointPairs(title, sampling, share, FeatureSettings(voxel=voxel, smooth=smooth))


def _fast_global() -> Iterator[FastGlobal]:
    features = [FeatureSettings(voxel=voxel) for voxel in (0.02, 0.03)]
    for own in features:
        for gate, tuples, scale in _TUPLES:
            yield FastGlobal(f"FGR {own.voxel:g} {gate:g} {tuples}", own, True, gate, tuples, scale)
    yield FastGlobal("FGR 0.02, gate fixed", features[0], decrease_mu=False)


def _of_voxel(name: str, voxel: float, smooth: bool) -> Fpfh | Kiss:
    title, features = f"{name} {voxel:g}{_SMOOTHED[smooth]}", FeatureSettings(voxel=voxel, smooth=smooth)
    if name == "fpfh":
        return Fpfh(title, features)
    return Kiss(title, voxel, replace(features, voxel=voxel / 1.5) if smooth else None)


def tune(options: Options) -> Path:
    """Compare all settings of the rivals that are among the config's methods; return the path of the report's page."""
    model = released_or_own(options.config.weights)
    there = (*_VOXELS, "fgr", "ppf", "ours_open3d")  # the best of several poses are those of what is tuned
    names = [name for name in options.config.methods if name in there]
    skipped = without_package(names)
    methods = {key: method for name in names if name not in skipped for key, method in methods_of(name, model).items()}
    if "ours" in options.config.methods:  # beside them
        methods["ours"] = Ours("kmn_jax", model)
    if not methods:
        there_are = f"none of them can run: {skipped}" if skipped else f"there are {', '.join(there)}"
        raise InputError(f"no rival to tune among {', '.join(options.config.methods)}: {there_are}")
    folder = options.output or Path("outputs") / "tuning" / options.config.name
    return compare(replace(options, output=folder), model, methods, skipped)


def main(arguments: list[str] | None = None) -> int:
    """Tune: 0 is success, 2 bad input, in one sentence on stderr."""
    return run("tune_rivals", __doc__ or "", tune, arguments)


if __name__ == "__main__":
    sys.exit(main())
