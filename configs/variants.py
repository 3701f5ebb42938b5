"""Networks beside `small`; of each kind of variants all are trained alike: from random parameters, in worlds.

variant_reference is `small` itself; every other one differs from it by what its name says.

variant_...
    Command:   python -m experiments.train variant_reference, and the same with the other names
    Hardware:  one H200, several side by side: 1,800 to 8,900 samples/s each; up to three minutes until the first
               step, of seven runs at once nearly seven.
    Expected:  after 128,000 samples validation losses of 2.32 (reference), 2.31 (points_1024), 2.21 (wide), 2.42
               (dynamic) and 2.33 (invariant). In a pack that was built in part, of 1,267 objects for training, 2.35
               (reference), 2.27 (neighbors_20), 2.50 (narrow), and of 20 keypoints 1.77 (keypoints_20); in training
               2.43 (reference) and, of as many keypoints, 2.82 (keypoints_128) and 3.61 (keypoints_512).
               docs/training.md has recalls.

few_...
    With a coarse level of 64 points, with attention as well, and with labels that are spread by 0.07 crop radii.
    Command:   python -m experiments.train few_reference, and the same with the other names
    Hardware:  one core of two of an AMD EPYC, beside another of these runs: 22 to 24 samples/s, 25 to 28 minutes.
    Expected:  after 32,000 samples validation losses of 2.50 (reference), 2.56 (spread), 2.45 (coarse) and 2.46
               (attention); docs/training.md has recalls.

wide_long, dynamic_long
    The two that found more, trained for long: wide_long from random parameters, dynamic_long from those of `small`, as
    its parameters have the same shapes.
    Command:   python -m experiments.train wide_long, and the same with the other name
    Hardware:  one H200: wide_long alone 9 minutes, 3 of them until the first step, at 5,800 samples/s in the median;
               dynamic_long, beside two other runs, 11 minutes at 4,200.
    Expected:  wide_long: validation loss 1.874, segmentation accuracy 0.969, keypoint accuracy 0.201 of 64;
               dynamic_long: 2.163, 0.960, 0.144; docs/training.md has the recalls.

wide_longer
    Goes on from the weights of wide_long, and is released as `wide`.
    Command:   python -m experiments.train wide_long
               python -m experiments.train wide_longer
    Hardware:  one H200 alone, 9 minutes, 2.5 of them until the first step, at 6,100 samples/s in the median.
    Expected:  after 2,176,000 samples: validation loss 1.802, segmentation accuracy 0.970, keypoint accuracy 0.217.
"""

from __future__ import annotations

from dataclasses import replace

from configs.small import worlds
from kmn_jax.models import KeyMatchNetConfig
from kmn_jax.train import TrainConfig


def _variant(name: str, **changes: object) -> TrainConfig:
    network: KeyMatchNetConfig = replace(worlds.network, **changes)  # type: ignore[arg-type]
    crops = replace(worlds.examples.crops, num_points=network.num_scene_points)
    return replace(
        worlds,
        name=f"variant_{name}",
        warm_start=None,
        num_steps=1_000,
        network=network,
        examples=replace(worlds.examples, crops=crops),
        optimizer=replace(worlds.optimizer, learning_rate=3e-2, warmup_steps=100),
        pipeline=replace(worlds.pipeline, batch_size=128),
        crops_at_once=None,
        average_decay=0.99,
        checkpoint_every=1_000,
    )


_WIDE = _variant("wide", edge_width=64, embedding_width=1_024, scene_width=512, object_width=128, pair_width=256)
_DYNAMIC = _variant("dynamic", graph="dynamic")

VARIANTS = (
    _variant("reference"),
    _variant("points_1024", num_scene_points=1_024),
    _WIDE,
    _DYNAMIC,
    _variant("keypoints_20", num_keypoints=20),
    _variant("keypoints_128", num_keypoints=128),
    _variant("keypoints_512", num_keypoints=512),
    _variant("neighbors_20", num_neighbors=20),
    _variant("invariant", inputs="invariant"),
    _variant("narrow", edge_width=16, embedding_width=256, scene_width=128, object_width=32, pair_width=64),
)


def _few(name: str, **changes: object) -> TrainConfig:
    few = replace(_variant(name, **changes), name=f"few_{name}", num_steps=2_000, crops_at_once=1, average_decay=0.998)
    return replace(few, pipeline=replace(few.pipeline, batch_size=16))


_FEW = _few("reference")

FEW = (
    _FEW,
    replace(_FEW, name="few_spread", loss=replace(_FEW.loss, keypoint_spread=0.07)),
    _few("coarse", num_coarse_points=64),
    _few("attention", num_coarse_points=64, attention="both"),
)


def _long(of: TrainConfig, name: str) -> TrainConfig:
    return replace(
        of,
        name=name,
        num_steps=12_000,
        optimizer=replace(of.optimizer, warmup_steps=200),
        average_decay=0.998,
        validate_every=1_500,
    )


LONG = (
    _long(_WIDE, "wide_long"),
    replace(_long(_DYNAMIC, "dynamic_long"), warm_start="experiments/assets/small.safetensors"),
    replace(
        _long(_WIDE, "wide_longer"),
        warm_start="runs/wide_long/model.safetensors",
        num_steps=17_000,
        validate_every=4_000,
        checkpoint_every=2_000,
    ),
)
