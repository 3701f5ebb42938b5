"""Parsing point clouds: XYZ text, and PCD as text, binary or compressed."""

from __future__ import annotations

import io
import re
import warnings

import numpy as np
from jaxtyping import Float64

from kmn_jax.errors import InputError, shown
from kmn_jax.io._lzf import unpack_lzf
from kmn_jax.io._text import parse_numbers, pieces
from kmn_jax.limits import check_bytes, check_elements

Cloud = tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"] | None]  # points, normals
_KINDS = {"F": "f", "I": "i", "U": "u"}
_END_LINE = re.compile(rb"[\r\n]")
_LONGEST_PIECE = 3_000_000  # bytes: of a megabyte, and the rest of its last line


def parse_xyz(content: bytes, with_normals: bool) -> Cloud:
    """Return the points of lines `x y z ...`, and the normals of lines `x y z nx ny nz ...`; # starts a comment.

    Further columns are not used. Raises InputError, without the file's name, that names the first bad line.
    """
    columns = 6 if with_normals else 3
    lines = max(content.count(b"\n"), content.count(b"\r"))
    check_elements(lines, "lines")
    check_bytes(8 * _columns_of_text(content) * lines)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of no data
            table = np.loadtxt(io.BytesIO(content), dtype=np.float64, ndmin=2, encoding="latin-1")
    except (ValueError, OverflowError) as error:
        raise InputError(f"it is not a table of numbers: {shown(str(error).split(';')[0])}") from None
    if table.size and table.shape[1] < columns:
        raise InputError(f"it has {table.shape[1]} numbers a line, but {columns} are needed")
    table = table.reshape(-1, max(columns, table.shape[1]))
    return table[:, :3], table[:, 3:6] if with_normals else None


def _columns_of_text(content: bytes) -> int:
    """Return how many numbers the first line has, which all others must have, too."""
    found = 0
    for piece in pieces(content, _END_LINE):
        if len(piece) > _LONGEST_PIECE:
            raise InputError("it has a line of megabytes: it is damaged, or no table of points")
        if not found:
            rows = (line.partition(b"#")[0].split() for line in _END_LINE.split(piece))
            found = next((len(row) for row in rows if row), 0)
    return found


@np.errstate(invalid="ignore")  # the conversion of a signalling NaN, which is found later
def parse_pcd(content: bytes) -> Cloud:
    """Return the points of a PCD file's content, and their normals if there are any.

    Raises InputError, without the file's name, if the content is not what its header announces, or no PCD.
    """
    header, body = _header(content)
    try:
        named = _columns(header, body)
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, IndexError, OverflowError) as error:
        raise InputError(
            f"it is truncated or damaged, or not a PCD file ({type(error).__name__}: {shown(error)})"
        ) from None
    if not {"x", "y", "z"} <= named.keys():
        raise InputError("its points have no x, y and z")
    points = np.stack([named[name] for name in ("x", "y", "z")], axis=1).astype(np.float64)
    if not {"normal_x", "normal_y", "normal_z"} <= named.keys():
        return points, None
    return points, np.stack([named[f"normal_{name}"] for name in ("x", "y", "z")], axis=1).astype(np.float64)


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


def _columns(header: dict[str, list[str]], body: bytes) -> dict[str, np.ndarray]:
    """Return the fields of one number a point by name."""
    total = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    names, counts = header["FIELDS"], [int(count) for count in header.get("COUNT", ["1"] * len(header["FIELDS"]))]
    kinds = ["<" + _KINDS[kind] + size for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
    layout = header["DATA"][0]
    if layout not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"DATA {layout}")
    if layout == "ascii":
        body, kinds = parse_numbers(body).tobytes(), ["<f8"] * len(kinds)
    fields = list(zip(names, kinds, counts, strict=True))
    size = total * sum(np.dtype(kind).itemsize * count for _, kind, count in fields)
    by_column = layout == "binary_compressed"
    if by_column:
        packed, unpacked = (int.from_bytes(body[start : start + 4], "little") for start in (0, 4))
        if len(body) - 8 < packed or unpacked != size:
            raise ValueError(f"{len(body)} bytes of data do not hold {total} points")
        check_bytes(size)
        body = unpack_lzf(body[8 : 8 + packed], size)
    if total < 0 or len(body) != size:
        raise ValueError(f"{total} points take {size} bytes, but there are {len(body)}")
    check_elements(total)
    # Stored point after point, or all values of the first field, then of the next.
    shapes = [(total, count) if by_column else (count,) for count in counts]
    record = np.dtype([(str(i), kind, shapes[i]) for i, (_, kind, _) in enumerate(fields)])
    table = np.frombuffer(body, record)
    return {name: table[str(i)].reshape(total) for i, (name, _, count) in enumerate(fields) if count == 1}
