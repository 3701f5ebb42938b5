"""Rounds: as many as change something, and on accelerators the same without asking after each."""

from __future__ import annotations

from contextlib import nullcontext

import jax
import jax.numpy as jnp
import pytest

from kmn_jax.pose import repeat_while
from tests.reference.devices import accelerator_forms

FEW, MANY = 12, 50
State = tuple[jax.Array, jax.Array]


def halved(start: float, most: int) -> State:
    """Halve a number until it is below one, or has been halved so often."""

    def is_large(state: State) -> jax.Array:
        return (state[0] < most) & (state[1] >= 1)

    def halve(state: State) -> State:
        return state[0] + 1, state[1] / 2

    def run(start: jax.Array) -> State:
        return repeat_while(is_large, halve, (jnp.int32(0), start), most)

    return jax.jit(run)(jnp.float32(start))


@pytest.mark.parametrize("elsewhere", [False, True])
@pytest.mark.parametrize(("start", "rounds"), [(0.5, 0), (1.0, 1), (100.0, 7), (1e9, FEW)])
def test_rounds_go_on_until_nothing_moves(start: float, rounds: int, elsewhere: bool) -> None:
    with accelerator_forms() if elsewhere else nullcontext():
        count, left = halved(start, FEW)
    assert (count, left) == (rounds, start / 2**rounds)


@pytest.mark.parametrize(("most", "form"), [(FEW, "without_asking"), (MANY, "until_still")])
def test_accelerators_ask_where_rounds_may_be_many(most: int, form: str) -> None:
    with accelerator_forms() as asked:
        assert halved(100.0, most) == (7, 100 / 2**7)
    assert form in repr(asked[0])
