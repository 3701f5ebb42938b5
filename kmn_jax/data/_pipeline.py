"""Which samples a training step sees: deterministic order, shares of hosts, and a state that resumes to the next batch.

The host supplies numbers only (`SampleIndex`); a step makes the scenes of them (`kmn_jax.data._device_pack`), or the
host reads crops of images (`kmn_jax.data._bop_crops`). Every batch is a function of the config and the batch's number:
neither threads nor the number of hosts change it.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Generic, NamedTuple, SupportsIndex, TypeVar

import numpy as np
from jaxtyping import Bool, Int32, Int64, UInt32, UInt64

from kmn_jax.errors import InputError
from kmn_jax.limits import parse_json

_T = TypeVar("_T")
_ROUNDS, _SHUFFLED, _ORDERED = range(3)  # independent streams of random numbers
_STATE = "kmn_jax batches"


@dataclass(frozen=True)
class PipelineConfig:
    """Choose what an epoch is and how it is cut into batches.

    In an epoch every object gives `samples_per_object` samples, spread evenly over its drops. A batch holds
    `batch_size / crops_per_object` groups of samples that share an object.
    """

    batch_size: int = 14  # of all hosts together
    samples_per_object: int = 160  # 20 drops x 8, as published
    crops_per_object: int = 1
    random_seed: int = 0

    def __post_init__(self) -> None:
        each = self.crops_per_object
        for name in ("crops_per_object", "batch_size", "samples_per_object"):
            value = getattr(self, name)
            if value < 1:
                raise InputError(f"pipeline config: {name} = {value} must be 1 or more")
            if value % each:
                raise InputError(f"pipeline config: {name} = {value} must be a multiple of crops_per_object = {each}")
        if not 0 <= self.random_seed < 2**63:
            raise InputError(f"pipeline config: random_seed = {self.random_seed} must be from 0 to 2**63 - 1")

    @property
    def groups_per_object(self) -> int:
        """Groups that an object gives in an epoch."""
        return self.samples_per_object // self.crops_per_object

    @property
    def groups_per_batch(self) -> int:
        """Groups in a batch of all hosts."""
        return self.batch_size // self.crops_per_object


class SampleIndex(NamedTuple):
    """Which scenes a batch shows. The rows of a group, which share an object, follow one another."""

    object: Int32[np.ndarray, " b"]  # row in the pack's arrays; of a frame where frames take the place of objects
    drop: Int32[np.ndarray, " b"]
    key: UInt32[np.ndarray, "b 2"]  # of the sample, to be used as a JAX key
    mask: Bool[np.ndarray, " b"]  # false for padding, which repeats the last sample


class SampleBatches:
    """Batches by their number: a source for grain, or for anybody who indexes it.

    Objects come in rounds: each has its turn before one comes again, so a batch shows as many objects as it has groups,
    except where it spans two rounds. The order differs from round to round, the samples from epoch to epoch.
    Batches span the ends of epochs, so none is lost there.

    With `ordered` there is one epoch, object by object, always of the same samples, and the last batch is padded.
    """

    def __init__(
        self,
        config: PipelineConfig,
        num_objects: int,
        num_drops: int | Sequence[int] | Int32[np.ndarray, " o"],
        shard_index: int = 0,
        shard_count: int = 1,
        ordered: bool = False,
    ) -> None:
        """Take the rows `shard_index` of `shard_count` equal shares of each batch.

        `num_drops` is that of each object or of all. Raises InputError for counts below 1, and batches that the hosts
        cannot share.
        """
        drops = np.full(num_objects, num_drops) if isinstance(num_drops, int) else np.asarray(num_drops)
        if num_objects < 1 or len(drops) != num_objects or drops.min() < 1:
            raise InputError(
                f"{num_objects} objects with {len(drops)} counts of drops: give at least one object, and for each at"
                " least one drop"
            )
        if shard_count < 1 or not 0 <= shard_index < shard_count:
            raise InputError(f"shard_index = {shard_index} must be from 0 to below shard_count = {shard_count}")
        if config.groups_per_batch % shard_count:
            raise InputError(
                f"batch_size = {config.batch_size} must be a multiple of crops_per_object = {config.crops_per_object}"
                f" times the {shard_count} hosts"
            )
        self.config, self.ordered = config, ordered
        self.num_objects, self.num_drops = num_objects, drops.astype(np.int64)
        self.shard_index, self.shard_count = shard_index, shard_count
        groups = num_objects * config.groups_per_object
        self._last_group = groups - 1 if ordered else sys.maxsize
        self._length = -(-groups // config.groups_per_batch) if ordered else sys.maxsize
        self._round: tuple[int, Int64[np.ndarray, " o"]] | None = None

    def __len__(self) -> int:
        """Return the number of batches, sys.maxsize if there is no end."""
        return self._length

    def __getitem__(self, batch: SupportsIndex) -> SampleIndex:
        number, config = int(batch), self.config
        if not 0 <= number < self._length:
            raise IndexError(f"batch {number} of {self._length}")
        count = config.groups_per_batch // self.shard_count
        first = number * config.groups_per_batch + self.shard_index * count
        groups = [self._group(position) for position in range(first, first + count)]
        return SampleIndex(*(np.concatenate(parts) for parts in zip(*groups, strict=True)))

    @property
    def facts(self) -> dict[str, Any]:
        """What the order of the samples depends on."""
        drops = hashlib.sha256(self.num_drops.astype("<i8").tobytes()).hexdigest()
        return {**asdict(self.config), "ordered": self.ordered, "num_objects": self.num_objects, "num_drops": drops}

    def _group(self, position: int) -> SampleIndex:
        config, size = self.config, self.config.crops_per_object
        real = position <= self._last_group
        position = min(position, self._last_group)
        if self.ordered:
            which, part = divmod(position, config.groups_per_object)
            epoch = 0
        else:
            number, place = divmod(position, self.num_objects)
            which = int(self._turns(number)[place])
            epoch, part = divmod(number, config.groups_per_object)
        slots, turn, keys = self._slots(epoch, which)
        rows = slots[part * size : (part + 1) * size]
        # Slots lie evenly on the drops; where they are fewer, the turn gives all drops their chance over the epochs.
        drops = int(self.num_drops[which])
        drop = ((2 * rows + 1) * drops // (2 * config.samples_per_object) + turn) % drops
        if not real:
            rows, drop = rows[[-1] * size], drop[[-1] * size]
        return SampleIndex(np.full(size, which, dtype=np.int32), drop.astype(np.int32), keys[rows], np.full(size, real))

    def _turns(self, number: int) -> Int64[np.ndarray, " o"]:
        """Return the objects in the order of a round."""
        known = self._round
        if known is None or known[0] != number:
            known = number, np.argsort(self._random(_ROUNDS, number, 0, self.num_objects), kind="stable")
            self._round = known
        return known[1]

    def _slots(self, epoch: int, which: int) -> tuple[Int64[np.ndarray, " s"], int, UInt32[np.ndarray, "s 2"]]:
        """Return the order of an object's samples in an epoch, the turn of its drops, and the keys by slot."""
        count = self.config.samples_per_object
        numbers = self._random(_ORDERED if self.ordered else _SHUFFLED, epoch, which, 2 * count + 1)
        halves = numbers[:count] >> np.uint64(32), numbers[:count] & np.uint64(0xFFFFFFFF)
        keys = np.stack(halves, axis=1).astype(np.uint32)
        if self.ordered:
            return np.arange(count), 0, keys
        return np.argsort(numbers[count:-1], kind="stable"), int(numbers[-1] % np.uint64(2**32)), keys

    def _random(self, stream: int, first: int, second: int, count: int) -> UInt64[np.ndarray, " count"]:
        # Bits straight from the counter: unlike the draws of a Generator they are the same in all NumPy versions.
        counter = np.array([0, first, second, 0], dtype=np.uint64)
        key = np.array([self.config.random_seed, stream], dtype=np.uint64)
        return np.random.Philox(counter=counter, key=key).random_raw(count)


class BatchIterator(Generic[_T]):
    """Batches one after the other, read ahead by threads, with a state that can be saved and restored.

    The state tells the batch that comes next. It is the same on all hosts, whatever their number, and does
    not count what was read ahead.
    """

    def __init__(
        self,
        batches: SampleBatches,
        make: Callable[[SampleIndex], _T] | None = None,
        identity: str = "",
        threads: int = 0,
        ahead: int = 2,
    ) -> None:
        """Begin with batch 0; `identity` says what the indices refer to, such as a pack's digest.

        Without `threads` nothing is read ahead; with them at most `ahead` batches are.
        """
        import grain

        self._facts = {"identity": identity, **batches.facts}
        options = grain.ReadOptions(num_threads=threads, prefetch_buffer_size=ahead if threads else 0)
        # Whole batches are its elements: grain takes 0.1 ms for each, its own shuffle milliseconds on short sources.
        dataset = grain.MapDataset.source(batches)
        self._iterator = iter((dataset if make is None else dataset.map(make)).to_iter_dataset(options))
        self._length, self.next_batch = len(batches), 0

    def __iter__(self) -> Iterator[_T]:
        return self

    def __next__(self) -> _T:
        batch: _T = next(self._iterator)
        self.next_batch += 1
        return batch

    def get_state(self) -> bytes:
        """Return the state as JSON."""
        state = {
            "format": _STATE,
            "next_batch": self.next_batch,
            "facts": self._facts,
            "grain": self._iterator.get_state(),
        }
        return json.dumps(state).encode()

    def set_state(self, state: bytes) -> None:
        """Go on where the state was saved. Raises InputError if it is broken or of another order of samples."""
        try:
            values = parse_json(state)
            if values["format"] != _STATE:
                raise ValueError(f"format {values['format']!r}")
            number, facts, inner = int(values["next_batch"]), dict(values["facts"]), dict(values["grain"])
            if not 0 <= number <= self._length:
                raise ValueError(f"next_batch = {number} of {self._length}")
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"the saved state of the batches is broken ({error!r}): take an older one") from None
        for name, value in self._facts.items():
            if facts.get(name) != value:
                raise InputError(
                    f"the batches were saved with {name} = {facts.get(name)}, but now it is {value}: resume with the"
                    " same, or start anew"
                )
        self._iterator.set_state(inner)
        self.next_batch = number
