"""Parsing point clouds: XYZ text, and PCD as text, binary or compressed."""

from __future__ import annotations

import io
import warnings

import numpy as np
from jaxtyping import Float64

from kmn_jax.errors import InputError

Cloud = tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"] | None]  # points, normals
_Field = tuple[str, np.dtype, int]  # name, type, numbers a point


def parse_xyz(content: bytes, with_normals: bool) -> Cloud:
    """Return the points of lines `x y z ...`, and the normals of lines `x y z nx ny nz ...`; # starts a comment.

    Further columns are not used. Raises InputError, without the file's name, that names the first bad line.
    """
    columns = 6 if with_normals else 3
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of no data
            table = np.loadtxt(io.BytesIO(content), dtype=np.float64, ndmin=2, encoding="latin-1")
    except (ValueError, OverflowError) as error:
        raise InputError(f"it is not a table of numbers: {str(error).split(';')[0]}") from None
    if table.size and table.shape[1] < columns:
        raise InputError(f"it has {table.shape[1]} numbers a line, but {columns} are needed")
    table = table.reshape(-1, max(columns, table.shape[1]))
    return table[:, :3], table[:, 3:6] if with_normals else None


def parse_pcd(content: bytes) -> Cloud:
    """Return the points of a PCD file's content, and their normals if there are any.

    Raises InputError, without the file's name, if the content is not what its header announces, or no PCD.
    """
    header, body = _header(content)
    fields, sizes, types = (header.get(key, []) for key in ("FIELDS", "SIZE", "TYPE"))
    counts = header.get("COUNT", ["1"] * len(fields))
    try:
        total = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
        row = [
            (name, np.dtype("<" + _TYPES[kind] + size), int(count))
            for name, kind, size, count in zip(fields, types, sizes, counts, strict=True)
        ]
        if total < 0:
            raise ValueError(f"{total} points")
        columns = _READERS[header["DATA"][0]](body, row, total)
    except (ValueError, TypeError, KeyError, IndexError, OverflowError) as error:
        raise InputError(f"it is truncated or damaged, or not a PCD file ({type(error).__name__}: {error})") from None
    named = {name: column[:, 0] for (name, _, count), column in zip(row, columns, strict=True) if count == 1}
    if not {"x", "y", "z"} <= named.keys():
        raise InputError("its points have no x, y and z")
    with np.errstate(invalid="ignore"):  # the conversion of a signalling NaN, which is found later
        points = np.stack([named[name] for name in ("x", "y", "z")], axis=1).astype(np.float64)
        if not {"normal_x", "normal_y", "normal_z"} <= named.keys():
            return points, None
        normals = np.stack([named[f"normal_{name}"] for name in ("x", "y", "z")], axis=1)
        return points, normals.astype(np.float64)


def _header(content: bytes) -> tuple[dict[str, list[str]], bytes]:
    header: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in header and len(header) <= 20:
        end = content.find(b"\n", position, position + 10_000)
        if end < 0:
            break
        words = content[position:end].decode("latin-1").partition("#")[0].split()
        if words:
            header[words[0].upper()] = words[1:]
        position = end + 1
    if not header.get("DATA"):
        raise InputError("it is not a PCD file: its header has no DATA line")
    return header, content[position:]


def _read_text(body: bytes, row: list[_Field], total: int) -> list[np.ndarray]:
    words = body.split()
    table = np.fromiter(map(float, words), np.float64, len(words)).reshape(total, sum(count for _, _, count in row))
    return np.split(table, np.cumsum([count for _, _, count in row])[:-1], axis=1)


def _read_binary(body: bytes, row: list[_Field], total: int) -> list[np.ndarray]:
    record = np.dtype([(str(index), kind, (count,)) for index, (_, kind, count) in enumerate(row)])
    if len(body) != total * record.itemsize:
        raise ValueError(f"{total} points take {total * record.itemsize} bytes, but there are {len(body)}")
    table = np.frombuffer(body, record)
    return [table[name] for name in record.names or ()]


def _read_compressed(body: bytes, row: list[_Field], total: int) -> list[np.ndarray]:
    packed, unpacked = (int.from_bytes(body[start : start + 4], "little") for start in (0, 4))
    if len(body) - 8 < packed or unpacked != total * sum(kind.itemsize * count for _, kind, count in row):
        raise ValueError(f"{len(body)} bytes of data do not hold {total} points")
    data = _unpack_lzf(body[8 : 8 + packed])
    if len(data) != unpacked:
        raise ValueError(f"the data unpack to {len(data)} bytes instead of {unpacked}")
    columns, position = [], 0
    for _, kind, count in row:  # field after field, each for all points
        columns.append(np.frombuffer(data, kind, total * count, position).reshape(total, count))
        position += columns[-1].nbytes
    return columns


def _unpack_lzf(packed: bytes) -> bytes:
    result, position = bytearray(), 0
    while position < len(packed):
        control = packed[position]
        position += 1
        if control < 32:  # so many bytes plus one as they are
            result += packed[position : position + control + 1]
            position += control + 1
            continue
        length = control >> 5  # of a piece that came before
        if length == 7:
            length += packed[position]
            position += 1
        back = ((control & 31) << 8) + packed[position] + 1
        position += 1
        if back > len(result):
            raise ValueError("the data are not LZF")
        piece = bytes(result[-back:][: length + 2])
        result += (piece * (length + 2))[: length + 2]  # it may overlap what it yields
    return bytes(result)


_TYPES = {"F": "f", "I": "i", "U": "u"}
_READERS = {"ascii": _read_text, "binary": _read_binary, "binary_compressed": _read_compressed}
