"""Functions of many items: two run at once, and an error ends them."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Barrier, Event

import pytest

from experiments.two_at_once import side_by_side
from kmn_jax.errors import InputError


def test_two_items_run_at_once_and_keep_their_order() -> None:
    both, drawn, release = Barrier(2, timeout=20), [], Event()

    def given() -> Iterator[int]:
        for item in range(6):
            drawn.append(item)
            yield item

    def of_item(item: int) -> int:
        if item < 2:
            both.wait()
        if item == 0:
            release.wait(20)  # ends after the second
            assert max(drawn) <= 3
        elif item == 1:
            release.set()
        return -item

    assert side_by_side(of_item, given()) == [0, -1, -2, -3, -4, -5]


def test_an_error_ends_what_was_to_come_next() -> None:
    begun: list[int] = []

    def of_item(item: int) -> None:
        begun.append(item)
        if item == 1:
            raise InputError("no such image")

    with pytest.raises(InputError, match="no such image"):
        side_by_side(of_item, range(100))
    assert len(begun) < 8
