"""Building a pack from many CAD files: on all cores, object by object, resumable after any interruption.

`journal.jsonl` in the pack's folder is the record: its first line is the recipe, every other one an object that was
built or rejected. Files appear whole, and an object's line follows its files; so whatever ends a build, the next
one goes on after the last line that is whole.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, TimeoutError, wait
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

from kmn_jax.data._pack import VERSION, Entry, read_entry, write_manifest, write_object
from kmn_jax.data._recipe import PackConfig, pack_object
from kmn_jax.errors import InputError, shown
from kmn_jax.files import make_folder
from kmn_jax.limits import parse_json

_T = TypeVar("_T")


@dataclass(frozen=True)
class Source:
    """A CAD file that is to become an object of a pack."""

    name: str
    split: str
    path: Path
    scenes: int = 0  # sources of one file, as of training and validation, have other scenes if this number differs


@dataclass(frozen=True)
class Record:
    """What became of a source. `reason` says why it was rejected; a built one has an entry and facts."""

    name: str
    split: str
    seconds: float
    reason: str | None = None
    entry: Entry | None = None
    facts: dict[str, Any] | None = None


def build_pack(
    folder: str | Path,
    sources: Sequence[Source],
    config: PackConfig,
    *,
    workers: int | None = None,
    minutes_per_object: float = 5.0,
    retry_rejected: bool = False,
    **manifest_facts: Any,
) -> list[Record]:
    """Build a pack in `folder`, or go on with one, and write its manifest; return what became of each source.

    What the journal lists is not made again, unless its files are gone or, with `retry_rejected`, it was rejected. A
    file that is broken, takes too long or crashes its process is rejected, with the reason, and the others go on. The
    manifest lists all that the journal does. Raises InputError if a source's file is missing, or if the folder cannot
    be written to or holds a pack of another recipe.
    """
    from tqdm import tqdm

    workers = (os.cpu_count() or 1) if workers is None else workers
    if workers < 1:
        raise InputError(f"workers = {workers} must be 1 or more")
    paths = dict.fromkeys(Path(source.path) for source in sources)
    missing = [path for path in paths if not path.is_file()]
    if missing:
        what = "is a folder, and no CAD file" if missing[0].is_dir() else "is missing"
        more = f", and {len(missing) - 1} more of {len(paths)} cannot be used" if len(missing) > 1 else ""
        raise InputError(f"{missing[0]} {what}{more}: nothing was built")
    wanted = {source.name: source for source in sources}
    if len(wanted) != len(sources):
        raise InputError(f"{len(sources) - len(wanted)} sources have the name of another: names must differ")
    folder = Path(folder)
    make_folder(folder)
    journal = _Journal(folder / "journal.jsonl", config)
    left = [source for source in sources if not _is_done(folder, journal.records.get(source.name), retry_rejected)]
    bar = tqdm(total=len(sources), initial=len(sources) - len(left), unit="object", mininterval=1, smoothing=0.05)
    for record in _made(folder, left, config, workers, minutes_per_object * 60):
        journal.add(record)
        if record.reason:
            bar.write(f"rejected {record.name}: {record.reason}")
        bar.update()
        if len(journal.records) % 50 == 0:
            _write_manifest(folder, journal, config, manifest_facts)
    bar.close()
    _write_manifest(folder, journal, config, manifest_facts)
    return [journal.records[name] for name in wanted]


def one_thread_a_process() -> None:
    """Let processes started from now on use one core each, so that as many as there are cores fill them."""
    # Libraries read these when they are imported.
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))


def _is_done(folder: Path, record: Record | None, retry_rejected: bool) -> bool:
    if record is None or record.entry is None:
        return record is not None and not retry_rejected
    shards = filter(None, (record.entry.objects, record.entry.visibility))
    return all((folder / shard.path).exists() for shard in shards)


def _write_manifest(folder: Path, journal: _Journal, config: PackConfig, facts: dict[str, Any]) -> None:
    records = [journal.records[name] for name in sorted(journal.records)]
    rejected = [{"name": r.name, "split": r.split, "reason": r.reason} for r in records if r.reason]
    entries = [record.entry for record in records if record.entry]
    write_manifest(folder, entries, recipe=asdict(config), rejected=rejected, **facts)


def _made(folder: Path, sources: list[Source], config: PackConfig, workers: int, seconds: float) -> Any:
    """Yield a record for each source as it is done, from processes that may fail without harm to the others."""
    from pebble import ProcessExpired, ProcessPool

    if not sources:
        return
    one_thread_a_process()
    # Fresh processes now and then give back what readers leak.
    with ProcessPool(workers, max_tasks=50, context=get_context("spawn")) as pool:
        pending: dict[Future[Record], Source] = {}
        queue = iter(sources)
        try:
            while True:
                for source in queue:
                    pending[pool.schedule(_make, (str(folder), source, config), timeout=seconds)] = source
                    if len(pending) >= 2 * workers:
                        break
                if not pending:
                    return
                for future in wait(pending, return_when=FIRST_COMPLETED).done:
                    source = pending.pop(future)
                    try:
                        yield future.result()
                    except TimeoutError:
                        yield Record(source.name, source.split, seconds, f"took over {seconds:.0f} s")
                    except ProcessExpired as error:
                        reason = f"its process ended (exit code {error.exitcode}): the file's reader or physics crashed"
                        yield Record(source.name, source.split, 0.0, reason)
        finally:
            for future in pending:
                future.cancel()
            pool.stop()


def _make(folder: str, source: Source, config: PackConfig) -> Record:
    start = time.perf_counter()
    try:
        item, facts = pack_object(source.path, source.name, source.split, config, source.scenes)
    except InputError as error:
        return Record(source.name, source.split, time.perf_counter() - start, str(error))
    entry = write_object(folder, item)
    return Record(source.name, source.split, time.perf_counter() - start, None, entry, facts)


class _Journal:
    def __init__(self, path: Path, config: PackConfig) -> None:
        self.path = path
        self.records: dict[str, Record] = {}
        recipe = json.dumps({"version": VERSION, **asdict(config)}, sort_keys=True)
        header = {"recipe": hashlib.sha256(recipe.encode()).hexdigest(), "config": asdict(config)}
        lines = path.read_bytes().split(b"\n") if path.exists() else []
        whole = [line for line in lines[:-1] if line]  # what follows the last line's end was cut off
        if whole:
            if self._parsed(whole[0], dict).get("recipe") != header["recipe"]:
                raise InputError(
                    f"{path} records a build by another recipe: choose another folder, or delete {path.parent}"
                )
            for line in whole[1:]:
                record = self._parsed(line, _record)
                self.records[record.name] = record
            with path.open("r+b") as file:
                file.truncate(sum(len(line) + 1 for line in lines[:-1]))
        else:
            path.write_bytes(json.dumps(header).encode() + b"\n")

    def add(self, record: Record) -> None:
        self.records[record.name] = record
        with self.path.open("ab") as file:
            file.write(json.dumps(dataclasses.asdict(record)).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())

    def _parsed(self, line: bytes, make: Callable[[Any], _T]) -> _T:
        try:
            return make(parse_json(line))
        except (ValueError, TypeError, KeyError) as error:
            reason = f"{type(error).__name__}: {shown(error)}"
            raise InputError(f"{self.path} is damaged ({reason}): delete {self.path.parent} and build again") from None


def _record(fields: dict[str, Any]) -> Record:
    entry = fields["entry"]
    record = Record(**{**fields, "entry": read_entry(entry) if entry else None})
    if not all(isinstance(text, str) for text in (record.name, record.split, record.reason or "")):
        raise TypeError("a name, split or reason is no text")
    json.dumps(fields, allow_nan=False)  # ValueError for numbers that are not finite
    return record
