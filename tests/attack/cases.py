"""One case: a damaged file, made of the name of a format and a number, and what its reader makes of it."""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from random import Random
from typing import Any

import jax
import numpy as np

from kmn_jax.errors import InputError
from tests.attack.bombs import bombs
from tests.attack.mutations import mutated_bytes
from tests.attack.targets import Target, targets

SECONDS, BYTES = 20, 4 * 2**30  # of the processor, so that a busy machine fails nothing; and of memory
WAIT = 6 * SECONDS  # of the clock, for a case that does nothing
GOOD = ("valid", "InputError")
BAD = ("exception", "not finite", "message", "printed", "memory", "timeout", "crash")
_LONGEST = 2000  # characters of a sentence


@dataclass(frozen=True)
class Case:
    """The damage of a format that a number and a seed stand for."""

    target: str
    number: int
    seed: int = 0

    def __str__(self) -> str:
        return f"{self.target}:{self.number}:{self.seed}"


@dataclass(frozen=True)
class Outcome:
    """What a reader made of a case: one of GOOD or BAD, in which words, and what it took."""

    case: Case
    kind: str
    said: str = ""
    seconds: float = 0.0  # of the processor
    megabytes: float = 0.0  # of the process, and of those that it started, above what it had before
    where: str = ""  # of an exception: the innermost place in the package


def damaged(case: Case, folder: Path) -> Path:
    """Damage a file in a folder of valid ones, and return its path."""
    target, random = targets()[case.target], Random(str(case))
    special = bombs().get(case.target, ())
    files = sorted({path for pattern in target.files for path in folder.glob(pattern) if path.is_file()})
    path = random.choice(files)
    if case.number < len(special):
        content = special[case.number]()
    else:
        means = (mutated_bytes, *target.mutations)
        content = random.choice(means)(path.read_bytes(), random)
    path.write_bytes(content)
    if target.sign is not None and random.random() < 0.8:
        with contextlib.suppress(ValueError, KeyError, TypeError, AttributeError, OSError, RecursionError):
            target.sign(folder, path)
    return path


def judge(case: Case, wholes: Path) -> Outcome:
    """Read a damaged file in this process and tell what came of it; `wholes` has a folder of valid files a format.

    A process that takes SECONDS of the processor is ended by SIGPROF.
    """
    target = targets()[case.target]
    with _folder(wholes / case.target) as folder, _silence() as printed:
        path = damaged(case, folder)
        before, start = _peak(reset=True), _processor_seconds()
        children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        kind, said, where = _read(target, folder, path)
        signal.setitimer(signal.ITIMER_PROF, 0)
        seconds, after = _processor_seconds() - start, _peak()
        grown = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        if grown > children:  # the largest of all that ever were
            after = max(after, before + grown)
        sys.stdout.flush()
        sys.stderr.flush()
        if kind in GOOD and os.fstat(printed).st_size:
            kind, said = "printed", os.pread(printed, _LONGEST, 0).decode("utf-8", "replace").strip()
    return Outcome(case, kind, said[:_LONGEST], round(seconds, 3), round(after - before, 1), where)


def as_row(outcome: Outcome) -> dict[str, Any]:
    """Return an outcome for JSON, with the command that shows it again."""
    return {**asdict(outcome), "case": str(outcome.case), "replay": f"python -m tests.attack --replay {outcome.case}"}


def _read(target: Target, folder: Path, path: Path) -> tuple[str, str, str]:
    try:
        value = target.read(folder, path)
    except InputError as error:
        said = str(error)
        if "does not fit into memory" in said:
            return "memory", said, ""
        whole = said and "\n" not in said and len(said) < _LONGEST
        return "InputError" if whole else "message", said, ""
    except MemoryError as error:
        return "memory", f"MemoryError: {error}", _place(error)
    except Exception as error:
        return "exception", f"{type(error).__name__}: {error}", _place(error)
    return ("valid", "", "") if _is_finite(value) else ("not finite", "NaN or infinity in what was read", "")


def _place(error: BaseException) -> str:
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "/tests/attack/" not in frame.filename]
    own = [frame for frame in frames if "/kmn_jax/" in frame.filename or "/experiments/" in frame.filename] or frames
    return f"{Path(own[-1].filename).name}:{own[-1].lineno} {own[-1].name}" if own else ""


def _is_finite(value: Any) -> bool:
    """Tell whether no number at any depth is NaN or infinite."""
    if isinstance(value, np.ndarray | jax.Array):
        return value.dtype.kind not in "fc" or bool(np.isfinite(np.asarray(value, dtype=np.float64)).all())
    if isinstance(value, float):
        return bool(np.isfinite(value))
    if is_dataclass(value) and not isinstance(value, type):
        return all(_is_finite(getattr(value, field.name)) for field in fields(value))
    if isinstance(value, dict):
        return all(map(_is_finite, value.values()))
    if isinstance(value, tuple | list | set):
        return all(map(_is_finite, value))
    if type(value).__name__ == "State":  # of flax
        return all(map(_is_finite, jax.tree.leaves(value)))
    return True


def whole_folders(folder: Path, names: Iterable[str]) -> Path:
    """Write a folder of valid files for each format."""
    for name in names:
        (folder / name).mkdir()
        targets()[name].prepare(folder / name)
    return folder


@contextlib.contextmanager
def _folder(whole: Path) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="attack-") as folder:
        yield Path(shutil.copytree(whole, folder, dirs_exist_ok=True))


def _processor_seconds() -> float:
    own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime


@contextlib.contextmanager
def _silence() -> Iterator[int]:
    """Send what this process and those that it starts print to a file, whose descriptor it yields."""
    with tempfile.TemporaryFile() as file:
        kept = [os.dup(number) for number in (1, 2)]
        try:
            for number in (1, 2):
                os.dup2(file.fileno(), number)
            yield file.fileno()
        finally:
            for number, old in zip((1, 2), kept, strict=True):
                os.dup2(old, number)
                os.close(old)


def _peak(reset: bool = False) -> float:
    """Return the most memory that this process had since the last reset, in MB; 0 where the system does not tell."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0.0
    return float(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 1024


def limit_memory() -> None:
    """Let this process, and those that it starts, take BYTES more than this one has: beyond, allocations fail."""
    lines = Path("/proc/self/status").read_text().splitlines()
    held = 1024 * int(next(line.split()[1] for line in lines if line.startswith("VmData")))
    resource.setrlimit(resource.RLIMIT_DATA, (held + BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
