"""The config of a training run: one tree of the configs that its parts read."""

from __future__ import annotations

from dataclasses import dataclass, field

from kmn_jax.data import PipelineConfig
from kmn_jax.errors import InputError
from kmn_jax.models import KeyMatchNetConfig, LossConfig
from kmn_jax.train._examples import ExampleConfig
from kmn_jax.train._optimizer import OptimizerConfig
from kmn_jax.train._step import StepConfig


@dataclass(frozen=True)
class TrainConfig:
    """A training run. `configs/` holds the named ones."""

    name: str
    pack: str  # folder of the pack
    num_steps: int
    rendered: str | None = None  # folder of a BOP dataset: training crops come from its images, not the pack's scenes
    rendered_split: str = "train"  # the folder of its scenes
    network: KeyMatchNetConfig = field(default_factory=KeyMatchNetConfig)
    examples: ExampleConfig = field(default_factory=ExampleConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    pipeline: PipelineConfig = field(default_factory=PipelineConfig)
    crops_at_once: int | None = None  # that a device computes side by side; None: all of its share of a batch
    average_decay: float = 0.0  # of the running mean of the parameters that is evaluated and shipped; 0: the last ones
    random_seed: int = 0
    warm_start: str | None = None  # a released model's name or a file of weights, instead of random parameters
    training_share: float = 1.0  # of the pack's training objects, spread evenly over its list
    validate_every: int = 1000  # steps
    validation_samples: int = 20  # of each validation object
    checkpoint_every: int = 500  # steps
    log_every: int = 20  # steps

    def __post_init__(self) -> None:
        for name in ("num_steps", "validate_every", "validation_samples", "checkpoint_every", "log_every"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)} must be at least 1")
        if not 0 <= self.random_seed < 2**32:
            raise InputError(f"random_seed = {self.random_seed} must be from 0 to 2**32 - 1")
        if not 0 < self.training_share <= 1:
            raise InputError(f"training_share = {self.training_share} must be above 0 and up to 1")
        if self.rendered is not None and self.training_share < 1:
            raise InputError(
                f"training_share = {self.training_share} is of the pack's objects, but rendered = {self.rendered} has"
                " its own: leave one of them"
            )
        if self.validation_samples % self.pipeline.crops_per_object:
            raise InputError(
                f"validation_samples = {self.validation_samples} must be a multiple of pipeline.crops_per_object ="
                f" {self.pipeline.crops_per_object}"
            )
        each, at_once = self.pipeline.crops_per_object, self.crops_at_once
        if at_once is not None and (at_once < 1 or (each % at_once and at_once % each)):
            raise InputError(
                f"crops_at_once = {at_once} must divide pipeline.crops_per_object = {each}, or be a multiple of it"
            )
        if each % self.examples.crops_per_scene:
            raise InputError(
                f"examples.crops_per_scene = {self.examples.crops_per_scene} must divide pipeline.crops_per_object ="
                f" {each}"
            )
        if self.examples.crops.num_points != self.network.num_scene_points:
            raise InputError(
                f"examples.crops.num_points = {self.examples.crops.num_points} and network.num_scene_points ="
                f" {self.network.num_scene_points} must be the same"
            )
        self.optimizer.build(self.num_steps)  # contradictions between the schedule and the run's length

    @property
    def step(self) -> StepConfig:
        """What the step reads."""
        return StepConfig(
            network=self.network,
            examples=self.examples,
            loss=self.loss,
            crops_per_object=self.pipeline.crops_per_object,
            crops_at_once=self.crops_at_once,
            average_decay=self.average_decay,
            random_seed=self.random_seed,
        )
