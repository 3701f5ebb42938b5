"""A network that a robot's CPU runs in real time: 512 points, half the widths and less, one neighbour graph.

small
    Command:   python -m experiments.train small
    Hardware:  2 CPU cores: 61 samples/s with 20 keypoints, of which making the samples takes 15%; half as many beside
               other work.
    Expected:  not run with chiral inputs and 64 keypoints. With "invariant" ones and 20 (up to commit 12bc851), after
               560,000 samples, 5.2 h: validation loss 1.726, segmentation accuracy 0.977, keypoint accuracy 0.236.

worlds
    Command:   python -m experiments.build_data surfels
               python -m experiments.train worlds --warm-start FILE
    Hardware:  2 CPU cores: 15 minutes for the pack; 55 to 60 samples/s, half as many beside other work.
    Expected:  after 168,000 samples, 0.9 h beside other work: validation loss 2.149, segmentation accuracy 0.956,
               keypoint accuracy 0.152 of 64. These weights, `experiments/assets/small.safetensors`, were released
               before those of `wide_long`; without --warm-start it goes on from them. FILE were those of 160,000
               samples in worlds of components, with invariant inputs and 20 keypoints (1.627 and 0.231 of 20;
               `experiments/assets/worlds.safetensors` at commit a4dca0e, where the run was called `chiral`), which had
               begun with the 560,000 above.

worlds_long
    With 1,024 points, as a search draws around places that are given.
    Command:   python -m experiments.train worlds_long
    Hardware:  one H200, 11 minutes beside other runs, 3 of them until the first step; 5,600 samples/s in the median,
               7,000 at best.
    Expected:  after 1,792,000 samples: validation loss 2.044, segmentation accuracy 0.957, keypoint accuracy 0.168 of
               64; docs/training.md says why they were not released.
"""

from __future__ import annotations

from dataclasses import replace

from kmn_jax.data import CropConfig, PipelineConfig
from kmn_jax.geometry import SmoothConfig
from kmn_jax.models import KeyMatchNetConfig
from kmn_jax.simulate import FaultConfig, WorldConfig
from kmn_jax.train import ExampleConfig, OptimizerConfig, TrainConfig

small = TrainConfig(
    name="small",
    pack="outputs/packs/electronics",
    num_steps=36_000,
    network=KeyMatchNetConfig(
        num_scene_points=512,
        num_object_points=512,
        num_neighbors=12,
        edge_width=32,
        embedding_width=512,
        scene_width=256,
        object_width=64,
        pair_width=128,
        groups=16,
        num_keypoints=64,
        dropout=0.0,
        inputs="chiral",
        graph="static",
    ),
    examples=ExampleConfig(
        crops=CropConfig(num_points=512, instance_seeds=0.5), crops_per_scene=4, random_keypoints=0.0
    ),
    optimizer=OptimizerConfig(
        method="muon",
        schedule="cosine",
        learning_rate=3e-2,
        least_rate=1e-4,
        warmup_steps=200,
        weight_decay=0.0,
        clip_norm=1.0,
    ),
    pipeline=PipelineConfig(batch_size=16, crops_per_object=4),
    crops_at_once=1,
    average_decay=0.998,
    validate_every=1_000,
    validation_samples=20,
    checkpoint_every=200,
    log_every=50,
)

worlds = replace(
    small,
    name="worlds",
    pack="outputs/packs/surfels",
    warm_start="experiments/assets/small.safetensors",
    num_steps=10_500,
    examples=replace(
        small.examples,
        worlds=WorldConfig(),
        crops=replace(small.examples.crops, other_seeds=0.12, faults=FaultConfig(), smooth=SmoothConfig()),
    ),
    optimizer=replace(small.optimizer, learning_rate=2e-2),
)

worlds_long = replace(
    worlds,
    name="worlds_long",
    num_steps=14_000,
    network=replace(worlds.network, num_scene_points=1_024),
    examples=replace(worlds.examples, crops=replace(worlds.examples.crops, num_points=1_024)),
    pipeline=replace(worlds.pipeline, batch_size=128),
    crops_at_once=None,
    validate_every=2_000,
    checkpoint_every=1_000,
)
