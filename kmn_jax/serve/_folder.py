"""The folder of a server's temporary files, which nobody else can read, and which no server leaves for ever."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from kmn_jax.files import SECONDS_TO_LOCK, lock

_PREFIX = "kmn-serve-"


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """Make a folder that nobody else can read, in which all temporary files of this process go until it is removed.

    Those that servers left that were killed are removed, on systems that can tell.
    """
    before = tempfile.tempdir
    _remove_left_over(Path(tempfile.gettempdir()))
    with tempfile.TemporaryDirectory(prefix=_PREFIX) as folder, _locked(folder):
        tempfile.tempdir = folder
        try:
            yield Path(folder)
        finally:
            tempfile.tempdir = before


@contextlib.contextmanager
def _locked(folder: str) -> Iterator[bool]:
    """Hold a folder for this process, however it ends, and tell whether it is held; on Windows none is."""
    if sys.platform == "win32":
        yield False
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        yield lock(handle)
    finally:
        os.close(handle)


def _remove_left_over(place: Path) -> None:
    """Remove this user's folders that no server holds locked, or made just now and is about to lock."""
    if sys.platform == "win32":
        return
    for folder in place.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):  # another server may be as quick
            facts = folder.lstat()
            own = stat.S_ISDIR(facts.st_mode) and facts.st_uid == os.geteuid()
            if own and time.time() - facts.st_mtime > SECONDS_TO_LOCK:
                with _locked(str(folder)) as is_left:
                    if is_left:
                        shutil.rmtree(folder)
