"""What a run needs to go on, as one unit, and the form it is stored in: named arrays, a record and their digest."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from kmn_jax.errors import InputError
from kmn_jax.train._step import TrainState

_FORMAT = "kmn_jax snapshot 1"


@dataclass(frozen=True)
class Snapshot:
    """A run between two steps."""

    state: TrainState
    batches: bytes  # `BatchIterator.get_state()`
    facts: dict[str, Any]  # what JSON can hold: config, metrics so far, samples seen, seconds, commit, versions


@dataclass(frozen=True)
class Packed:
    """A snapshot on the host: its arrays by their place in the state, such as `parameters/head/kernel`."""

    arrays: dict[str, np.ndarray]
    batches: bytes
    facts: str  # JSON

    @property
    def step(self) -> int:
        """Steps taken."""
        return int(self.arrays["step"])

    @property
    def digest(self) -> str:
        """SHA-256 of everything: names, dtypes, shapes and bytes of the arrays, batches and facts."""
        names = sorted(self.arrays)
        layout = [[name, self.arrays[name].dtype.name, list(self.arrays[name].shape)] for name in names]
        state = hashlib.sha256(json.dumps([layout, _text(self.batches), self.facts]).encode())
        for name in names:
            state.update(as_bytes(self.arrays[name]).data)
        return state.hexdigest()

    def record(self) -> dict[str, Any]:
        """Return what is stored beside the arrays, as JSON."""
        layout = {name: [array.dtype.name, list(array.shape)] for name, array in self.arrays.items()}
        return {
            "format": _FORMAT,
            "digest": self.digest,
            "layout": layout,
            "batches": _text(self.batches),
            "facts": self.facts,
        }


def pack(snapshot: Snapshot) -> Packed:
    """Bring a snapshot to the host; if several processes share its arrays, all of them must call this.

    The arrays may be views of the device's memory: use them before the next step.
    Raises InputError if the facts are not what JSON can hold.
    """
    try:
        facts = json.dumps(snapshot.facts)
    except (TypeError, ValueError) as error:
        raise InputError(f"the facts of a snapshot must be what JSON can hold: {error}") from None
    leaves = [
        leaf
        if not isinstance(leaf, jax.Array) or leaf.is_fully_addressable or leaf.is_fully_replicated
        else multihost_utils.process_allgather(leaf, tiled=True)
        for leaf in jax.tree.leaves(snapshot.state)
    ]
    arrays = [np.asarray(leaf, order="C") for leaf in jax.device_get(leaves)]
    return Packed(dict(zip(_names(snapshot.state), arrays, strict=True)), snapshot.batches, facts)


def unpack(packed: Packed, like: TrainState) -> Snapshot:
    """Return the snapshot with the structure and the shardings of `like`, which may be abstract.

    Leaves without a sharding go to the default device. Raises InputError where `check_fit` does.
    """
    check_fit(packed, like)
    leaves, structure = jax.tree.flatten(like)
    placed = [_placed(packed.arrays[name], leaf) for name, leaf in zip(_names(like), leaves, strict=True)]
    return Snapshot(jax.tree.unflatten(structure, placed), packed.batches, json.loads(packed.facts))


def check_fit(packed: Packed, like: TrainState) -> None:
    """Raise InputError if the arrays are not those of a state like this one."""
    wanted = dict(zip(_names(like), jax.tree.leaves(like), strict=True))
    problems = [f"{name} is missing" for name in wanted if name not in packed.arrays]
    problems += [f"{name} is unknown" for name in packed.arrays if name not in wanted]
    problems += [
        f"{name} is {array.dtype}{list(array.shape)} instead of {wanted[name].dtype}{list(wanted[name].shape)}"
        for name, array in packed.arrays.items()
        if name in wanted and (array.shape != wanted[name].shape or array.dtype != wanted[name].dtype)
    ]
    if problems:
        more = f" and {len(problems) - 4} more" if len(problems) > 4 else ""
        raise InputError(
            f"the saved state is of another network or optimizer ({'; '.join(problems[:4])}{more}): use the config"
            " that it was saved with"
        )


def read_layout(record: dict[str, Any]) -> dict[str, tuple[np.dtype, tuple[int, ...]]]:
    """Return dtype and shape of the arrays that belong to a record. Raises InputError if it is none of ours."""
    try:
        if record["format"] != _FORMAT:
            raise ValueError(f"its format is {record['format']!r}, not {_FORMAT!r}")
        return {
            str(name): (jnp.dtype(dtype), tuple(int(size) for size in shape))
            for name, (dtype, shape) in record["layout"].items()
        }
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"the record is broken ({error!r})") from None


def join(record: dict[str, Any], arrays: dict[str, np.ndarray]) -> Packed:
    """Put a record and its arrays together again. Raises InputError if a bit of them is not as it was saved."""
    try:
        packed = Packed(arrays, base64.b64decode(record["batches"], validate=True), str(record["facts"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"the record is broken ({error!r})") from None
    if packed.record() != record:
        raise InputError("the content is not what was saved: the SHA-256 differs")
    return packed


def as_bytes(array: np.ndarray) -> np.ndarray:
    """Return the bytes of an array in C order, as a flat view if it is in that order already."""
    return array.reshape(-1).view(np.uint8)


def from_first_process(make: Callable[[], Packed | None]) -> Packed | None:
    """Return on all processes what `make` returns on the first, or raise what it raises there, elsewhere as InputError.

    All processes must call this; only the first calls `make`.
    """
    packed: Packed | None = None
    own_error: Exception | None = None
    header: dict[str, Any] = {"problem": None, "record": None}
    if jax.process_index() == 0:
        try:
            packed = make()
            header["record"] = None if packed is None or jax.process_count() == 1 else packed.record()
        except Exception as error:  # the others wait to hear of it
            own_error, header["problem"] = error, str(error)
    if jax.process_count() > 1:
        header = json.loads(_broadcast(json.dumps(header).encode()))
        if header["record"] is not None:
            layout = read_layout(header["record"])
            own = b"".join(as_bytes(packed.arrays[name]).tobytes() for name in layout) if packed else b""
            packed = join(header["record"], _split(_broadcast(own), layout))
    if own_error is not None:
        raise own_error
    if header["problem"] is not None:
        raise InputError(header["problem"])
    return packed


def _broadcast(content: bytes) -> bytes:
    """Return the first process's content."""
    # Bytes, since the broadcast is a sum, which turns -0.0 into 0.0 and may touch NaN.
    size = int(multihost_utils.broadcast_one_to_all(np.int32(len(content))))
    own = np.frombuffer(content, np.uint8) if jax.process_index() == 0 else np.zeros(size, np.uint8)
    return np.asarray(multihost_utils.broadcast_one_to_all(own)).tobytes() if size else b""


def _split(content: bytes, layout: dict[str, tuple[np.dtype, tuple[int, ...]]]) -> dict[str, np.ndarray]:
    arrays, start = {}, 0
    for name, (dtype, shape) in layout.items():
        count = int(np.prod(shape, dtype=np.int64))
        arrays[name] = np.frombuffer(content, dtype, count, start).reshape(shape)
        start += count * dtype.itemsize
    return arrays


def _names(state: TrainState) -> list[str]:
    paths = jax.tree_util.tree_flatten_with_path(state)[0]
    return [jax.tree_util.keystr(path, simple=True, separator="/") for path, _ in paths]


def _placed(array: np.ndarray, like: Any) -> jax.Array:
    # Copies: JAX may take an aligned NumPy array as it is, and the next step may be given its memory.
    sharding = getattr(like, "sharding", None)
    if sharding is None or (isinstance(like, jax.Array) and not like.committed):
        return jnp.array(array, copy=True)
    return jax.make_array_from_callback(array.shape, sharding, lambda index: np.array(array[index]))


def _text(content: bytes) -> str:
    return base64.b64encode(content).decode()
