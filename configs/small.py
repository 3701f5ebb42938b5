"""A network that a robot's CPU runs in real time: 512 points, half the widths and less, one neighbour graph.

small
    Command:   python -m experiments.train small
    Hardware:  2 CPU cores: 61 samples/s, of which making the samples takes 15%; half as many beside other work.
    Expected:  after 560,000 samples, 5.2 h (partly beside other work): validation loss 1.726, segmentation accuracy
               0.977, keypoint accuracy 0.236; see kmn_jax/pretrained/small.md. Up to step 13,461 all seeds were drawn
               by area, two crops a scene; up to step 32,000 three in ten examples had random keypoints; and the
               schedule was changed four times on the way.

worlds
    Command:   python -m experiments.build_data electronics --folder outputs/packs/surfels --pack.drops 0
               python -m experiments.train worlds --num-steps 8000 --max-minutes 78
    Hardware:  2 CPU cores: 23 samples/s, of which an unknown part went to other work; 27 minutes for the pack.
    Expected:  `small` before it: validation loss 1.730 (of few samples), segmentation accuracy 0.942, keypoint accuracy
               0.189, in worlds of the validation objects. After 96,000 samples: 1.630, 0.954, 0.230; after 64,000 more
               by the command with --warm-start, as below: 1.627, 0.954, 0.231, falling slowly. Not released: neither
               recall nor probabilities were measured with it. Its weights, to go on from:
               --warm-start experiments/assets/worlds.safetensors
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
        dropout=0.0,
        inputs="invariant",
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
    warm_start="small",
    num_steps=9_000,
    examples=replace(
        small.examples,
        worlds=WorldConfig(),
        crops=replace(small.examples.crops, other_seeds=0.12, faults=FaultConfig(), smooth=SmoothConfig()),
    ),
    optimizer=replace(small.optimizer, learning_rate=1e-2),
)

chiral = replace(
    worlds,
    name="chiral",
    network=replace(small.network, inputs="chiral", num_keypoints=64),
    warm_start="experiments/assets/worlds.safetensors",
    num_steps=13_000,
    optimizer=replace(worlds.optimizer, learning_rate=2e-2),
)
