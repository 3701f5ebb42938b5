"""Read and write torch state dicts (the zip format of torch >= 1.6) without torch and without running their code.

A torch file is a zip of one pickle and one raw buffer per tensor. The pickle is read by an unpickler that
knows five names, all of which end in functions of this file; any other name is refused, so nothing in the
file can run.
"""

from __future__ import annotations

import io
import pickle
import struct
import zipfile
from collections import OrderedDict
from math import prod
from pathlib import Path
from typing import Any

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


def read_state_dict(path: Path) -> dict[str, np.ndarray]:
    """Return the tensors of a torch state dict by name.

    Raises:
        InputError: not a torch zip file, truncated, or a pickle that names anything but tensors.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
            if len(pickles) != 1:
                raise InputError(f"{path} is a zip file, but not a torch state dict: it holds no data.pkl")
            prefix = pickles[0].removesuffix("data.pkl")
            value = _Unpickler(archive, prefix, path).load()
    except zipfile.BadZipFile as error:
        raise InputError(
            f"{path} is not a torch zip file ({error}): if torch before 1.6 wrote it, load and torch.save it again"
        ) from None
    except InputError:
        raise
    except Exception as error:  # a damaged pickle raises nearly anything: EOFError, KeyError, AttributeError, ...
        raise InputError(f"{path} is damaged: {type(error).__name__} while reading its state dict ({error})") from None
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
    def __init__(self, archive: zipfile.ZipFile, prefix: str, path: Path) -> None:
        super().__init__(io.BytesIO(archive.read(prefix + "data.pkl")))
        self._archive, self._prefix, self._path = archive, prefix, path

    def find_class(self, module: str, name: str) -> Any:
        if module == "torch" and name in _STORAGE_DTYPES:
            return name  # of a class, which only says what the buffer holds
        if (module, name) not in _MEANINGS:
            raise InputError(f"{self._path} is refused: its pickle names {module}.{name}, which no state dict needs")
        return _MEANINGS[module, name]

    def persistent_load(self, identifier: Any) -> np.ndarray:
        kind, storage, key, _location, count = identifier
        if kind != "storage" or storage not in _STORAGE_DTYPES:
            raise InputError(f"{self._path} is refused: its pickle refers to {kind!r}, which no state dict needs")
        values = np.frombuffer(self._archive.read(f"{self._prefix}data/{key}"), dtype=_STORAGE_DTYPES[storage])
        if len(values) < count:
            raise InputError(f"{self._path} is truncated: buffer {key} holds {len(values)} of {count} values")
        return (values.astype(np.uint32) << 16).view(np.float32) if storage == "BFloat16Storage" else values


def _tensor(storage: np.ndarray, offset: int, size: tuple, stride: tuple, *_: Any) -> np.ndarray:
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    negative = offset < 0 or min((*size, *stride), default=0) < 0
    if negative or prod(size) > len(storage) or last >= max(len(storage), 1):
        raise InputError(f"the file is damaged: a tensor of shape {tuple(size)} reaches beyond its buffer")
    steps = tuple(step * storage.itemsize for step in stride)
    return np.lib.stride_tricks.as_strided(storage[offset:], tuple(size), steps).copy()


def _parameter(tensor: np.ndarray, *_: Any) -> np.ndarray:
    return tensor


_MEANINGS = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch", "Size"): tuple,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): _parameter,
}


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
