"""Checkpoints of a run: written whole or not at all, checked when read. The only file that knows orbax."""

from __future__ import annotations

import hashlib
import json
import logging
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kmn_jax.errors import InputError
from kmn_jax.limits import parse_json
from kmn_jax.train._sharding import from_first_process
from kmn_jax.train._snapshot import Packed, Snapshot, check_fit, pack, unpack
from kmn_jax.train._step import TrainState

_NAME = re.compile(r"step-(\d{8,})(?:-(\d+))?(-best)?")
_STATE, _RECORD = "state", "record.json"
_KEPT = 2  # of the latest, beside the best one


class Checkpoints:
    """The latest snapshots of a run and the best one, in a folder of their own.

    A process that is killed at any moment leaves the snapshots that were there. Each carries the SHA-256 of all of its
    files, which are checked when it is read: a damaged one is reported, and the one before is used.

    If a run has several processes, all call the same methods at the same steps, and the first one alone reads and
    writes the folder.
    """

    def __init__(self, folder: str | Path, report: Callable[[str], None] = print) -> None:
        """Use `folder`, which need not exist yet; `report` is told what was skipped and why."""
        self.folder, self._report = Path(folder).absolute(), report
        self._damaged: set[str] = set()  # names of checkpoints that could not be read

    @property
    def steps(self) -> list[int]:
        """Steps of which there is a checkpoint, damaged or not, in order."""
        return sorted({entry.step for entry in self._entries()})

    def save(self, snapshot: Snapshot, best: bool = False) -> None:
        """Write a snapshot, then remove those that are neither the two latest nor the latest that was `best`.

        Checkpoints that this object found damaged are removed too. One of the same step is replaced.

        Raises:
            InputError: the folder cannot be written to or holds a later checkpoint that is not known to be damaged.
        """
        packed = pack(snapshot)
        from_first_process(lambda: self._write(packed, best))

    def latest(self, like: TrainState) -> Snapshot | None:
        """Return the newest snapshot that is whole, or None; its arrays are placed as those of `like`.

        `like` is a state of the same config, concrete or abstract (`jax.eval_shape`); abstract leaves may have
        shardings, of other devices than it was saved from.

        Raises:
            InputError: it is whole, but of another network or optimizer than `like`, or of another version of kmn_jax.
        """
        return self._restored(like, best=False)

    def best(self, like: TrainState) -> Snapshot | None:
        """Return the newest snapshot that was saved as the best and is whole, in the manner of `latest`."""
        return self._restored(like, best=True)

    def _restored(self, like: TrainState, best: bool) -> Snapshot | None:
        packed = from_first_process(lambda: self._newest(like, best))
        return None if packed is None else unpack(packed, like)

    def _newest(self, like: TrainState, best: bool) -> Packed | None:
        undecoded: dict[str, str] = {}  # what was read as it was written, by name
        for path in [] if best else self._leftovers():
            self._report(f"{path} was not finished and is not used")
        for entry in self._entries():
            if best and not entry.best:
                continue
            try:
                record = _checked_record(entry.path)
            except Exception as error:  # whatever damage leads to
                self._damaged.add(entry.path.name)
                self._report(f"{entry.path} is damaged and is not used: {_reason(error)}")
                continue
            try:
                check_fit(record, like)
            except InputError as error:
                raise InputError(f"{entry.path}: {error}") from None
            try:
                arrays = _read_arrays(entry.path, record["layout"])
            except ImportError:
                raise
            except Exception as error:  # orbax has no error of its own
                undecoded[entry.path.name] = _reason(error)
                self._report(f"{entry.path} cannot be decoded and is not used: {_reason(error)}")
                continue
            self._damaged |= undecoded.keys()
            return Packed(arrays, record)
        if undecoded:  # none of them: then it is not they that are at fault
            name, reason = next(iter(undecoded.items()))
            raise InputError(f"{self.folder / name} is as it was written, but cannot be decoded: {reason}")
        return None

    def _write(self, packed: Packed, best: bool) -> None:
        step, entries = int(packed.arrays["step"]), self._entries()
        for entry in entries:
            if entry.step > step and entry.path.name not in self._damaged:
                raise InputError(
                    f"{self.folder} holds a checkpoint of step {entry.step}, later than step {step} that is to be"
                    " saved: resume from there, or choose another folder"
                )
        again = [entry.edition + 1 for entry in entries if entry.step == step]
        name = f"step-{step:08d}" + (f"-{max(again)}" if again else "") + ("-best" if best else "")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for path in self._leftovers():
                _remove(path)
            _save(self.folder / name, packed)
            self._prune()
        except (OSError, ValueError) as error:  # the latter is how orbax reports a full disk
            raise InputError(f"cannot save step {step} to {self.folder}: {error}") from None

    def _prune(self) -> None:
        entries = self._entries()
        whole = [entry for entry in entries if entry.path.name not in self._damaged]
        newest = {entry.step: entry for entry in reversed(whole)}  # the last edition of each step
        kept = {newest[step].path for step in sorted(newest)[-_KEPT:]}
        kept |= {entry.path for entry in [entry for entry in whole if entry.best][:1]}
        for entry in entries:
            if entry.path not in kept:
                # Half of a removed one must not look like a damaged one.
                aside = entry.path.with_name(f".{entry.path.name}")
                entry.path.rename(aside)
                _remove(aside)

    def _entries(self) -> list[_Entry]:
        """Return the checkpoints, newest first."""
        found = []
        for path in self._paths():
            match = _NAME.fullmatch(path.name)
            if match:
                found.append(_Entry(int(match[1]), int(match[2] or 0), match[3] is not None, path))
        return sorted(found, key=lambda entry: (entry.step, entry.edition, entry.best), reverse=True)

    def _leftovers(self) -> list[Path]:
        """Return what writes and removals that were interrupted left."""
        return [path for path in self._paths() if not _NAME.fullmatch(path.name) and _NAME.match(path.name.lstrip("."))]

    def _paths(self) -> list[Path]:
        try:
            return sorted(self.folder.iterdir())
        except FileNotFoundError:
            return []
        except OSError as error:
            raise InputError(f"cannot read the folder of checkpoints {self.folder}: {error.strerror}") from None


@dataclass(frozen=True)
class _Entry:
    step: int
    edition: int  # counts the saves of this step
    best: bool
    path: Path


def _reason(error: Exception) -> str:
    return str(error).strip().partition("\n")[0][:300] or type(error).__name__


def _save(path: Path, packed: Packed) -> None:
    import orbax.checkpoint as ocp

    staging = path.with_name(f".{path.name}")
    staging.mkdir()
    arrays = {name: array for name, array in packed.arrays.items() if array.size}  # orbax refuses empty ones
    with _silent_threads(), _checkpointer() as checkpointer:
        checkpointer.save(staging / _STATE, args=ocp.args.PyTreeSave(arrays))
    files = {str(file.relative_to(staging)): _sha256(file) for file in sorted(staging.rglob("*")) if file.is_file()}
    content = json.dumps({"record": packed.record, "files": files})
    stored = {"sha256": hashlib.sha256(content.encode()).hexdigest(), "content": content}
    (staging / _RECORD).write_text(json.dumps(stored), encoding="utf-8")
    staging.rename(path)


@contextmanager
def _silent_threads() -> Iterator[None]:
    """Let orbax's threads log no tracebacks of what is raised to the caller, too."""
    log = logging.getLogger("absl")  # which ignores that it is disabled
    log.addFilter(_nothing)
    try:
        yield
    finally:
        log.removeFilter(_nothing)


def _nothing(_: logging.LogRecord) -> bool:
    return False


def _checked_record(path: Path) -> dict[str, Any]:
    """Return the record of a checkpoint, all of whose files are as they were written; else raise any error."""
    stored = parse_json((path / _RECORD).read_text(encoding="utf-8"))
    if hashlib.sha256(stored["content"].encode()).hexdigest() != stored["sha256"]:
        raise InputError(f"{_RECORD} is not what was written: its SHA-256 differs")
    content = parse_json(stored["content"])
    for name, digest in content["files"].items():
        if _sha256(path / name) != digest:
            raise InputError(f"{name} is not what was written: its SHA-256 differs")
    record: dict[str, Any] = content["record"]
    return record


def _read_arrays(path: Path, layout: dict[str, Any]) -> dict[str, np.ndarray]:
    import orbax.checkpoint as ocp

    _check_arrays(path / _STATE)
    arrays = {name: np.zeros(shape, jnp.dtype(dtype)) for name, (dtype, shape) in layout.items() if 0 in shape}
    wanted = {name: ocp.RestoreArgs(restore_type=np.ndarray) for name in layout if name not in arrays}
    with _checkpointer() as checkpointer:
        return arrays | checkpointer.restore(path / _STATE, args=ocp.args.PyTreeRestore(restore_args=wanted))


def _check_arrays(path: Path) -> None:
    """Raise any error if an array that orbax is going to read cannot be decoded.

    Once one has failed there, those that come later print tracebacks from its threads.
    """
    import tensorstore

    place, shared = {"driver": "ocdbt", "base": f"{path.as_uri()}/"}, tensorstore.Context()  # of the list of files
    keys = tensorstore.KvStore.open(place, context=shared).result().list().result()
    folders = [key.decode().removesuffix(".zarray") for key in keys if key.endswith(b"/.zarray")]
    opened = [
        tensorstore.open({"driver": "zarr", "kvstore": {**place, "path": folder}}, context=shared) for folder in folders
    ]
    for array in [array.result().read() for array in opened]:
        array.result()


def _checkpointer() -> Any:
    import orbax.checkpoint as ocp

    # Of this process alone: orbax would have the others wait for it, also when it fails.
    own = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=own, active_processes={own}, barrier_sync_key_prefix="kmn_jax"
    )
    handler = ocp.PyTreeCheckpointHandler(multiprocessing_options=alone)
    return ocp.Checkpointer(handler, multiprocessing_options=alone)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
