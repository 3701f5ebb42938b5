"""Read and write torch state dicts (the zip format of torch >= 1.6) without torch and without running their code.

A torch file is a zip of one pickle and one raw buffer per tensor. The pickle is read by an unpickler that
knows five names, all of which end in functions of this file; any other name is refused, so nothing in the
file can run. Sizes that it declares are compared with the file's before anything is made of them.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import struct
import zipfile
from collections import OrderedDict
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kmn_jax.errors import InputError

_STORAGE_DTYPES = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "HalfStorage": "<f2",
    "BFloat16Storage": "<u2",  # no such NumPy type: widened by hand
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "<i1",
    "ByteStorage": "<u1",
    "BoolStorage": "?",
}

_MOST_COPIES = 8  # of the file's size, in tensors: some share a buffer, and half precision is widened
_MOST_PICKLE = 4_000_000  # bytes: a tensor takes some two hundred, and each may cost a microsecond and 70 bytes
# What torch writes for a state dict: containers, text, numbers, names, calls of these, and references.
_OPCODES = frozenset(
    """
    PROTO FRAME STOP MARK NONE NEWTRUE NEWFALSE BININT BININT1 BININT2 LONG1 BINFLOAT BINUNICODE SHORT_BINUNICODE
    EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 EMPTY_LIST APPEND APPENDS EMPTY_DICT SETITEM SETITEMS GLOBAL STACK_GLOBAL
    REDUCE BUILD BINPERSID BINPUT LONG_BINPUT MEMOIZE BINGET LONG_BINGET
    """.split()  # noqa: SIM905
)


def read_state_dict(path: Path) -> dict[str, np.ndarray]:
    """Return the tensors of a torch state dict by name.

    Raises:
        InputError: not a torch zip file, truncated or compressed, a pickle that names anything but tensors, or sizes
            that the file cannot hold.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
            if len(pickles) != 1:
                raise InputError(f"{path} is a zip file, but not a torch state dict: it holds no data.pkl")
            size, entries = path.stat().st_size, archive.infolist()
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
                raise InputError(f"{path} is refused: it is compressed, which torch never does")
            if sum(entry.file_size for entry in entries) > size:
                raise InputError(f"{path} is refused: it unpacks to more than its own size, which torch never writes")
            if archive.getinfo(pickles[0]).file_size > _MOST_PICKLE:
                raise InputError(f"{path} is refused: its pickle is longer than {_MOST_PICKLE} bytes")
            try:
                value = _Unpickler(archive, pickles[0].removesuffix("data.pkl"), _MOST_COPIES * size).load()
            except InputError as error:
                raise InputError(f"{path} {error}") from None
    except zipfile.BadZipFile as error:
        raise InputError(
            f"{path} is not a torch zip file ({error}): if torch before 1.6 wrote it, load and torch.save it again"
        ) from None
    except InputError:
        raise
    except Exception as error:  # a damaged pickle raises nearly anything: EOFError, KeyError, AttributeError, ...
        reason = str(error).strip().partition("\n")[0][:120]
        raise InputError(f"{path} is damaged: {type(error).__name__} while reading its state dict ({reason})") from None
    if isinstance(value, dict):
        nested = [value[key] for key in ("state_dict", "model_state_dict", "model") if isinstance(value.get(key), dict)]
        value = nested[0] if nested else value
    if not isinstance(value, dict) or not value or not all(isinstance(entry, np.ndarray) for entry in value.values()):
        raise InputError(f"{path} holds no state dict: save model.state_dict() rather than the model")
    return {str(name): tensor for name, tensor in value.items()}


def state_dict_bytes(tensors: dict[str, np.ndarray]) -> bytes:
    """Return float32 tensors as the content of a file that `torch.load(..., weights_only=True)` reads."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("archive/data.pkl", _pickle_of(tensors))
        archive.writestr("archive/byteorder", "little")
        for index, tensor in enumerate(tensors.values()):
            archive.writestr(f"archive/data/{index}", np.ascontiguousarray(tensor, dtype="<f4").tobytes())
        archive.writestr("archive/version", "3\n")
    return buffer.getvalue()


class _Unpickler(pickle.Unpickler):
    """Reads a state dict of at most so many bytes; its InputError leaves out the file's name."""

    def __init__(self, archive: zipfile.ZipFile, prefix: str, most_bytes: int) -> None:
        content = archive.read(prefix + "data.pkl")
        _check_opcodes(content)
        super().__init__(io.BytesIO(content))
        self._archive, self._prefix = archive, prefix
        self._buffers: dict[str, bytes] = {}
        self._left = most_bytes

    def find_class(self, module: str, name: str) -> Any:
        if module == "torch" and name in _STORAGE_DTYPES:
            return name  # of a class, which only says what the buffer holds
        meanings = {
            ("collections", "OrderedDict"): _ordered,
            ("torch", "Size"): _integers,
            ("torch._utils", "_rebuild_tensor_v2"): self._tensor,
            ("torch._utils", "_rebuild_parameter"): _parameter,
        }
        if (module, name) not in meanings:
            shown = repr(f"{module}.{name}"[:80])[1:-1]
            raise InputError(f"is refused: its pickle names {shown}, which no state dict needs")
        return meanings[module, name]

    def persistent_load(self, identifier: Any) -> _Storage:
        kind, storage, key, _location, count = identifier
        if kind != "storage" or storage not in _STORAGE_DTYPES:
            raise InputError("is refused: its pickle refers to something else than a tensor's buffer")
        if key not in self._buffers:
            self._buffers[key] = self._archive.read(f"{self._prefix}data/{key}")
        values = np.frombuffer(self._buffers[key], dtype=_STORAGE_DTYPES[storage])
        (needed,) = _integers((count,))
        if len(values) < needed:
            raise InputError(f"is truncated: buffer {key} holds {len(values)} of {needed} values")
        return _Storage(values, is_bfloat16=storage == "BFloat16Storage")

    def _tensor(self, storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> np.ndarray:
        if not isinstance(storage, _Storage):
            raise InputError("is damaged: a tensor is made of something that is no buffer")
        values = storage.values
        size, stride, (offset,) = _integers(size), _integers(stride), _integers((offset,))
        last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
        if min((offset, *size, *stride)) < 0 or prod(size) > len(values) or last >= max(len(values), 1):
            raise InputError(f"is damaged: a tensor of shape {size} reaches beyond its buffer"[:200])
        self._left -= prod(size) * (4 if storage.is_bfloat16 else values.itemsize)
        if self._left < 0:
            raise InputError(f"is refused: its tensors are over {_MOST_COPIES} times as large as the file")
        steps = tuple(step * values.itemsize for step in stride)
        tensor = np.lib.stride_tricks.as_strided(values[offset:], size, steps).copy()
        return (tensor.astype(np.uint32) << 16).view(np.float32) if storage.is_bfloat16 else tensor


class _Storage(NamedTuple):
    """A buffer as torch's storage; no array, so that nothing in a pickle can be called on it."""

    values: np.ndarray
    is_bfloat16: bool


def _check_opcodes(content: bytes) -> None:
    """Refuse what no state dict needs, and references beyond what there can be: memory is taken for all up to one."""
    for opcode, argument, _ in pickletools.genops(content):
        if opcode.name not in _OPCODES:
            raise InputError(f"is refused: its pickle uses {opcode.name}, which no state dict needs")
        if opcode.name in ("BINPUT", "LONG_BINPUT") and int(argument or 0) > len(content):
            raise InputError(f"is damaged: its pickle of {len(content)} bytes refers to object {argument}")


def _integers(values: Any) -> tuple[int, ...]:
    """Return a tuple or list of integers as a tuple; a tensor of them is none."""
    if type(values) not in (tuple, list) or not all(type(value) is int for value in values):
        raise InputError("is damaged: a tensor's size, stride or offset is not made of integers")
    return tuple(values)


def _ordered(*pairs: Any) -> OrderedDict:
    """Return a dict of nothing or of a list of pairs."""
    if any(not isinstance(value, (list, tuple)) for value in pairs):
        raise InputError("is damaged: a dict is not made of pairs")
    return OrderedDict(*pairs)


def _parameter(tensor: np.ndarray, *_: Any) -> np.ndarray:
    return tensor


def _pickle_of(tensors: dict[str, np.ndarray]) -> bytes:
    """Return the pickle of OrderedDict[str, Tensor], written opcode by opcode since torch is not at hand."""

    def text(value: str) -> bytes:
        encoded = value.encode()
        return pickle.BINUNICODE + struct.pack("<I", len(encoded)) + encoded

    def integers(values: tuple[int, ...]) -> bytes:
        return pickle.MARK + b"".join(pickle.BININT + struct.pack("<i", v) for v in values) + pickle.TUPLE

    def name(module: str, attribute: str) -> bytes:
        return pickle.GLOBAL + f"{module}\n{attribute}\n".encode()

    empty = name("collections", "OrderedDict") + pickle.EMPTY_TUPLE + pickle.REDUCE
    parts = [pickle.PROTO + b"\x02", empty, pickle.MARK]
    for index, (key, tensor) in enumerate(tensors.items()):
        strides = tuple(int(np.prod(tensor.shape[axis + 1 :])) for axis in range(tensor.ndim))
        storage = pickle.MARK + text("storage") + name("torch", "FloatStorage") + text(str(index)) + text("cpu")
        storage += pickle.BININT + struct.pack("<i", tensor.size) + pickle.TUPLE + pickle.BINPERSID
        arguments = pickle.MARK + storage + pickle.BININT + struct.pack("<i", 0) + integers(tensor.shape)
        arguments += integers(strides) + pickle.NEWFALSE + empty + pickle.TUPLE
        parts += [text(key), name("torch._utils", "_rebuild_tensor_v2"), arguments, pickle.REDUCE]
    return b"".join([*parts, pickle.SETITEMS, pickle.STOP])
