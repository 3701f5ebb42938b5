"""Time by stage, compilation apart."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import pytest

from kmn_jax.detection import Clock


def test_compiling_is_counted_apart_and_stages_add_up() -> None:
    clock = Clock()
    with clock("first"):
        jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x).T)(jnp.ones((50, 50))).block_until_ready()
        time.sleep(0.05)
    with clock("second"):
        time.sleep(0.02)
    with clock("first"):
        time.sleep(0.03)
    timing = clock.timing
    assert timing.compile > 0
    assert timing.stages["first"] >= 0.08
    assert timing.stages["second"] >= 0.02
    assert timing.total == pytest.approx(timing.compile + timing.stages["first"] + timing.stages["second"])


def test_what_raises_is_timed_too() -> None:
    def fail() -> None:
        with clock("stage"):
            time.sleep(0.01)
            raise ValueError("no")

    clock = Clock()
    with pytest.raises(ValueError, match="no"):
        fail()
    assert clock.timing.stages["stage"] >= 0.01
