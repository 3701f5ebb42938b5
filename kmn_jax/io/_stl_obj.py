"""Parsing STL files, binary and text, and OBJ files, and refusing what is not whole."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Float64, Int64

from kmn_jax.errors import InputError, shown
from kmn_jax.io._text import pieces
from kmn_jax.limits import check_elements, most_elements

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = 84
_NAME = re.compile(rb"^[ \t]*(?:end)?solid\b[^\n]*$", re.MULTILINE | re.IGNORECASE)
_END_FACET, _END_LINE = re.compile(rb"\bendfacet\b"), re.compile(rb"\r?\n|\r(?!\n)")
_LONGEST_LINE = 1_000_000  # bytes
_FACET = b"facet normal ? ? ? outer loop vertex x x x vertex x x x vertex x x x endloop endfacet".split()


def parse_stl(content: bytes) -> Float64[np.ndarray, "t 3 3"]:
    """Return the corners of each triangle of an STL file's content; the stored normals are not used.

    Raises InputError, without the file's name, if the content is truncated, damaged or no STL.
    """
    declared = int.from_bytes(content[80:_HEADER], "little") if len(content) >= _HEADER else None
    if declared is not None and len(content) == _HEADER + 50 * declared:  # also if its header says "solid"
        check_elements(3 * declared)
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
    # Whole facets of a whole file; a cut elsewhere only adds to what is wrong with another.
    text = _NAME.sub(b"", text).lower()
    check_elements(3 * text.count(b"endfacet"))
    facets = [_parse_facets(piece.split()) for piece in pieces(text, _END_FACET)]
    return np.concatenate([np.zeros((0, 3, 3)), *facets])


def _parse_facets(words: list[bytes]) -> Float64[np.ndarray, "t 3 3"]:
    columns = [(name, words[i :: len(_FACET)]) for i, name in enumerate(_FACET)]
    if len(words) % len(_FACET) or any(len(name) > 1 and {*column} - {name} for name, column in columns):
        raise InputError("it is damaged: a facet is not one loop of three vertices with three numbers each")
    try:
        numbers = [list(map(float, column)) for name, column in columns if name == b"x"]
    except ValueError as error:
        raise InputError(f"it is damaged: {shown(error, 80)}") from None
    return np.array(numbers, dtype=np.float64).T.reshape(-1, 3, 3)


def parse_obj(content: bytes) -> tuple[Float64[np.ndarray, "v 3"], Int64[np.ndarray, "t 3"]]:
    """Return the vertices and triangles of an OBJ file's content; polygons become fans, groups are joined.

    Raises InputError, without the file's name, that names the first line which cannot be understood.
    """
    coordinates, triangles, most = array("d"), array("q"), 3 * most_elements()
    for number, line in enumerate(_lines(content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")), start=1):
        if len(line) > _LONGEST_LINE:
            raise InputError(f"line {number} is longer than {_LONGEST_LINE} bytes: it is damaged, or no OBJ file")
        words = line.partition(b"#")[0].split()
        kind = words[0] if words else b""
        try:
            if kind == b"v":
                x, y, z = words[1:4]
                coordinates.extend((float(x), float(y), float(z)))
                if len(coordinates) > most:
                    check_elements(len(coordinates) // 3)
            elif kind == b"f":
                corners = [int(word.partition(b"/")[0]) for word in words[1:]]
                if len(corners) < 3 or 0 in corners:
                    raise ValueError
                # Indices count from 1; negative ones count back from the last vertex so far.
                first, *rest = (i - 1 if i > 0 else len(coordinates) // 3 + i for i in corners)
                for second, third in pairwise(rest):
                    triangles.extend((first, second, third))
                if len(triangles) > most:
                    check_elements(len(triangles) // 3, "triangles")
        except InputError:
            raise
        except (ValueError, OverflowError):
            text = line.strip()[:60].decode("latin-1")
            raise InputError(f"line {number} is not a {'vertex' if kind == b'v' else 'face'}: {text!r}") from None
    return np.array(coordinates, np.float64).reshape(-1, 3), np.array(triangles, np.int64).reshape(-1, 3)


def _lines(content: bytes) -> Iterator[bytes]:
    for piece in pieces(content, _END_LINE):
        yield from piece.splitlines()
