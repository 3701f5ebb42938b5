"""Parsing PLY files, text and binary: vertices, their normals, faces."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from kmn_jax.errors import InputError

_KINDS = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_KINDS |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_KINDS |= {"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_INDEX = 1e15  # of a vertex: what is beyond does not fit an integer
_MAX_HEADER = 100_000  # bytes: what has no end by then is not a header


class _Property(NamedTuple):
    name: str
    kind: str  # of a value, as NumPy calls it
    count_kind: str = ""  # of the number of values, before a list


class _Element(NamedTuple):
    name: str
    size: int  # rows
    properties: list[_Property]


@np.errstate(invalid="ignore")  # the conversion of a signalling NaN, which is found later
def parse_ply(
    content: bytes,
) -> tuple[Float64[np.ndarray, "v 3"], Float64[np.ndarray, "v 3"] | None, Int64[np.ndarray, "t 3"]]:
    """Return vertices, their normals if there are any, and triangles of a PLY file's content; polygons become fans.

    Raises InputError, without the file's name, if the content is not what its header announces, or no PLY.
    """
    encoding, elements, body = _header(content)
    if encoding == "ascii":
        body, elements = _as_doubles(body, elements)
    vertices, normals, triangles = None, None, np.zeros((0, 3), np.int64)
    position = 0
    for element in elements:
        tables = []
        for table in _tables(body, position, element, _ORDERS[encoding]):
            position += table.nbytes
            tables.append(table)
        if element.name == "vertex":
            vertices, normals = (_vectors(tables, element, names) for names in (("x", "y", "z"), ("nx", "ny", "nz")))
        elif element.name == "face":
            lists = [entry.name for entry in element.properties if entry.count_kind]
            name = next((name for name in lists if name in ("vertex_indices", "vertex_index")), None)
            triangles = _fans([table[name] for table in tables if name])
            if element.size and not len(triangles):
                raise InputError("its faces have no lists of three or more vertex_indices")
    if position != len(body):
        raise InputError("it is damaged: it holds more data than its header announces")
    if vertices is None:
        raise InputError("it has no vertices with x, y and z")
    return vertices, normals, triangles


def _header(content: bytes) -> tuple[str, list[_Element], bytes]:
    head, mark, rest = content[:_MAX_HEADER].partition(b"end_header")
    lines = [line.decode("latin-1") for line in head.splitlines()]
    if not mark or not lines or lines[0].strip() != "ply":
        raise InputError("it is not a PLY file: its header does not go from 'ply' to 'end_header'")
    encoding, elements = "", []
    for line in lines[1:]:
        try:
            match line.split():
                case ["format", name, _] if name in _ORDERS:
                    encoding = name
                case ["element", name, count] if int(count) >= 0:
                    elements.append(_Element(name, int(count), []))
                case ["property", "list", count_kind, kind, name]:
                    elements[-1].properties.append(_Property(name, _KINDS[kind], _KINDS[count_kind]))
                case ["property", kind, name]:
                    elements[-1].properties.append(_Property(name, _KINDS[kind]))
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError
        except (ValueError, KeyError, IndexError):
            raise InputError(f"its header has a line that is not PLY: {line[:60]!r}") from None
    if not encoding:
        raise InputError("its header has no format line")
    names = [element.name for element in elements]
    names += [f"{element.name} {entry.name}" for element in elements for entry in element.properties]
    if len(set(names)) < len(names):
        raise InputError("its header names an element or a property twice")
    skipped = len(head) + len(mark) + (2 if rest.startswith(b"\r\n") else 1)
    return encoding, elements, content[skipped:]


def _as_doubles(body: bytes, elements: list[_Element]) -> tuple[bytes, list[_Element]]:
    """Turn a text into the binary form in which every number is a double, which reads like any other."""
    words = body.split()
    try:
        numbers = np.fromiter(map(float, words), np.float64, len(words))
    except ValueError as error:
        raise InputError(f"it is damaged: {error}") from None
    return numbers.tobytes(), [
        element._replace(properties=[_Property(p.name, "f8", p.count_kind and "f8") for p in element.properties])
        for element in elements
    ]


def _tables(body: bytes, position: int, element: _Element, order: str) -> Iterator[Shaped[np.ndarray, " r"]]:
    """Yield the rows of an element that starts at `position`, as many at a time as have lists of the same lengths."""
    left, most = (element.size if element.properties else 0), element.size
    while left:
        row = _row(body, position, element, order)
        room = (len(body) - position) // row.itemsize
        if room < 1:
            raise InputError(
                f"it is truncated: it has fewer than the {element.size} entries of {element.name} it announces"
            )
        table = np.frombuffer(body, row, min(left, most, room), position)
        same = np.ones(len(table), dtype=bool)
        for name, _, count_kind in element.properties:
            if count_kind:
                counts = table[f"number of {name}"]
                same &= counts == counts[0]
        table = table if same.all() else table[: same.argmin()]
        yield table
        position, left = position + table.nbytes, left - len(table)
        most = 2 * len(table)  # else lists of changing lengths would be compared with all that follow, again and again


def _row(body: bytes, position: int, element: _Element, order: str) -> np.dtype:
    """Return the type of the row that starts at `position`, in which each list has its length."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for name, kind, count_kind in element.properties:
        length = 1
        if count_kind:
            start, position = position, position + int(count_kind[1])
            # A row that ends beyond the body is found by its size.
            count = np.frombuffer(body, order + count_kind, 1, start)[0] if position <= len(body) else 0
            if not 0 <= count <= max(len(body) - position, 0) / int(kind[1]) or count != int(count):
                raise InputError(f"it is truncated or damaged: a list of {element.name} has {count} entries")
            length = int(count)
            fields.append((f"number of {name}", order + count_kind))
        fields.append((name, order + kind, (length,)) if count_kind else (name, order + kind))
        position += length * int(kind[1])
    return _row_type(tuple(fields))


@functools.lru_cache(maxsize=100)
def _row_type(fields: tuple[tuple, ...]) -> np.dtype:
    return np.dtype(list(fields))


def _vectors(
    tables: list[np.ndarray], element: _Element, names: tuple[str, str, str]
) -> Float64[np.ndarray, "v 3"] | None:
    if not tables or not {*names} <= {p.name for p in element.properties if not p.count_kind}:
        return None
    return np.concatenate([np.stack([table[name] for name in names], axis=1) for table in tables]).astype(np.float64)


def _fans(polygons: list[np.ndarray]) -> Int64[np.ndarray, "t 3"]:
    """Cut polygons, given as tables of those of the same number of corners, into triangles around their first ones."""
    if not polygons:
        return np.zeros((0, 3), np.int64)
    corners = np.concatenate([table.reshape(-1) for table in polygons])
    if corners.dtype.kind == "f":
        whole = np.isfinite(corners) & (np.abs(corners) < _MAX_INDEX) & (corners == np.rint(corners))
        if not whole.all():
            raise InputError("it is damaged: a face names a vertex by something that is not a whole number")
    sizes = np.repeat([table.shape[1] for table in polygons], [len(table) for table in polygons])
    number = np.maximum(sizes - 2, 0)
    first = np.repeat(np.cumsum(sizes) - sizes, number)
    within = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
    return corners[np.stack([first, first + within + 1, first + within + 2], axis=1)].astype(np.int64)
