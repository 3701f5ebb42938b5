"""The order of samples: repeatable, complete in every epoch, shared by hosts without overlap, resumed to the batch."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pytest

from kmn_jax.data import BatchIterator, PipelineConfig, SampleBatches, SampleIndex
from kmn_jax.errors import InputError

CONFIG = PipelineConfig(batch_size=6, samples_per_object=8, crops_per_object=2, random_seed=3)
OBJECTS, DROPS = 5, 4
EPOCH = 40  # samples, so 6 full batches and 4 samples


def batches(config: PipelineConfig = CONFIG, **options: Any) -> SampleBatches:
    return SampleBatches(config, OBJECTS, DROPS, **options)


def rows(parts: Iterable[SampleIndex]) -> Iterator[tuple[int, int, tuple[int, int]]]:
    """Yield object, drop and key of each sample."""
    for part in parts:
        for which, drop, key in zip(part.object.tolist(), part.drop.tolist(), part.key.tolist(), strict=True):
            yield which, drop, tuple(key)


def first_epochs(source: SampleBatches, epochs: int) -> list[list[tuple[int, int, tuple[int, int]]]]:
    taken = list(itertools.islice(rows(source[number] for number in range(100)), epochs * EPOCH))
    return [taken[start : start + EPOCH] for start in range(0, len(taken), EPOCH)]


def equal(a: SampleIndex, b: SampleIndex) -> bool:
    return all(x.dtype == y.dtype and np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def test_same_config_gives_same_batches_in_any_order() -> None:
    forwards, backwards = batches(), batches()
    later = [backwards[number] for number in reversed(range(20))][::-1]
    assert all(equal(forwards[number], later[number]) for number in range(20))
    other = batches(PipelineConfig(batch_size=6, samples_per_object=8, crops_per_object=2, random_seed=4))
    assert not set(rows(forwards[number] for number in range(20))) & set(rows(other[number] for number in range(20)))


def test_order_is_the_same_on_every_machine() -> None:
    """Resuming a run elsewhere, or with other versions, must not change it."""
    batch = batches()[7]
    assert batch.object.tolist() == [3, 3, 1, 1, 2, 2]
    assert batch.drop.tolist() == [3, 2, 3, 2, 2, 2]
    assert batch.key[0].tolist() == [18075143, 3465201404]
    assert batch.key[5].tolist() == [843100301, 1026488393]


def test_epochs_hold_every_sample_once_and_differ() -> None:
    epochs = first_epochs(batches(), 3)
    for epoch in epochs:
        assert Counter((which, drop) for which, drop, _ in epoch) == dict.fromkeys(
            itertools.product(range(OBJECTS), range(DROPS)), 2
        )
        assert len({key for _, _, key in epoch}) == EPOCH
    assert len({key for epoch in epochs for _, _, key in epoch}) == 3 * EPOCH
    orders = [[(which, drop) for which, drop, _ in epoch] for epoch in epochs]
    assert orders[0] != orders[1] != orders[2] != orders[0]


def test_groups_share_an_object_and_rounds_show_all() -> None:
    config = PipelineConfig(batch_size=15, samples_per_object=12, crops_per_object=3, random_seed=1)
    for number in range(8):
        objects = batches(config)[number].object.reshape(-1, 3)
        assert (objects == objects[:, :1]).all()
        assert sorted(objects[:, 0]) == list(range(OBJECTS))


def test_order_of_samples_does_not_follow_their_drops() -> None:
    config = PipelineConfig(batch_size=20, samples_per_object=20, random_seed=0)
    source = SampleBatches(config, 1, 20)
    orders = np.stack([source[epoch].drop for epoch in range(200)])
    assert (np.sort(orders, axis=1) == np.arange(20)).all()
    # Every drop comes at every place: 200 draws of 1/20 have a mean of 10 and a deviation of 3.
    counts = np.array([[np.sum(orders[:, place] == drop) for drop in range(20)] for place in range(20)])
    assert counts.min() >= 1
    assert counts.max() <= 25


def test_few_samples_reach_all_drops_over_the_epochs() -> None:
    config = PipelineConfig(batch_size=3, samples_per_object=3)
    source = SampleBatches(config, 1, 20)
    drops = [source[epoch].drop for epoch in range(60)]
    assert set(np.concatenate(drops).tolist()) == set(range(20))
    gaps = [np.diff(np.sort(drop)) for drop in drops]
    assert all(gap.min() >= 6 for gap in gaps)
    ordered = SampleBatches(config, 1, 20, ordered=True)[0].drop
    assert ordered.tolist() == [3, 10, 16]


def test_objects_may_differ_in_drops() -> None:
    source = SampleBatches(PipelineConfig(batch_size=12, samples_per_object=6), 2, [3, 1])
    batch = source[0]
    assert Counter(zip(batch.object.tolist(), batch.drop.tolist(), strict=True)) == {
        (0, 0): 2,
        (0, 1): 2,
        (0, 2): 2,
        (1, 0): 6,
    }


@pytest.mark.parametrize("hosts", [1, 3])
@pytest.mark.parametrize("ordered", [False, True])
def test_hosts_share_each_global_batch(hosts: int, ordered: bool) -> None:
    whole = batches(ordered=ordered)
    shares = [batches(ordered=ordered, shard_index=host, shard_count=hosts) for host in range(hosts)]
    assert {len(share) for share in shares} == {len(whole)}
    for number in range(7):
        joined = SampleIndex(*(np.concatenate(parts) for parts in zip(*(s[number] for s in shares), strict=True)))
        assert equal(joined, whole[number])
        samples = [sample for share in shares for sample in set(rows([share[number]]))]
        assert ordered or len(set(samples)) == len(samples) == 6
        for share in shares:
            assert (np.diff(share[number].object.reshape(-1, 2), axis=1) == 0).all()


def test_ordered_pass_is_finite_fixed_and_padded() -> None:
    source = batches(ordered=True)
    assert (len(source), len(batches())) == (7, sys.maxsize)
    with pytest.raises(IndexError):
        source[7]
    parts = list(BatchIterator(source))
    assert [len(part.mask) for part in parts] == [6] * 7
    mask = np.concatenate([part.mask for part in parts])
    assert mask.tolist() == [True] * EPOCH + [False] * 2
    assert np.concatenate([part.object for part in parts]).tolist() == [*np.repeat(range(5), 8).tolist(), 4, 4]
    assert np.concatenate([part.drop for part in parts])[:8].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    real = list(rows(parts))[:EPOCH]
    assert len({key for _, _, key in real}) == EPOCH
    assert list(rows(parts))[EPOCH:] == real[-1:] * 2
    # Neither batches nor groups decide which samples a validation set has.
    other = PipelineConfig(batch_size=40, samples_per_object=8, random_seed=3)
    assert list(rows([batches(other, ordered=True)[0]])) == real


def test_resumes_with_the_next_batch_from_bytes() -> None:
    wanted = [batches()[number] for number in range(30)]
    first = BatchIterator(batches(), identity="pack 1")
    for number in range(9):  # in the middle of the second epoch
        assert equal(next(first), wanted[number])
    state = json.dumps(json.loads(first.get_state())).encode()
    resumed = BatchIterator(batches(), identity="pack 1")
    resumed.set_state(state)
    assert resumed.next_batch == 9
    for number in range(9, 30):
        assert equal(next(resumed), wanted[number])


def test_state_does_not_count_what_threads_read_ahead() -> None:
    iterator = BatchIterator(batches(), make=lambda index: index.key.sum(), threads=2, ahead=4)
    taken = [next(iterator) for _ in range(5)]
    state = iterator.get_state()
    for _ in range(3):
        next(iterator)
    iterator.set_state(state)
    wanted = [batches()[number].key.sum() for number in range(12)]
    assert taken == wanted[:5]
    assert [next(iterator) for _ in range(7)] == wanted[5:]


def test_state_moves_between_numbers_of_hosts() -> None:
    alone = BatchIterator(batches())
    for _ in range(4):
        next(alone)
    host = BatchIterator(batches(shard_index=2, shard_count=3))
    host.set_state(alone.get_state())
    assert equal(next(host), SampleIndex(*(part[4:] for part in next(alone))))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"random_seed": 4}, "saved with random_seed = 3, but now it is 4"),
        ({"batch_size": 12}, "saved with batch_size = 6, but now it is 12"),
        ({"samples_per_object": 4}, "saved with samples_per_object = 8"),
    ],
)
def test_state_of_another_order_is_refused(change: dict[str, int], message: str) -> None:
    values = {"batch_size": 6, "samples_per_object": 8, "crops_per_object": 2, "random_seed": 3}
    state = BatchIterator(batches()).get_state()
    with pytest.raises(InputError, match=message):
        BatchIterator(batches(PipelineConfig(**{**values, **change}))).set_state(state)


def test_state_of_other_objects_is_refused() -> None:
    iterator = BatchIterator(batches(), identity="a")
    with pytest.raises(InputError, match="saved with identity = b, but now it is a"):
        iterator.set_state(BatchIterator(batches(), identity="b").get_state())
    with pytest.raises(InputError, match="num_drops"):
        iterator.set_state(BatchIterator(SampleBatches(CONFIG, 5, [4, 4, 4, 4, 3]), identity="a").get_state())


@pytest.mark.parametrize(
    "state",
    [
        b"",
        b"[]",
        b"\xff",
        b'{"format": "other"}',
        b'{"format": "kmn_jax batches"}',
        b'{"format": "kmn_jax batches", "next_batch": -1, "facts": {}, "grain": {}}',
    ],
)
def test_broken_state_is_refused(state: bytes) -> None:
    iterator = BatchIterator(batches())
    next(iterator)
    with pytest.raises(InputError, match="saved state of the batches is broken"):
        iterator.set_state(state)
    assert equal(next(iterator), batches()[1])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"batch_size": 0}, "batch_size = 0 must be 1 or more"),
        ({"batch_size": 14, "crops_per_object": 4}, "batch_size = 14 must be a multiple of crops_per_object = 4"),
        ({"batch_size": 9, "crops_per_object": 3}, "samples_per_object = 160 must be a multiple"),
        ({"random_seed": -1}, "random_seed = -1"),
    ],
)
def test_contradictory_configs_are_refused(values: dict[str, int], message: str) -> None:
    with pytest.raises(InputError, match=message):
        PipelineConfig(**values)


def test_impossible_shares_are_refused() -> None:
    with pytest.raises(InputError, match="times the 2 hosts"):
        batches(shard_count=2)
    with pytest.raises(InputError, match="shard_index = 3 must be from 0 to below shard_count = 3"):
        batches(shard_index=3, shard_count=3)
    with pytest.raises(InputError, match="at least one drop"):
        SampleBatches(CONFIG, 2, [3, 0])
    with pytest.raises(InputError, match="at least one object"):
        SampleBatches(CONFIG, 0, 1)


def test_import_does_not_load_grain() -> None:
    program = "import sys, kmn_jax.data._pipeline; print('grain' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout == "False\n"
