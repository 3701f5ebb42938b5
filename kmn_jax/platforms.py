"""Computations that have one form for CPUs and another one for accelerators, both with the same result."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import jax

_Result = TypeVar("_Result")
_any_platform = jax.make_user_context(default_value=False)  # what is traced in one is not taken for the other


def by_platform(*operands: Any, cpu: Callable[..., _Result], default: Callable[..., _Result]) -> _Result:
    """Return what `cpu` makes of operands in a program for CPUs, and what `default` makes of them in any other.

    Programs are for the devices that this process uses by default, so that one form alone is traced: forms hold forms,
    and both of each would take several times as long. Inside of `for_any_platform` they are for any.
    """
    if _any_platform.value:
        result: _Result = jax.lax.platform_dependent(*operands, cpu=cpu, default=default)
        return result
    return own_form(cpu, default)(*operands)


@contextmanager
def for_any_platform() -> Iterator[None]:
    """Trace what may be compiled for devices that this process does not use: which form it has is settled then."""
    with _any_platform(True):
        yield


def own_form(cpu: Callable[..., _Result], default: Callable[..., _Result]) -> Callable[..., _Result]:
    """Return the one of two forms that this process's devices are given."""
    return cpu if jax.default_backend() == "cpu" else default
