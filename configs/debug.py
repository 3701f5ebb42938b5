"""A run of seconds on the small pack that the repository carries: whether everything works, not how well.

debug
    Command:   python -m experiments.train debug
    Hardware:  2 CPU cores, under a minute with compilation.
    Expected:  training loss from 1.85 to below 1.75.
"""

from __future__ import annotations

from kmn_jax.data import CropConfig, PipelineConfig
from kmn_jax.models import KeyMatchNetConfig
from kmn_jax.train import ExampleConfig, OptimizerConfig, TrainConfig

debug = TrainConfig(
    name="debug",
    pack="experiments/assets/small_pack",
    num_steps=40,
    network=KeyMatchNetConfig(
        num_scene_points=128,
        num_object_points=128,
        num_keypoints=8,
        num_neighbors=8,
        edge_width=16,
        embedding_width=64,
        scene_width=64,
        object_width=32,
        pair_width=32,
        groups=4,
        dropout=0.1,
        inputs="invariant",
        graph="static",
    ),
    examples=ExampleConfig(crops=CropConfig(num_points=128, normal_points=512)),
    optimizer=OptimizerConfig(method="adamw", schedule="cosine", learning_rate=3e-3, warmup_steps=5),
    pipeline=PipelineConfig(batch_size=8, crops_per_object=2),
    average_decay=0.9,
    validate_every=20,
    validation_samples=8,
    checkpoint_every=10,
    log_every=5,
)
