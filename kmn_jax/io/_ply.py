"""Parsing PLY files, text and binary: vertices, their normals, faces."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from kmn_jax.errors import InputError
from kmn_jax.io._ply_rows import Element, Property, Rows, read_rows
from kmn_jax.io._text import parse_numbers
from kmn_jax.limits import check_elements

_KINDS = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_KINDS |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_KINDS |= {"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_POSITION, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
_MAX_INDEX = 1e15  # of a vertex: what is beyond does not fit an integer
_MAX_HEADER = 100_000  # bytes: what has no end by then is not a header


@np.errstate(invalid="ignore")  # the conversion of a signalling NaN, which is found later
def parse_ply(
    content: bytes,
) -> tuple[Float64[np.ndarray, "v 3"], Float64[np.ndarray, "v 3"] | None, Int64[np.ndarray, "t 3"]]:
    """Return vertices, their normals if there are any, and triangles of a PLY file's content; polygons become fans.

    Raises InputError, without the file's name, if the content is not what its header announces, or no PLY.
    """
    encoding, elements, body = _header(content)
    if encoding == "ascii":
        body, elements = parse_numbers(body).tobytes(), list(map(_as_doubles, elements))
    vertices, normals, triangles = None, None, np.zeros((0, 3), np.int64)
    position = 0
    for element in elements:
        lists = [entry.name for entry in element.properties if entry.count_kind]
        wanted = _wanted(element, lists)
        rows = read_rows(body, position, element, _ORDERS[encoding], wanted)
        position = rows.end
        if element.name == "vertex" and element.size:
            vertices, normals = (_vectors(rows, names) for names in (_POSITION, _NORMAL))
        elif element.name == "face":
            triangles = _fans(*rows.lists[wanted[0]]) if wanted else triangles
            if element.size and not len(triangles):
                raise InputError("its faces have no lists of three or more vertex_indices")
    if position != len(body):
        raise InputError("it is damaged: it holds more data than its header announces")
    if vertices is None:
        raise InputError("it has no vertices with x, y and z")
    return vertices, normals, triangles


def _header(content: bytes) -> tuple[str, list[Element], bytes]:
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
                    elements.append(Element(name, int(count), []))
                case ["property", "list", count_kind, kind, name]:
                    elements[-1].properties.append(Property(name, _KINDS[kind], _KINDS[count_kind]))
                case ["property", kind, name]:
                    elements[-1].properties.append(Property(name, _KINDS[kind]))
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


def _as_doubles(element: Element) -> Element:
    """Return what an element of a text is in the binary form in which every number is a double."""
    return element._replace(properties=[Property(p.name, "f8", p.count_kind and "f8") for p in element.properties])


def _wanted(element: Element, lists: list[str]) -> tuple[str, ...]:
    """Return the names of the columns to be read."""
    if element.name == "vertex":
        return tuple(p.name for p in element.properties if p.name in (*_POSITION, *_NORMAL) and not p.count_kind)
    if element.name == "face":
        return tuple(name for name in lists if name in ("vertex_indices", "vertex_index"))[:1]
    return ()


def _vectors(rows: Rows, names: tuple[str, str, str]) -> Float64[np.ndarray, "v 3"] | None:
    if not {*names} <= rows.numbers.keys():
        return None
    return np.stack([rows.numbers[name] for name in names], axis=1).astype(np.float64)


def _fans(corners: Shaped[np.ndarray, " c"], sizes: Int64[np.ndarray, " p"]) -> Int64[np.ndarray, "t 3"]:
    """Cut polygons, the corners of one after those of another, into triangles around their first ones."""
    number = np.maximum(sizes - 2, 0)
    check_elements(int(number.sum()), "triangles")
    if corners.dtype.kind == "f":
        whole = np.isfinite(corners) & (np.abs(corners) < _MAX_INDEX) & (corners == np.rint(corners))
        if not whole.all():
            raise InputError("it is damaged: a face names a vertex by something that is not a whole number")
    first = np.repeat(np.cumsum(sizes) - sizes, number)
    within = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
    return corners[np.stack([first, first + within + 1, first + within + 2], axis=1)].astype(np.int64)
