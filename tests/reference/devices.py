"""What accelerators compute, on a CPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import pytest

from kmn_jax.geometry import _eigen


@contextmanager
def accelerator_forms() -> Iterator[list[Any]]:
    """Trace what accelerators are given, and yield the list of the forms that were asked for.

    What was traced before is not traced again: give a new function.
    """
    asked: list[Any] = []

    def other_form(*arguments: Any, default: Callable[..., Any], **_: Any) -> Any:
        asked.append(default)
        return default(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax.lax, "platform_dependent", other_form)
        patch.setattr(_eigen, "_AT_ONCE", 3)  # longer pieces take long to compile
        yield asked
