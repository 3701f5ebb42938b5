"""The rivals as they are compared: what found most poses after ICP on validation bins, see `experiments.tune_rivals`.

The reports of the choice are in experiments/results/tuning.

Apart from `rivals`, so that a setting that changes makes the poses of its own method stale and no others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from experiments.evaluation.best_of import BestOf
from experiments.evaluation.rivals import FastGlobal, FeatureSettings, Fpfh, Kiss, PointPairs, missing

_FPFH = Fpfh(features=FeatureSettings(voxel=0.05))
_PPF = PointPairs(scene_share=0.05, features=FeatureSettings(voxel=0.1, smooth=True))

# By the names of the methods: the package that is needed, and what makes the rival.
RIVALS: Mapping[str, tuple[str, Callable[[], Any]]] = {
    "fpfh": ("open3d", lambda: _FPFH),
    "fpfh_best": ("open3d", lambda: BestOf("FPFH + RANSAC, best of 4", _FPFH, 4)),
    "fgr": (
        "open3d",
        lambda: FastGlobal(features=FeatureSettings(voxel=0.02), gate=0.05, tuples=3000, tuple_scale=0.9),
    ),
    "ppf": ("cv2.ppf_match_3d", lambda: _PPF),
    "ppf_best": ("cv2.ppf_match_3d", lambda: BestOf("PPF, best of 16", _PPF, 16)),
    "kiss": ("kiss_matcher", lambda: Kiss(voxel=0.015, features=FeatureSettings(voxel=0.01, smooth=True))),
}


def without_package(names: Sequence[str]) -> dict[str, str]:
    """Return why methods cannot run, of those whose package cannot be used."""
    needed = {name: RIVALS[name][0] for name in names if name in RIVALS}
    needed |= {name: "open3d" for name in names if name == "ours_open3d"}
    return {name: reason for name, module in needed.items() if (reason := missing(module)) is not None}
