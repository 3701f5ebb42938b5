"""What reading a file may take: one budget, asked before anything is decoded, and JSON within it.

The budget is 2 GB, or as many bytes as the environment's KMN_MOST_BYTES says when a file is read. A file may have so
many bytes, and so many may be made of it; a pixel, point or triangle counts as 40 of them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from typing import Any

from kmn_jax.errors import InputError, shown

SETTING = "KMN_MOST_BYTES"
_MOST_BYTES = 2_000_000_000
_ELEMENT = 40  # bytes that a pixel, point or triangle takes on its way
_CONTAINER, _VALUE = 64, 40  # bytes that Python takes for a list or dict, and for what is in it
_DEEPEST = 64  # lists and dicts within each other; what takes recursion fails at a few hundred


def most_bytes() -> int:
    """Return how many bytes a file may have or become. Raises InputError for a setting that is no such number."""
    text = os.environ.get(SETTING, "").strip()
    if not text:
        return _MOST_BYTES
    if not (text.isascii() and text.isdigit() and len(text) < 19 and int(text) > 0):
        raise InputError(f"{SETTING} is {text[:40]!r}, but must be a number of bytes, such as {_MOST_BYTES}")
    return int(text)


def most_elements() -> int:
    """Return how many pixels, points or triangles a file may have."""
    return most_bytes() // _ELEMENT


def check_bytes(count: int) -> None:
    """Raise InputError, without the file's name, if what is to be made of a file takes more bytes than the budget."""
    most = most_bytes()
    if count > most:
        raise InputError(f"it takes {_shown(count)} bytes, more than {most}: make it smaller, or set {SETTING} higher")


def check_elements(count: int, kind: str = "points") -> None:
    """Raise InputError, without the file's name, for more pixels, points or triangles than the budget has room for."""
    most = most_elements()
    if count > most:
        raise InputError(
            f"it has {_shown(count)} {kind}, more than {most}: make it smaller, or set {SETTING} to more than"
            f" {_shown(count * _ELEMENT)}"
        )


def parse_json(text: str | bytes, make_object: Callable[[list[tuple[str, Any]]], Any] | None = None) -> Any:
    """Return what a JSON text holds; `make_object`, if given, makes what stands for an object of its names and values.

    Raises InputError, without the file's name, for what is no JSON, holds numbers of thousands of digits, is nested
    deeper than 64 levels, or takes more memory than the budget.
    """
    brackets, others = ((b"[", b"{"), (b",", b":")) if isinstance(text, bytes) else (("[", "{"), (",", ":"))
    containers = sum(map(text.count, brackets))  # type: ignore[arg-type]
    values = sum(map(text.count, others))  # type: ignore[arg-type]
    check_bytes(len(text) + _CONTAINER * containers + _VALUE * values)
    try:
        found = json.loads(text, object_pairs_hook=make_object)
    except ValueError as error:
        raise InputError(shown(error)) from None
    except RecursionError:
        raise InputError(f"it is nested deeper than {_DEEPEST} levels") from None
    if containers > _DEEPEST:
        _check_depth(found)
    return found


def _check_depth(found: Any) -> None:
    level = [found]
    for _ in range(_DEEPEST + 1):
        level = [
            value
            for container in level
            for value in (container.values() if isinstance(container, dict) else container)
            if isinstance(value, (list, dict))
        ]
        if not level:
            return
    raise InputError(f"it is nested deeper than {_DEEPEST} levels")


def _shown(count: int) -> int:
    """Return a count that does not fill the screen."""
    return min(count, 10**18)
