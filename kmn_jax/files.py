"""Writing files that appear complete or not at all; safetensors files."""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import stat
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from kmn_jax.errors import InputError, shown
from kmn_jax.limits import check_bytes, parse_json

if sys.platform != "win32":
    import fcntl

SECONDS_TO_LOCK = 2.0  # that a process may take from making a file to locking it


def write_whole(path: str | Path, content: bytes) -> None:
    """Write `content` beside `path` and move it there in one step.

    An existing file is replaced and its mode kept, a link followed; devices and pipes are written to. What a process
    that was killed left of an earlier attempt, `.NAME.` and 16 digits, is removed, on systems that can tell.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """
    target = Path(os.path.realpath(path))
    try:
        mode = os.stat(path).st_mode if os.path.exists(path) else None
        if mode is not None and not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            Path(path).write_bytes(content)  # by its own name: pipes such as /dev/stdout have no other
            return
        _remove_left_over(target)
        temporary = target.with_name(f".{_start_of(target)}.{secrets.token_hex(8)}")
        try:
            with temporary.open("xb") as file:  # under the user's umask
                lock(file)
                if mode is not None:
                    temporary.chmod(stat.S_IMODE(mode))
                file.write(content)
                file.flush() if sys.platform != "win32" else file.close()  # which moves no open file
                temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it, if it is not there. Raises InputError if there can be none."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be written to: {error.strerror}") from None


def _remove_left_over(target: Path) -> None:
    """Remove temporary files of a target that no process holds locked, or made just now and is about to lock."""
    name = re.compile(rf"\.{re.escape(_start_of(target))}\.[0-9a-f]{{16}}")
    with contextlib.suppress(OSError):  # another process may be as quick, and not every folder can be listed
        with os.scandir(target.parent) as entries:
            left = [entry for entry in entries if name.fullmatch(entry.name) and entry.is_file(follow_symlinks=False)]
        for entry in left:
            if time.time() - entry.stat(follow_symlinks=False).st_mtime > SECONDS_TO_LOCK:
                with open(entry.path, "rb") as file:
                    if lock(file):
                        os.unlink(entry.path)


def _start_of(target: Path) -> str:
    """Return as much of a target's name as leaves room for more: file systems count bytes."""
    return os.fsdecode(os.fsencode(target.name)[:100])


def lock(file: BinaryIO | int) -> bool:
    """Lock a file, or a folder by its handle, until it is closed or its process ends; tell whether it worked."""
    if sys.platform == "win32":
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def check_inputs(*paths: Path | None) -> None:
    """Raise InputError if a file to read is missing: before the time is taken to read the others."""
    for path in paths:
        if path is None or "\0" in str(path):  # of which the reader tells
            continue
        try:
            os.stat(path)
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}") from None


def check_outputs(paths: Iterable[Path | None], *read: Path | None) -> None:
    """Raise InputError if a file cannot be written, is one of those that are `read`, or is to hold two results."""
    named: set[str] = set()
    for path in paths:
        if path is None:
            continue
        try:
            is_file = _check_place(path)
        except OSError as error:
            raise InputError(f"cannot write {path}: {error.strerror}") from None
        sources = (source for source in read if source is not None and os.path.exists(source))
        if os.path.exists(path) and any(os.path.samefile(source, path) for source in sources):
            raise InputError(f"cannot write {path}: it is read, too, and would be lost; name another file")
        target = os.path.realpath(path)
        if is_file and target in named:
            raise InputError(f"cannot write {path}: it is to hold another result, too; name another file")
        named.add(target)


def _check_place(path: Path) -> bool:
    """Tell whether a path is that of a file, which may not exist, and not of a device or pipe.

    Raises InputError or OSError if there can be none.
    """
    is_other = os.path.exists(path) and not (path.is_file() or path.is_dir())
    target = Path(os.path.realpath(path))
    if not is_other and not target.parent.is_dir():
        raise InputError(f"cannot write {path}: its folder does not exist")
    if target.is_dir():
        raise InputError(f"cannot write {path}: it is a folder")
    if not os.access(path if is_other else target.parent, os.W_OK):
        raise InputError(f"cannot write {path}: no permission")
    return not is_other


def safetensors_bytes(tensors: dict[str, np.ndarray], metadata: dict[str, str] | None = None) -> bytes:
    """Return the content of a .safetensors file: the same tensors and metadata make the same bytes."""
    metadata = metadata if tensors else metadata or None  # of nothing at all, the library writes no JSON
    content = save({name: np.ascontiguousarray(array) for name, array in tensors.items()}, metadata)
    start = 8 + int.from_bytes(content[:8], "little")
    header = parse_json(content[8:start])
    if metadata:  # which come in no order
        header["__metadata__"] = dict(sorted(metadata.items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + content[start:]


def read_safetensors(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return tensors and header of a .safetensors file, or raise InputError, also for one beyond the budget."""
    try:
        if Path(path).exists() and not Path(path).is_file():
            raise InputError("it is not a regular file")
        check_bytes(os.stat(path).st_size)
    except InputError as error:
        raise InputError(f"{path} cannot be used: {error}") from None
    except (OSError, ValueError):
        pass  # which is told below
    try:
        with safe_open(str(path), "np") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (not a mapping)
            return tensors, file.metadata() or {}
    except (SafetensorError, OSError, AttributeError, TypeError) as error:  # the latter two: dtypes NumPy lacks
        raise InputError(f"{path} is not a readable safetensors file: {shown(error)}") from None
