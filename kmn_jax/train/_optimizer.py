"""The optimizer and its schedule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import jax
import numpy as np
import optax
from jaxtyping import Float32

from kmn_jax.errors import InputError

_VECTOR_RATE = 0.1  # of Adam for vectors beside Muon for matrices


@dataclass(frozen=True)
class OptimizerConfig:
    """How parameters change, and how fast; the defaults are the published ones, with an epoch's steps from the config.

    Attributes:
        schedule: "step" multiplies the rate by `decay` every `decay_steps`, down to `least_rate`; "cosine" warms up
            linearly over `warmup_steps`, then falls to `least_rate` at the last step.
        method: "adam" has the weight decay in the gradient, as published, "adamw" beside it. "muon" makes the updates
            of matrices orthogonal (K. Jordan et al., 2024); those of vectors are by AdamW at a tenth of the rate.
        clip_norm: gradients are scaled down to this global norm; 0 leaves them.
    """

    method: Literal["adam", "adamw", "muon"] = "adam"
    schedule: Literal["step", "cosine"] = "step"
    learning_rate: float = 1e-4
    least_rate: float = 1e-5
    warmup_steps: int = 0
    decay: float = 0.7
    decay_steps: int = 20 * 232_000 // 14
    weight_decay: float = 1e-4
    beta2: float = 0.999
    clip_norm: float = 0.0

    def __post_init__(self) -> None:
        if self.method not in ("adam", "adamw", "muon"):
            raise InputError(f'method is {self.method!r}, but must be "adam", "adamw" or "muon"')
        if self.schedule not in ("step", "cosine"):
            raise InputError(f'schedule is {self.schedule!r}, but must be "step" or "cosine"')
        if not 0 < self.least_rate <= self.learning_rate:
            raise InputError(
                f"least_rate = {self.least_rate} must be above 0 and up to learning_rate = {self.learning_rate}"
            )
        if self.warmup_steps < 0 or self.decay_steps < 1 or not 0 < self.decay <= 1:
            raise InputError(
                f"warmup_steps = {self.warmup_steps} must not be negative, decay_steps = {self.decay_steps} at least 1,"
                f" decay = {self.decay} above 0 and up to 1"
            )
        if self.schedule == "step" and self.warmup_steps:
            raise InputError(f'warmup_steps = {self.warmup_steps} needs schedule "cosine": "step" has no warm-up')
        if self.weight_decay < 0 or self.clip_norm < 0 or not 0 < self.beta2 < 1:
            raise InputError(
                f"weight_decay = {self.weight_decay} and clip_norm = {self.clip_norm} must not be negative, beta2 ="
                f" {self.beta2} must be between 0 and 1"
            )

    def rate(self, num_steps: int) -> optax.Schedule:
        """Return the learning rate by step, of a run of so many steps."""
        if self.schedule == "step":
            return optax.exponential_decay(
                self.learning_rate, self.decay_steps, self.decay, staircase=True, end_value=self.least_rate
            )
        if self.warmup_steps >= num_steps:
            raise InputError(f"warmup_steps = {self.warmup_steps} must be fewer than the run's {num_steps} steps")
        return optax.warmup_cosine_decay_schedule(
            0.0 if self.warmup_steps else self.learning_rate,
            self.learning_rate,
            self.warmup_steps,
            num_steps,
            self.least_rate,
        )

    def rates(self, num_steps: int) -> Float32[np.ndarray, " steps"]:
        """Return the learning rate of every step of a run, on the host."""
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            return np.asarray(jax.jit(jax.vmap(self.rate(num_steps)))(np.arange(num_steps)), np.float32)

    def build(self, num_steps: int) -> optax.GradientTransformation:
        """Return the optimizer of a run of so many steps."""
        rate = self.rate(num_steps)
        clip = [optax.clip_by_global_norm(self.clip_norm)] if self.clip_norm else []
        if self.method == "adam":
            decay = [optax.add_decayed_weights(self.weight_decay)] if self.weight_decay else []
            method = [*decay, optax.adam(rate, b2=self.beta2)]
        elif self.method == "adamw":
            method = [optax.adamw(rate, b2=self.beta2, weight_decay=self.weight_decay)]
        else:
            from optax import contrib

            def vectors(count: Any) -> Any:
                return _VECTOR_RATE * rate(count)

            method = [
                contrib.muon(rate, weight_decay=self.weight_decay, adam_b2=self.beta2, adam_learning_rate=vectors)
            ]
        chain = optax.chain(*clip, *method)

        def update(grads: Any, state: Any, parameters: Any = None) -> Any:
            # optax itself mixes dtypes and ranks, also where JAX is told to refuse that.
            with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
                return chain.update(grads, state, parameters)

        return optax.GradientTransformation(chain.init, update)
