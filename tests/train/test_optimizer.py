"""Schedules against their formulas, and that every method finds the least of a bowl."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from kmn_jax.errors import InputError
from kmn_jax.train import OptimizerConfig


def test_the_published_schedule_falls_by_steps_to_its_floor() -> None:
    rates = OptimizerConfig(decay_steps=10).rates(200)
    np.testing.assert_allclose(rates[[0, 9, 10, 19, 20]], [1e-4, 1e-4, 0.7e-4, 0.7e-4, 0.49e-4], rtol=1e-5)
    np.testing.assert_allclose(rates[100:], 1e-5, rtol=1e-5)


def test_the_cosine_warms_up_and_ends_at_its_floor() -> None:
    config = OptimizerConfig(schedule="cosine", learning_rate=1e-2, least_rate=1e-4, warmup_steps=10)
    rates = config.rates(110)
    np.testing.assert_allclose(rates[:11], np.arange(11) * 1e-3, atol=1e-8)
    np.testing.assert_allclose(rates[60], (1e-2 + 1e-4) / 2, rtol=1e-4)
    assert (np.diff(rates[10:]) < 0).all()
    assert 1e-4 < rates[-1] < 1.1e-4


@pytest.mark.parametrize("method", ["adam", "adamw", "muon"])
def test_every_method_finds_the_least_of_a_bowl(method: Any) -> None:
    config = OptimizerConfig(
        method=method, schedule="cosine", learning_rate=0.1, least_rate=1e-4, weight_decay=0.0, clip_norm=1.0
    )
    rng = np.random.default_rng(0)
    goal = {"kernel": jnp.asarray(rng.normal(size=(6, 4)), "f4"), "bias": jnp.asarray(rng.normal(size=4) / 10, "f4")}
    optimizer = config.build(300)

    @jax.jit
    def run(parameters: dict[str, jax.Array]) -> dict[str, jax.Array]:
        def step(carry: Any, _: None) -> tuple[Any, None]:
            parameters, state = carry
            grads = jax.tree.map(lambda a, b: a - b, parameters, goal)
            updates, state = optimizer.update(grads, state, parameters)
            return (optax.apply_updates(parameters, updates), state), None

        return jax.lax.scan(step, (parameters, optimizer.init(parameters)), None, length=300)[0][0]

    found = run(jax.tree.map(jnp.zeros_like, goal))
    for name, value in goal.items():
        np.testing.assert_allclose(found[name], value, atol=0.02)


def test_weight_decay_is_in_the_gradient_of_adam_and_beside_it_in_adamw() -> None:
    parameters, grads = {"w": jnp.full((2, 2), 10.0)}, {"w": jnp.full((2, 2), -1e-3)}

    def first_update(method: Any) -> float:
        config = OptimizerConfig(method=method, learning_rate=1e-2, weight_decay=1e-2)
        optimizer = config.build(10)
        updates, _ = jax.jit(optimizer.update)(grads, optimizer.init(parameters), parameters)
        return float(updates["w"][0, 0])

    assert first_update("adam") == pytest.approx(-1e-2, rel=1e-3)  # the decay outweighs the gradient
    assert first_update("adamw") == pytest.approx(1e-2 - 1e-2 * 1e-2 * 10, rel=1e-3)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"learning_rate": 1e-6}, "least_rate = 1e-05 must be above 0 and up to learning_rate = 1e-06"),
        ({"warmup_steps": 3}, 'needs schedule "cosine"'),
        ({"decay": 1.5}, "above 0 and up to 1"),
        ({"clip_norm": -1.0}, "must not be negative"),
    ],
)
def test_values_that_make_no_sense_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        OptimizerConfig(**values)


def test_a_warm_up_longer_than_the_run_is_refused() -> None:
    with pytest.raises(InputError, match="must be fewer than the run's 10 steps"):
        OptimizerConfig(schedule="cosine", warmup_steps=10).build(10)
