"""Surfaces of meshes, and models of objects, kept: to make one takes long, and most tests ask for the same few."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from copy import deepcopy
from dataclasses import is_dataclass
from typing import Any

import numpy as np

from kmn_jax.objects import _object_model
from kmn_jax.objects._surface import outer_surface

_MOST_KEPT = 16


class Kept:
    """A function whose last results are kept, each by the values of its arguments; functions among these do not count.

    Each call returns a copy of its own.
    """

    def __init__(self, make: Callable[..., Any]) -> None:
        self._make = make
        self._results: dict[Hashable, Any] = {}  # what was asked for last comes last

    def __call__(self, *given: Any) -> Any:
        """Return what the function does."""
        key = _key(given)
        found = self._results.pop(key, None) or self._make(*given)
        self._results[key] = found
        if len(self._results) > _MOST_KEPT:
            del self._results[next(iter(self._results))]
        return deepcopy(found)


def _key(value: Any) -> Hashable:
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, tuple):
        return tuple(_key(part) for part in value)
    if is_dataclass(value):
        return _key(tuple(vars(value).values()))
    return None if callable(value) else value


kept_surface = Kept(outer_surface)
kept_model = Kept(_object_model._model)
