"""Torch files made to hurt their reader: each is refused with one sentence, and takes no memory."""

from __future__ import annotations

import pickle
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.models._torch_file import read_state_dict, state_dict_bytes

_FEW_BYTES = 10_000_000  # the reference would take eight thousand million


def _text(value: str) -> bytes:
    return pickle.BINUNICODE + struct.pack("<I", len(value.encode())) + value.encode()


def _name(module: str, name: str) -> bytes:
    return pickle.GLOBAL + f"{module}\n{name}\n".encode()


def _number(value: int) -> bytes:
    return pickle.BININT + struct.pack("<i", value)


def _storage(kind: str, key: str, count: bytes) -> bytes:
    inside = _text("storage") + _name("torch", kind) + _text(key) + _text("cpu") + count
    return pickle.MARK + inside + pickle.TUPLE + pickle.BINPERSID


def _sizes(*values: int) -> bytes:
    return pickle.MARK + b"".join(_number(value) for value in values) + pickle.TUPLE


def _tensor(storage: bytes, offset: bytes, size: bytes, stride: bytes) -> bytes:
    arguments = pickle.MARK + storage + offset + size + stride + pickle.TUPLE
    return _name("torch._utils", "_rebuild_tensor_v2") + arguments + pickle.REDUCE


def _dict(*entries: bytes) -> bytes:
    content = b"".join(_text(f"t{row}") + entry for row, entry in enumerate(entries))
    return pickle.PROTO + b"\x02" + pickle.EMPTY_DICT + pickle.MARK + content + pickle.SETITEMS + pickle.STOP


def _file(
    path: Path, content: bytes, buffers: dict[str, np.ndarray] | None = None, how: int = zipfile.ZIP_STORED
) -> Path:
    with zipfile.ZipFile(path, "w", how) as archive:
        archive.writestr("archive/data.pkl", content)
        for key, values in (buffers or {}).items():
            archive.writestr(f"archive/data/{key}", values.tobytes())
    return path


_FOUR = np.arange(4, dtype="<f4")
_WHOLE = _storage("FloatStorage", "0", _number(4))
_LONG = _tensor(_storage("LongStorage", "1", _number(2)), _number(0), _sizes(2), _sizes(1))


def test_strided_views_and_half_precision_are_read(tmp_path: Path) -> None:
    turned = _tensor(_WHOLE, _number(0), _sizes(2, 2), _sizes(1, 2))
    half = _tensor(_storage("BFloat16Storage", "1", _number(2)), _number(1), _sizes(1), _sizes(1))
    halves = (np.array([1.0, -2.5], dtype="<f4").view("<u4") >> 16).astype("<u2")
    found = read_state_dict(_file(tmp_path / "a.pt", _dict(turned, half), {"0": _FOUR, "1": halves}))
    np.testing.assert_array_equal(found["t0"], [[0, 2], [1, 3]])
    np.testing.assert_array_equal(found["t1"], np.array([-2.5], dtype=np.float32))


@pytest.mark.parametrize("place", ["offset", "size", "stride", "count"])
def test_a_tensor_is_no_integer(tmp_path: Path, place: str) -> None:
    # Integers of fixed width wrap around where they are added up: the bounds would hold for what is far outside.
    far = np.array([2**62, 2**62], dtype="<i8")
    given = {"offset": _number(0), "size": _sizes(2, 2), "stride": _sizes(2, 1), "count": _number(4)} | {place: _LONG}
    tensor = _tensor(_storage("FloatStorage", "0", given["count"]), given["offset"], given["size"], given["stride"])
    with pytest.raises(InputError, match="not made of integers"):
        read_state_dict(_file(tmp_path / "a.pt", _dict(tensor), {"0": _FOUR, "1": far}))


@pytest.mark.parametrize(
    ("offset", "size", "stride"), [(5, (1,), (1,)), (0, (2,), (4,)), (-1, (1,), (1,)), (0, (5,), (0,))]
)
def test_a_tensor_reaches_no_further_than_its_buffer(
    tmp_path: Path, offset: int, size: tuple[int, ...], stride: tuple[int, ...]
) -> None:
    tensor = _tensor(_WHOLE, _number(offset), _sizes(*size), _sizes(*stride))
    with pytest.raises(InputError, match="beyond its buffer"):
        read_state_dict(_file(tmp_path / "a.pt", _dict(tensor), {"0": _FOUR}))


def test_many_tensors_of_one_buffer(tmp_path: Path) -> None:
    whole = np.zeros(50_000, dtype="<f4")
    tensor = _tensor(_storage("FloatStorage", "0", _number(50_000)), _number(0), _sizes(50_000), _sizes(1))
    assert len(read_state_dict(_file(tmp_path / "few.pt", _dict(*[tensor] * 4), {"0": whole}))) == 4
    with pytest.raises(InputError, match="times as large as the file"):
        read_state_dict(_file(tmp_path / "many.pt", _dict(*[tensor] * 40), {"0": whole}))


@pytest.mark.parametrize("how", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2])
def test_a_compressed_file(tmp_path: Path, how: int) -> None:
    path = _file(tmp_path / "a.pt", _dict(), {"0": np.zeros(1 << 20, dtype="<f4")}, how)
    with pytest.raises(InputError, match="it is compressed, which torch never does"):
        read_state_dict(path)


def test_a_directory_that_names_one_buffer_many_times(tmp_path: Path) -> None:
    path = _file(tmp_path / "a.pt", _dict(), {"0": np.zeros(1 << 12, dtype="<f4")})
    with zipfile.ZipFile(path, "a") as archive:
        archive.filelist.extend([archive.getinfo("archive/data/0")] * 9)
        archive._didModify = True  # type: ignore[attr-defined]
    with pytest.raises(InputError, match="unpacks to more than its own size"):
        read_state_dict(path)


def test_a_long_pickle(tmp_path: Path) -> None:
    path = _file(tmp_path / "a.pt", pickle.PROTO + b"\x02" + pickle.EMPTY_DICT * 4_000_000 + pickle.STOP)
    with pytest.raises(InputError, match="longer than 4000000 bytes"):
        read_state_dict(path)


@pytest.mark.parametrize(
    "inside",
    [
        _name("builtins", "eval"),
        _name("collections", "OrderedDict") + _number(7) + pickle.TUPLE1 + pickle.REDUCE,
        _name("torch", "Size") + _LONG + pickle.TUPLE1 + pickle.REDUCE,
        pickle.EMPTY_SET,
        pickle.NONE + pickle.DUP + pickle.POP,
        _tensor(_text("buffer"), _number(0), _sizes(1), _sizes(1)),
        _text("os\nlines") + _text("a\n" * 500) + pickle.STACK_GLOBAL,
        pickle.MARK + _text("a\n" * 500) + _text("b") * 4 + pickle.TUPLE + pickle.BINPERSID,
        pickle.EMPTY_TUPLE + pickle.TUPLE1 * 100_000,
        pickle.MARK + _LONG + _text("b") * 4 + pickle.TUPLE + pickle.BINPERSID,
        _WHOLE + pickle.EMPTY_DICT + pickle.BUILD,
    ],
    ids=[
        "name",
        "dict of a number",
        "size of a tensor",
        "set",
        "duplicate",
        "tensor of text",
        "name of several lines",
        "kind of several lines",
        "nested tuples",
        "kind of a tensor",
        "attributes of a buffer",
    ],
)
def test_what_no_state_dict_needs(tmp_path: Path, inside: bytes) -> None:
    path = _file(tmp_path / "a.pt", _dict(inside), {"0": _FOUR, "1": np.arange(2, dtype="<i8")})
    with pytest.raises(InputError, match=r"refused|damaged|no state dict") as caught:
        read_state_dict(path)
    assert str(caught.value).startswith(f"{path} ")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 300


def test_a_reference_far_away_takes_no_memory(tmp_path: Path) -> None:
    content = pickle.PROTO + b"\x02" + pickle.EMPTY_DICT + pickle.LONG_BINPUT + struct.pack("<I", 2**30 - 1)
    path = _file(tmp_path / "a.pt", content + pickle.STOP)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="refers to object 1073741823"):
            read_state_dict(path)
        assert tracemalloc.get_traced_memory()[1] < _FEW_BYTES
    finally:
        tracemalloc.stop()


def test_a_file_of_ours_cut_anywhere(tmp_path: Path) -> None:
    whole = state_dict_bytes({"weight": np.ones((3, 4), dtype=np.float32)})
    path = tmp_path / "a.pt"
    for end in range(0, len(whole), 7):
        path.write_bytes(whole[:end])
        with pytest.raises(InputError):
            read_state_dict(path)
