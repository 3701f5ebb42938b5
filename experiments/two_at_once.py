"""Functions of many items, two of which run at once: one alone leaves a part of two cores idle."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

AT_ONCE = 2
_Item = TypeVar("_Item")
_Made = TypeVar("_Made")


def side_by_side(function: Callable[[_Item], _Made], items: Iterable[_Item], at_once: int = AT_ONCE) -> list[_Made]:
    """Return what a function makes of items, some of which it is given at once."""
    results: list[_Made] = []
    running: deque[Future[_Made]] = deque()
    with ThreadPoolExecutor(at_once) as pool:
        try:
            for item in items:
                running.append(pool.submit(function, item))
                if len(running) > at_once:  # no more are read in advance
                    results.append(running.popleft().result())
            return [*results, *(one.result() for one in running)]
        except BaseException:
            pool.shutdown(cancel_futures=True)  # what runs ends, and is kept
            raise
