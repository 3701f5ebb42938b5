"""Computations that have one form for CPUs and another one for accelerators, both with the same result."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import jax

_Result = TypeVar("_Result")
# What is traced in this context of JAX is not taken for what is traced outside. It is made when it is first asked for,
# as all that was traced before is then traced again.
_any_platform: Any = None


def by_platform(*operands: Any, cpu: Callable[..., _Result], default: Callable[..., _Result]) -> _Result:
    """Return what `cpu` makes of operands in a program for CPUs, and what `default` makes of them in any other.

    Programs are for the devices that JAX uses by default, so that one form alone is traced: forms hold forms, and both
    of each would take several times as long. Inside of `for_any_platform` they are for any.
    """
    if _any_platform is not None and _any_platform.value:
        result: _Result = jax.lax.platform_dependent(*operands, cpu=cpu, default=default)
        return result
    return own_form(cpu, default)(*operands)


@contextmanager
def for_any_platform() -> Iterator[None]:
    """Trace what may be compiled for devices that JAX does not use by default: which form it has is settled then."""
    global _any_platform
    if _any_platform is None:
        _any_platform = jax.make_user_context(default_value=False)
    with _any_platform(True):
        yield


def own_form(cpu: Callable[..., _Result], default: Callable[..., _Result]) -> Callable[..., _Result]:
    """Return the one of two forms that JAX's default device is given, also within `jax.default_device`."""
    device = jax.config.values["jax_default_device"] or jax.default_backend()
    return cpu if getattr(device, "platform", device) == "cpu" else default
