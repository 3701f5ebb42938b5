"""What accelerators compute, on a CPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from kmn_jax import platforms
from kmn_jax.geometry import _eigen


@contextmanager
def accelerator_forms() -> Iterator[list[Any]]:
    """Trace what accelerators are given, and yield the list of the forms that were asked for.

    What was traced before is not traced again: give a new function.
    """
    asked: list[Any] = []

    def other_form(cpu: Callable[..., Any], default: Callable[..., Any]) -> Callable[..., Any]:
        asked.append(default)
        return default

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(platforms, "own_form", other_form)
        patch.setattr(_eigen, "_AT_ONCE", 3)  # longer pieces take long to compile
        yield asked
