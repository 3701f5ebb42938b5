"""The published network with our recipe.

Both clouds are divided by one length, inputs are rotation-invariant, crops of an object share its encoding, one dropout
mask serves all keypoints; Muon with warm-up and cosine, bfloat16 layers, and the running mean of the parameters.

base
    Command:   python -m experiments.train base
    Hardware:  one GPU of 80 GB or more. Not yet run; on a single one with --crops-at-once 64, see base_worlds.
    Expected:  not yet known.

base_worlds
    Beside the variants of `configs/variants.py`, with as many samples: what a lease of a GPU has time for.
    Command:   python -m experiments.train base_worlds
    Hardware:  one H200, 7 minutes, 3.5 of them until the first steps: 1,170 samples/s, and 550 where `paper_worlds`
               trained beside it. With 128 samples at once its first step failed (jax 0.11.2: "select_k: scratch
               capacity exceeded"), hence 64.
    Expected:  after 128,000 samples, with 1,267 objects: validation loss 2.282, segmentation accuracy 0.956, keypoint
               accuracy 0.126 of 64; docs/training.md has recalls.
"""

from __future__ import annotations

from dataclasses import replace

from configs.small import worlds
from kmn_jax.data import PipelineConfig
from kmn_jax.models import KeyMatchNetConfig
from kmn_jax.train import OptimizerConfig, TrainConfig

base = TrainConfig(
    name="base",
    pack="outputs/packs/electronics",
    num_steps=20_000,
    network=KeyMatchNetConfig(inputs="invariant", dropout=0.1, compute="bfloat16"),
    optimizer=OptimizerConfig(
        method="muon",
        schedule="cosine",
        learning_rate=3e-2,
        least_rate=1e-4,
        warmup_steps=500,
        weight_decay=0.0,
        clip_norm=1.0,
    ),
    pipeline=PipelineConfig(batch_size=128, crops_per_object=4),
    average_decay=0.999,
)

base_worlds = replace(
    base,
    name="base_worlds",
    pack=worlds.pack,
    num_steps=1_000,
    network=replace(base.network, inputs="chiral", num_keypoints=64),
    examples=replace(worlds.examples, crops=replace(worlds.examples.crops, num_points=2_048)),
    optimizer=replace(base.optimizer, warmup_steps=100),
    crops_at_once=64,
    average_decay=0.99,
    validation_samples=20,
    validate_every=1_000,
    checkpoint_every=250,
    log_every=50,
)
