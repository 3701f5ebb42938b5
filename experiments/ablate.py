"""What each choice of our pipeline is worth: `python -m experiments.ablate NAME`, a name of `experiments.evaluate`.

One choice at a time is changed; recall and time as in an evaluation, under outputs/ablation/NAME. Not among them:
input normalisation ("released" against "metric"), which a network is trained with: configs/normalization.py.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.evaluate import Options, compare, released_or_own, run
from experiments.evaluation.cases import Method
from experiments.evaluation.methods import Ours, OursConfig
from kmn_jax.detection import CropPoseConfig
from kmn_jax.models import Model

_PLAIN = CropPoseConfig()


def _pose(**changed: Any) -> OursConfig:
    return OursConfig(replace(_PLAIN, **changed))


def _matches(**changed: Any) -> OursConfig:
    return _pose(matches=replace(_PLAIN.matches, **changed))


def _ransac(**changed: Any) -> OursConfig:
    return _pose(ransac=replace(_PLAIN.ransac, **changed))


VARIANTS = {
    "10 keypoints": OursConfig(num_keypoints=10),
    "40 keypoints": OursConfig(num_keypoints=40),
    "vote threshold 0.5": _matches(vote_threshold=0.5),
    "vote threshold 0.9": _matches(vote_threshold=0.9),
    "softmax over points": _matches(softmax="points"),
    "no normal check": _ransac(use_normals=False),
    "100 hypotheses": _ransac(num_hypotheses=100),
    "2000 hypotheses": _ransac(num_hypotheses=2000),
    "gate 0.1": _ransac(distance_gate=0.1),
    "256 points": OursConfig(num_points=256),
    "1024 points": OursConfig(num_points=1024),
    "one draw": _pose(num_draws=1),
    "two draws": _pose(num_draws=2),
    "four draws in any case": _pose(enough=None),
    "enough at 1": _pose(enough=1.0),
    "one pose a draw": _pose(num_modes=1),
    "eight poses a draw": _pose(num_modes=8),
    "no smoothing": _pose(smooth=None),
}


def methods_of(model: Model) -> dict[str, Method]:
    """Return our pipeline as it is, and with one choice changed each."""
    changed = {name.replace(" ", "_"): Ours(name, model, config) for name, config in VARIANTS.items()}
    return {"ours": Ours("kmn_jax", model), **changed}


def ablate(options: Options) -> Path:
    """Compare all variants and return the path of the report's page."""
    folder = options.output or Path("outputs") / "ablation" / options.config.name
    model = released_or_own(options.config.weights)
    return compare(replace(options, output=folder), model, methods_of(model), {})


def main(arguments: list[str] | None = None) -> int:
    """Ablate: 0 is success, 2 bad input, in one sentence on stderr."""
    return run("ablate", __doc__ or "", ablate, arguments)


if __name__ == "__main__":
    sys.exit(main())
