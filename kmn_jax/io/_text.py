"""Text of numbers, in pieces: as words it would take ten times its size."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from kmn_jax.errors import InputError, shown
from kmn_jax.limits import check_bytes

_PIECE = 1 << 20  # bytes
_SPACE = re.compile(rb"\s")


def pieces(text: bytes, end: re.Pattern[bytes]) -> Iterator[bytes]:
    """Yield a text in pieces of a megabyte or more, each but the last with a match of `end` at its end."""
    start = 0
    while start < len(text):
        found = end.search(text, start + _PIECE)
        stop = found.end() if found else len(text)
        yield text[start:stop]
        start = stop


def parse_numbers(text: bytes) -> Float64[np.ndarray, " n"]:
    """Return the numbers of a text. Raises InputError, without the file's name, for a word that is none."""
    found, count = [np.zeros(0)], 0
    for piece in pieces(text, _SPACE):
        words = piece.split()
        count += len(words)
        check_bytes(8 * count)
        try:
            found.append(np.fromiter(map(float, words), np.float64, len(words)))
        except ValueError as error:
            raise InputError(f"it is damaged: {shown(error, 80)}") from None
    return np.concatenate(found)
