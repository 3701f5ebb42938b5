"""Parsing STL files, binary and text, and refusing what is not whole."""

from __future__ import annotations

import re
from array import array

import numpy as np
from jaxtyping import Float64

from kmn_jax.errors import InputError

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = 84
_FACET = re.compile(
    rb"^[ \t]*facet\b[^\n]*\n\s*outer\s+loop\s+"
    + rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)\s+" * 3
    + rb"endloop\s+endfacet[ \t]*$",
    re.MULTILINE | re.IGNORECASE,
)
_WORD = re.compile(rb"^[ \t]*(?:vertex|facet|endfacet)\b", re.MULTILINE | re.IGNORECASE)


def parse_stl(content: bytes) -> Float64[np.ndarray, "t 3 3"]:
    """Return the corners of each triangle of an STL file's content; the stored normals are not used.

    Raises InputError, without the file's name, if the content is truncated, damaged or no STL.
    """
    declared = int.from_bytes(content[80:_HEADER], "little") if len(content) >= _HEADER else None
    if declared is not None and len(content) == _HEADER + 50 * declared:  # also if its header says "solid"
        with np.errstate(invalid="ignore"):  # the conversion of a signalling NaN, which is found later
            return np.frombuffer(content, _RECORD, offset=_HEADER)["corners"].astype(np.float64)
    if content.lstrip()[:5].lower() == b"solid":
        return _parse_text(content.replace(b"\r\n", b"\n").replace(b"\r", b"\n"))
    raise InputError(
        f"it has {len(content)} bytes"
        + ("" if declared is None else f", but announces {declared} triangles, which take {_HEADER + 50 * declared}")
        + ": it is truncated or not an STL file"
    )


def _parse_text(text: bytes) -> Float64[np.ndarray, "t 3 3"]:
    if not text.rstrip(b"\0 \t\n").rpartition(b"\n")[2].lstrip().lower().startswith(b"endsolid"):
        raise InputError("it is truncated: it does not end with 'endsolid'")
    numbers = array("d")
    try:
        for facet in _FACET.finditer(text):
            numbers.extend(map(float, facet.groups()))
    except ValueError as error:
        raise InputError(f"it is damaged: {error}") from None
    if 5 * len(numbers) != 9 * sum(1 for _ in _WORD.finditer(text)):  # facet, 3 x vertex, endfacet: 9 numbers
        raise InputError("it is damaged: a facet is not one loop of three vertices with three numbers each")
    return np.array(numbers, dtype=np.float64).reshape(-1, 3, 3)
