"""Parsing STL files, binary and text, and refusing what is not whole."""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Float64

from kmn_jax.errors import InputError

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = 84
_NAME = re.compile(rb"^[ \t]*(?:end)?solid\b[^\n]*$", re.MULTILINE | re.IGNORECASE)
_FACET = b"facet normal ? ? ? outer loop vertex x x x vertex x x x vertex x x x endloop endfacet".split()


def parse_stl(content: bytes) -> Float64[np.ndarray, "t 3 3"]:
    """Return the corners of each triangle of an STL file's content; the stored normals are not used.

    Raises InputError, without the file's name, if the content is truncated, damaged or no STL.
    """
    declared = int.from_bytes(content[80:_HEADER], "little") if len(content) >= _HEADER else None
    if declared is not None and len(content) == _HEADER + 50 * declared:  # also if its header says "solid"
        with np.errstate(invalid="ignore"):  # the conversion of a signalling NaN, which is found later
            return np.frombuffer(content, _RECORD, offset=_HEADER)["corners"].astype(np.float64)
    if content.lstrip()[:5].lower() == b"solid":
        return _parse_text(content.replace(b"\r\n", b"\n").replace(b"\r", b"\n").rstrip(b"\0 \t\n"))
    raise InputError(
        f"it has {len(content)} bytes"
        + ("" if declared is None else f", but announces {declared} triangles, which take {_HEADER + 50 * declared}")
        + ": it is truncated or not an STL file"
    )


def _parse_text(text: bytes) -> Float64[np.ndarray, "t 3 3"]:
    if not text.rpartition(b"\n")[2].lstrip().lower().startswith(b"endsolid"):
        raise InputError("it is truncated: it does not end with 'endsolid'")
    words = _NAME.sub(b"", text).lower().split()
    columns = [(name, words[i :: len(_FACET)]) for i, name in enumerate(_FACET)]
    if len(words) % len(_FACET) or any(len(name) > 1 and {*column} - {name} for name, column in columns):
        raise InputError("it is damaged: a facet is not one loop of three vertices with three numbers each")
    try:
        numbers = [list(map(float, column)) for name, column in columns if name == b"x"]
    except ValueError as error:
        raise InputError(f"it is damaged: {error}") from None
    return np.array(numbers, dtype=np.float64).T.reshape(-1, 3, 3)
