"""The rows of an element of a PLY file, whose lists may make each of another length."""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64, Shaped

from kmn_jax.errors import InputError
from kmn_jax.limits import check_bytes, check_elements

_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}  # of `struct`
_BYTES_A_VALUE = 40  # of lists of different lengths, while they are put together


class Property(NamedTuple):
    """A number of each row, or a list of them."""

    name: str
    kind: str  # of a value, as NumPy calls it
    count_kind: str = ""  # of the number of values, before a list

    @property
    def size(self) -> int:
        """How many bytes a value takes."""
        return int(self.kind[1])

    @property
    def count_size(self) -> int:
        """How many bytes the number of values takes."""
        return int(self.count_kind[1]) if self.count_kind else 0


class Element(NamedTuple):
    """What a header says of an element."""

    name: str
    size: int  # rows
    properties: list[Property]


class Rows(NamedTuple):
    """The columns of an element: numbers, or the values of lists one after the other and the lengths of the lists."""

    end: int  # of its bytes
    numbers: dict[str, Shaped[np.ndarray, " r"]]
    lists: dict[str, tuple[Shaped[np.ndarray, " c"], Int64[np.ndarray, " r"]]]


def read_rows(body: bytes, position: int, element: Element, order: str, wanted: tuple[str, ...]) -> Rows:
    """Return the wanted columns of an element that starts at `position`.

    Raises InputError, without the file's name, if its rows do not lie within the body.
    """
    if not element.properties or not element.size:
        empty = np.zeros(0)
        return Rows(position, dict.fromkeys(wanted, empty), dict.fromkeys(wanted, (empty, np.zeros(0, np.int64))))
    least = sum(entry.count_size or entry.size for entry in element.properties)
    if element.size > (len(body) - position) // least:
        raise _truncated(element)
    check_elements(element.size, "rows")
    return _uniform(body, position, element, order, wanted) or _mixed(body, position, element, order, wanted)


def _uniform(body: bytes, position: int, element: Element, order: str, wanted: tuple[str, ...]) -> Rows | None:
    """Return the columns if the lists of all rows are as long as those of the first."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    end = position
    for entry in element.properties:
        if entry.count_kind:
            if end + entry.count_size > len(body):
                return None
            count = np.frombuffer(body, order + entry.count_kind, 1, end)[0]
            if not 0 <= count <= len(body) or count != int(count):
                return None
            fields += [(f"number of {entry.name}", order + entry.count_kind)]
            fields += [(entry.name, order + entry.kind, (int(count),))]
            end += entry.count_size + int(count) * entry.size
        else:
            fields.append((entry.name, order + entry.kind))
            end += entry.size
    if element.size * (end - position) > len(body) - position:
        return None
    table = np.frombuffer(body, np.dtype(fields), element.size, position)
    lists = [entry.name for entry in element.properties if entry.count_kind]
    if any((table[f"number of {name}"] != table[f"number of {name}"][0]).any() for name in lists):
        return None
    return Rows(
        position + table.nbytes,
        {name: table[name] for name in wanted if name not in lists},
        {
            name: (table[name].reshape(-1), np.full(element.size, table[name].shape[1]))
            for name in wanted
            if name in lists
        },
    )


def _mixed(body: bytes, position: int, element: Element, order: str, wanted: tuple[str, ...]) -> Rows:
    lists = [entry.name for entry in element.properties if entry.count_kind]
    counts = dict(zip(lists, _counts(body, position, element, order).T, strict=True))
    widths = {e.name: e.count_size + counts[e.name] * e.size if e.count_kind else e.size for e in element.properties}
    width = np.zeros(element.size, np.int64)
    for its_width in widths.values():
        width += its_width
    starts = position + np.cumsum(width) - width  # of a column in each row
    windows: dict[int, np.ndarray] = {
        size: np.lib.stride_tricks.sliding_window_view(np.frombuffer(body, np.uint8), size) for size in (1, 2, 4, 8)
    }
    rows = Rows(position + int(width.sum()), {}, {})
    for entry in element.properties:
        if entry.name in wanted:
            places = starts
            if entry.count_kind:
                number = counts[entry.name]
                check_bytes(_BYTES_A_VALUE * int(number.sum()))
                before = np.repeat(np.cumsum(number) - number, number)
                places = np.repeat(starts + entry.count_size, number) + (np.arange(len(before)) - before) * entry.size
            values = windows[entry.size][places].reshape(-1).view(order + entry.kind)
            if entry.count_kind:
                rows.lists[entry.name] = values, counts[entry.name]
            else:
                rows.numbers[entry.name] = values
        starts = starts + widths[entry.name]
    return rows


def _counts(body: bytes, position: int, element: Element, order: str) -> Int64[np.ndarray, "r l"]:
    """Return the lengths of the lists of each row: where one ends tells where the next begins, row after row."""
    steps, gap = [], 0
    for entry in element.properties:
        if entry.count_kind:
            steps.append((gap, struct.Struct(order + _CODES[entry.count_kind]), entry.size))
        gap = 0 if entry.count_kind else gap + entry.size
    found: list[int] = []
    try:
        if len(steps) == 1 and steps[0][1].size == 1 and order + "B" == steps[0][1].format:
            before, _, size = steps[0]  # nearly always so, and three times as fast
            position += before
            for _ in range(element.size):
                count = body[position]
                found.append(count)
                position += 1 + count * size + gap + before
            position -= before
        else:
            for _ in range(element.size):
                for before, reader, size in steps:
                    (count,) = reader.unpack_from(body, position + before)
                    if not 0 <= count <= len(body) or count != int(count):
                        what = f"a list of {element.name} has {count} entries"
                        raise InputError(f"it is truncated or damaged: {what}")
                    found.append(int(count))
                    position += before + reader.size + int(count) * size
                position += gap
    except (IndexError, struct.error):
        raise _truncated(element) from None
    if position > len(body):
        raise _truncated(element)
    return np.array(found, np.int64).reshape(element.size, len(steps))


def _truncated(element: Element) -> InputError:
    announced = f"the {min(element.size, 10**18)} entries of {element.name} it announces"
    return InputError(f"it is truncated: it has fewer than {announced}")
