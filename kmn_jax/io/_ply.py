"""Parsing PLY files, text and binary: vertices, their normals, faces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from kmn_jax.errors import InputError

_KINDS = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_KINDS |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_KINDS |= {"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_INDEX = 1e15  # of a vertex: what is beyond does not fit an integer
_MAX_HEADER = 100_000  # bytes: what has no end by then is not a header


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str  # of a value, as NumPy calls it
    count_kind: str = ""  # of the number of values, before a list


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]


class _Lists(NamedTuple):
    """Lists of numbers, one after the other."""

    counts: np.ndarray
    values: np.ndarray


_Columns = dict[str, np.ndarray | _Lists]


def parse_ply(
    content: bytes,
) -> tuple[Float64[np.ndarray, "v 3"], Float64[np.ndarray, "v 3"] | None, Int64[np.ndarray, "t 3"]]:
    """Return vertices, their normals if there are any, and triangles of a PLY file's content; polygons become fans.

    Raises InputError, without the file's name, if the content is not what its header announces, or no PLY.
    """
    encoding, elements, body = _header(content)
    if encoding == "ascii":
        body, elements = _as_doubles(body, elements)
    found: dict[str, _Columns] = {}
    position = 0
    for element in elements:
        found[element.name], position = _read_element(body, position, element, _ORDERS[encoding])
    if position != len(body):
        raise InputError("it is damaged: it holds more data than its header announces")
    vertices = _vectors(found.get("vertex", {}), ("x", "y", "z"))
    if vertices is None:
        raise InputError("it has no vertices with x, y and z")
    faces = found.get("face", {})
    polygons = faces.get("vertex_indices", faces.get("vertex_index"))
    triangles = _fans(polygons) if isinstance(polygons, _Lists) else np.zeros((0, 3), np.int64)
    if len(triangles) == 0 and any(element.name == "face" and element.count for element in elements):
        raise InputError("its faces have no lists of three or more vertex_indices")
    return vertices, _vectors(found["vertex"], ("nx", "ny", "nz")), triangles


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
                    elements.append(_Element(name, int(count), ()))
                case ["property", "list", count_kind, kind, name]:
                    last = elements[-1]
                    new = _Property(name, _KINDS[kind], _KINDS[count_kind])
                    elements[-1] = replace(last, properties=(*last.properties, new))
                case ["property", kind, name]:
                    last = elements[-1]
                    elements[-1] = replace(last, properties=(*last.properties, _Property(name, _KINDS[kind])))
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError
        except (ValueError, KeyError, IndexError):
            raise InputError(f"its header has a line that is not PLY: {line[:60]!r}") from None
    if not encoding:
        raise InputError("its header has no format line")
    names = [element.name for element in elements]
    for element in elements:
        names += [f"{element.name} {entry.name}" for entry in element.properties]
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
    doubles = [
        replace(element, properties=tuple(_Property(p.name, "f8", p.count_kind and "f8") for p in element.properties))
        for element in elements
    ]
    return numbers.tobytes(), doubles


def _read_element(body: bytes, position: int, element: _Element, order: str) -> tuple[_Columns, int]:
    """Return the columns of an element that starts at `position`, and where it ends."""
    if element.count == 0 or not element.properties:
        return {}, position
    # As a rule all lists of a property are as long as the first one; then the element is one array.
    _, lengths = _read_row(body, position, element, order)
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for entry, length in zip(element.properties, lengths, strict=True):
        if entry.count_kind:
            fields.append((f"number of {entry.name}", order + entry.count_kind, ()))
        fields.append((entry.name, order + entry.kind, (length,) if entry.count_kind else ()))
    row = np.dtype(fields)
    end = position + element.count * row.itemsize
    table = np.frombuffer(body[position:end], row) if end <= len(body) else None
    columns: _Columns = {}
    for entry, length in zip(element.properties, lengths, strict=True):
        if table is None:
            break
        if not entry.count_kind:
            columns[entry.name] = table[entry.name]
        elif (table[f"number of {entry.name}"] == length).all():
            columns[entry.name] = _Lists(np.full(element.count, length), table[entry.name].reshape(-1))
        else:
            table = None
    if table is not None:
        return columns, end
    if not any(entry.count_kind for entry in element.properties):
        raise _truncated(element)
    return _read_row_by_row(body, position, element, order)


def _read_row_by_row(body: bytes, position: int, element: _Element, order: str) -> tuple[_Columns, int]:
    rows: list[list[np.ndarray]] = []
    for _ in range(element.count):
        values, _ = _read_row(body, position, element, order)
        rows.append(values)
        position += sum(value.nbytes for value in values)
        position += sum(np.dtype(entry.count_kind).itemsize for entry in element.properties if entry.count_kind)
    columns: _Columns = {}
    for index, entry in enumerate(element.properties):
        column = [row[index] for row in rows]
        flat = np.concatenate(column)
        columns[entry.name] = _Lists(np.array([len(value) for value in column]), flat) if entry.count_kind else flat
    return columns, position


def _read_row(body: bytes, position: int, element: _Element, order: str) -> tuple[list[np.ndarray], list[int]]:
    """Return a row's values by property, and how many each has."""
    values: list[np.ndarray] = []
    for entry in element.properties:
        length = 1
        if entry.count_kind:
            count = _take(body, position, element, order + entry.count_kind, 1)[0]
            position += count.nbytes
            if not 0 <= count <= len(body) or count != int(count):
                raise InputError(f"it is damaged: a list of {element.name} has {count} entries")
            length = int(count)
        values.append(_take(body, position, element, order + entry.kind, length))
        position += values[-1].nbytes
    return values, [len(value) for value in values]


def _take(body: bytes, position: int, element: _Element, kind: str, count: int) -> np.ndarray:
    if position + count * np.dtype(kind).itemsize > len(body):
        raise _truncated(element)
    return np.frombuffer(body, kind, count, position) if count else np.zeros(0, kind)


def _truncated(element: _Element) -> InputError:
    return InputError(f"it is truncated: it has fewer than the {element.count} entries of {element.name} it announces")


def _vectors(columns: _Columns, names: tuple[str, str, str]) -> Float64[np.ndarray, "v 3"] | None:
    parts = [columns.get(name) for name in names]
    arrays = [part for part in parts if isinstance(part, np.ndarray)]
    with np.errstate(invalid="ignore"):  # the conversion of a signalling NaN, which is found later
        return np.stack(arrays, axis=1).astype(np.float64) if len(arrays) == 3 else None


def _fans(polygons: _Lists) -> Int64[np.ndarray, "t 3"]:
    """Cut polygons into triangles around their first corners."""
    counts, values = polygons
    whole = np.isfinite(values) & (np.abs(values) < _MAX_INDEX) & (values == np.rint(values))
    if not whole.all():
        raise InputError("it is damaged: a face names a vertex by something that is not a whole number")
    number = np.maximum(counts - 2, 0)
    first = np.repeat(np.cumsum(counts) - counts, number)
    within = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
    return values[np.stack([first, first + within + 1, first + within + 2], axis=1)].astype(np.int64)
