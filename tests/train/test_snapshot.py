from __future__ import annotations

import pytest

from kmn_jax.errors import InputError
from kmn_jax.train._snapshot import check_fit, pack
from tests.train.snapshot_sample import abstract_state, random_snapshot

KERNEL = "parameters/head/context_pair/kernel/value"


def test_misfits_are_named() -> None:
    record = pack(random_snapshot(1)).record
    check_fit(record, abstract_state())
    with pytest.raises(InputError, match=r"optimizer/1/0/count is missing; .* and \d+ more"):
        check_fit(record, abstract_state(clip_norm=0.0))
    record["layout"] |= {KERNEL: ["int32", record["layout"][KERNEL][1]], "step": ["int32", [1]]}
    with pytest.raises(InputError, match=rf"step is int32\[1\] instead of int32\[\]; {KERNEL} is int32"):
        check_fit(record, abstract_state())
