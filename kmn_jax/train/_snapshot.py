"""What a run needs to go on, as one unit, and the form it is stored in: named arrays and a record for JSON."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from kmn_jax.errors import InputError
from kmn_jax.limits import parse_json
from kmn_jax.train._step import TrainState

_FORMAT = "kmn_jax snapshot 1"


@dataclass(frozen=True)
class Snapshot:
    """A run between two steps."""

    state: TrainState
    batches: bytes  # `BatchIterator.get_state()`
    facts: dict[str, Any]  # what JSON can hold: config, metrics so far, samples seen, seconds, commit, versions


class Packed(NamedTuple):
    """A snapshot on the host."""

    arrays: dict[str, np.ndarray]  # by their place in the state, such as `parameters/head/kernel`
    record: dict[str, Any]  # all else, as JSON


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
    on_host = [np.asarray(leaf, order="C") for leaf in jax.device_get(leaves)]
    arrays = dict(zip(_names(snapshot.state), on_host, strict=True))
    layout = {name: [array.dtype.name, list(array.shape)] for name, array in arrays.items()}
    batches = base64.b64encode(snapshot.batches).decode()
    return Packed(arrays, {"format": _FORMAT, "layout": layout, "batches": batches, "facts": facts})


def unpack(packed: Packed, like: TrainState) -> Snapshot:
    """Return the snapshot with the structure and the shardings of `like`, which may be abstract.

    Leaves without a sharding go to the default device. `check_fit` tells before whether they belong together.
    """
    leaves, structure = jax.tree.flatten(like)
    placed = [_placed(packed.arrays[name], leaf) for name, leaf in zip(_names(like), leaves, strict=True)]
    state = jax.tree.unflatten(structure, placed)
    return Snapshot(state, base64.b64decode(packed.record["batches"]), parse_json(packed.record["facts"]))


def check_fit(record: dict[str, Any], like: TrainState) -> None:
    """Raise InputError if a record is of another version of kmn_jax, or its arrays are not those of such a state."""
    if record["format"] != _FORMAT:
        raise InputError(f"its format is {record['format']!r}, not {_FORMAT!r}")
    layout, leaves = record["layout"], jax.tree.leaves(like)
    wanted = {name: [leaf.dtype.name, list(leaf.shape)] for name, leaf in zip(_names(like), leaves, strict=True)}
    problems = [f"{name} is missing" for name in wanted if name not in layout]
    problems += [f"{name} is unknown" for name in layout if name not in wanted]
    problems += [
        "{} is {}{} instead of {}{}".format(name, *found, *wanted[name])
        for name, found in layout.items()
        if found != wanted.get(name, found)
    ]
    if problems:
        more = f" and {len(problems) - 4} more" if len(problems) > 4 else ""
        raise InputError(
            f"the saved state is of another network or optimizer ({'; '.join(problems[:4])}{more}): use the config"
            " that it was saved with"
        )


def _names(state: TrainState) -> list[str]:
    paths = jax.tree_util.tree_flatten_with_path(state)[0]
    return [jax.tree_util.keystr(path, simple=True, separator="/") for path, _ in paths]


def _placed(array: np.ndarray, like: Any) -> jax.Array:
    # Copies: JAX may take an aligned NumPy array as it is, and the next step may be given its memory.
    sharding = getattr(like, "sharding", None)
    if sharding is None or (isinstance(like, jax.Array) and not like.committed):
        return jnp.array(array, copy=True)
    return jax.make_array_from_callback(array.shape, sharding, lambda index: np.array(array[index]))
