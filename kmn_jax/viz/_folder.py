"""The scans that come after one in its folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from kmn_jax.errors import InputError

Result = TypeVar("Result")


def one_after_the_other(first: Path, read: Callable[[Path], Result], *others: Path | None) -> Callable[[], Result]:
    """Return a function that reads the next file of the folder of `first` each time, by name, except `others`.

    Only files of the same suffix are. It raises InputError after the last one.
    """

    def following() -> Iterator[Path]:
        for path in sorted(first.parent.glob(f"*{first.suffix}")):
            if path.name > first.name and path not in others:
                yield path

    paths = following()

    def read_next() -> Result:
        path = next(paths, None)
        if path is None:
            raise InputError(f"no {first.suffix} file comes after it in {first.parent}")
        return read(path)

    return read_next
