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
from experiments.evaluation.methods import ONE_RANSAC, Ours
from kmn_jax.detection import CropSearchConfig
from kmn_jax.models import Model

_PLAIN = CropSearchConfig()


def _matches(**changed: Any) -> CropSearchConfig:
    return replace(_PLAIN, matches=replace(_PLAIN.matches, **changed))


def _ransac(**changed: Any) -> CropSearchConfig:
    return replace(_PLAIN, ransac=replace(_PLAIN.ransac, **changed))


KEYPOINTS = {"20 keypoints": 20, "40 keypoints": 40, "128 keypoints": 128}
VARIANTS = {
    "vote threshold 0.5": _matches(vote_threshold=0.5),
    "vote threshold 0.9": _matches(vote_threshold=0.9),
    "softmax over points": _matches(softmax="points"),
    "no normal check": _ransac(use_normals=False),
    "normals within 30 degrees": _ransac(normal_gate_degrees=30.0),
    "normals within 45 degrees": _ransac(normal_gate_degrees=45.0),
    "100 hypotheses": _ransac(num_hypotheses=100),
    "2000 hypotheses": _ransac(num_hypotheses=2000),
    "gate 0.1": _ransac(distance_gate=0.1),
    "256 points": replace(_PLAIN, num_points=256),
    "512 points": replace(_PLAIN, num_points=512),
    "one draw": replace(_PLAIN, num_draws=1),
    "two draws": replace(_PLAIN, num_draws=2),
    "four draws in any case": replace(_PLAIN, enough=None),
    "enough at 1": replace(_PLAIN, enough=1.0),
    "one pose a draw": replace(_PLAIN, num_modes=1),
    "eight poses a draw": replace(_PLAIN, num_modes=8),
    "no smoothing": replace(_PLAIN, smooth=None),
    "no ICP": replace(_PLAIN, icp=None),
}


# One pose of one RANSAC, as published, which had 20 keypoints and normals within 30 degrees.
_PUBLISHED_GATE = replace(ONE_RANSAC, ransac=replace(ONE_RANSAC.ransac, normal_gate_degrees=30.0))
SINGLE = {
    "one RANSAC": (ONE_RANSAC, None),
    "one RANSAC, 20 keypoints": (ONE_RANSAC, 20),
    "one RANSAC, normals within 30 degrees": (_PUBLISHED_GATE, None),
    "one RANSAC, 20 keypoints, normals within 30 degrees": (_PUBLISHED_GATE, 20),
    "one RANSAC, 512 points": (replace(ONE_RANSAC, num_points=512), None),
    "one RANSAC, vote threshold 0.5": (
        replace(ONE_RANSAC, matches=replace(ONE_RANSAC.matches, vote_threshold=0.5)),
        None,
    ),
}


def methods_of(model: Model) -> dict[str, Method]:
    """Return our pipeline as it is, with one choice changed each, and what it is built on, the published search."""
    fewer = {name: Ours(name, model, num_keypoints=count) for name, count in KEYPOINTS.items()}
    other = {name: Ours(name, model, config) for name, config in VARIANTS.items()}
    single = {name: Ours(name, model, config, num_keypoints=count) for name, (config, count) in SINGLE.items()}
    changed = {name.replace(",", "").replace(" ", "_"): method for name, method in (fewer | other | single).items()}
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
