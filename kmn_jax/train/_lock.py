"""One process a run: two that write to the same folder would mix their checkpoints and metrics."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from kmn_jax.errors import InputError


@contextmanager
def only_one(folder: Path) -> Iterator[None]:
    """Hold a run's folder for this process; it is free again however the process ends.

    File systems and platforms without such locks hold nothing; what is wrong with a folder that cannot be made is told
    by what writes to it. Raises InputError if another process has the folder.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        yield
        return
    try:
        _lock(handle, folder)
        yield
    finally:
        os.close(handle)


def _lock(handle: int, folder: Path) -> None:
    try:
        import fcntl
    except ModuleNotFoundError:  # not on Windows
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno == errno.EWOULDBLOCK:
            raise InputError(f"another process trains in {folder}: wait for it, or choose another folder") from None
