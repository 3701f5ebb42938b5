"""Rounds of a computation that is repeated until it stands still."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from kmn_jax.platforms import by_platform

_FEW = 20  # rounds up to which accelerators make all of them: they cost less than to wait for each one's answer

_State = TypeVar("_State")


def repeat_while(
    is_moving: Callable[[_State], Bool[Array, ""]], step: Callable[[_State], _State], state: _State, most: int
) -> _State:
    """Return the state after as many steps as it is moving, inside of jit; after `most` steps it must not be."""

    def until_still(state: _State) -> _State:
        return jax.lax.while_loop(is_moving, step, state)

    def without_asking(state: _State) -> _State:
        """Do the same, but for rounds that change nothing: a host that starts kernels need not wait for an answer."""

        def step_if_moving(state: _State, _: None) -> tuple[_State, None]:
            moving = is_moving(state)
            return jax.tree.map(lambda new, old: jnp.where(moving, new, old), step(state), state), None

        return jax.lax.scan(step_if_moving, state, length=most)[0]

    return by_platform(state, cpu=until_still, default=without_asking if most <= _FEW else until_still)
