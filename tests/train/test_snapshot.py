from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.train._snapshot import join, pack, unpack
from tests.train.snapshot_sample import abstract_state, assert_same, random_snapshot

KERNEL = "parameters/head/context_pair/kernel/value"

Arrays = dict[str, np.ndarray]


def change_bit(arrays: Arrays, record: dict[str, Any]) -> None:
    arrays[KERNEL] = arrays[KERNEL].copy()
    arrays[KERNEL].view(np.uint8)[0, 0] ^= 1


def change_dtype(arrays: Arrays, record: dict[str, Any]) -> None:
    arrays[KERNEL] = arrays[KERNEL].view(np.int32)


def change_shape(arrays: Arrays, record: dict[str, Any]) -> None:
    arrays[KERNEL] = arrays[KERNEL].reshape(-1)


def exchange(arrays: Arrays, record: dict[str, Any]) -> None:
    other = KERNEL.replace("parameters", "average")
    arrays[KERNEL], arrays[other] = arrays[other], arrays[KERNEL]


def lose(arrays: Arrays, record: dict[str, Any]) -> None:
    del arrays[KERNEL]


def change_facts(arrays: Arrays, record: dict[str, Any]) -> None:
    record["facts"] = record["facts"].replace("tiny", "tina")


def change_batches(arrays: Arrays, record: dict[str, Any]) -> None:
    record["batches"] = record["batches"].swapcase()


def change_layout(arrays: Arrays, record: dict[str, Any]) -> None:
    record["layout"][KERNEL][1].reverse()


def lose_batches(arrays: Arrays, record: dict[str, Any]) -> None:
    del record["batches"]


CHANGES = [
    change_bit,
    change_dtype,
    change_shape,
    exchange,
    lose,
    change_facts,
    change_batches,
    change_layout,
    lose_batches,
]


@pytest.mark.parametrize("change", CHANGES)
def test_every_part_is_under_the_digest(change: Callable[[Arrays, dict[str, Any]], None]) -> None:
    packed = pack(random_snapshot(1))
    arrays, record = dict(packed.arrays), json.loads(json.dumps(packed.record()))
    assert_same(unpack(join(record, arrays), abstract_state()), random_snapshot(1))
    change(arrays, record)
    with pytest.raises(InputError, match=r"the SHA-256 differs|the record is broken \(KeyError\('batches'\)\)"):
        join(record, arrays)


def test_misfits_are_named() -> None:
    packed = pack(random_snapshot(1))
    with pytest.raises(InputError, match=r"optimizer/1/0/count is missing; .* and \d+ more"):
        unpack(packed, abstract_state(clip_norm=0.0))
    packed.arrays[KERNEL] = packed.arrays[KERNEL].view(np.int32)
    packed.arrays["step"] = packed.arrays["step"][None]
    with pytest.raises(InputError, match=rf"step is int32\[1\] instead of int32\[\]; {KERNEL} is int32"):
        unpack(packed, abstract_state())
