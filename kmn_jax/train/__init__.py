"""Training: samples made inside the step, the step itself, sharding, checkpoints and the loop."""

from kmn_jax.train._config import TrainConfig
from kmn_jax.train._examples import ExampleConfig, Group, make_group
from kmn_jax.train._loop import NotFiniteError, train
from kmn_jax.train._optimizer import OptimizerConfig
from kmn_jax.train._records import read_metrics
from kmn_jax.train._rendered import rendered_frames
from kmn_jax.train._sharding import (
    data_mesh,
    initialize_distributed,
    jit_eval_step,
    jit_make_samples,
    jit_train_step,
    put_batch,
    put_whole,
    split_cpu,
)
from kmn_jax.train._sources import training_source
from kmn_jax.train._step import (
    Metrics,
    Samples,
    StepConfig,
    Sums,
    TrainState,
    create_state,
    index_of,
    mean_metrics,
    total_sums,
    train_step,
)

__all__ = [
    "ExampleConfig",
    "Group",
    "Metrics",
    "NotFiniteError",
    "OptimizerConfig",
    "Samples",
    "StepConfig",
    "Sums",
    "TrainConfig",
    "TrainState",
    "create_state",
    "data_mesh",
    "index_of",
    "initialize_distributed",
    "jit_eval_step",
    "jit_make_samples",
    "jit_train_step",
    "make_group",
    "mean_metrics",
    "put_batch",
    "put_whole",
    "read_metrics",
    "rendered_frames",
    "split_cpu",
    "total_sums",
    "train",
    "train_step",
    "training_source",
]
