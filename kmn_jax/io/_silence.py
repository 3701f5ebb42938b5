"""Libraries that talk while they read: what matters of it is reported as an error."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import warnings
from collections.abc import Iterator
from contextvars import ContextVar

_silent: ContextVar[bool] = ContextVar("silent", default=False)  # of this thread alone
_one_at_a_time = threading.Lock()


class _WhileNotSilent(logging.Filter):
    def filter(self, record: logging.LogRecord) -> bool:
        return not _silent.get()


_filter = _WhileNotSilent()


@contextlib.contextmanager
def silence(logger: str) -> Iterator[None]:
    """Drop warnings, and what this thread sends to a logger."""
    logging.getLogger(logger).addFilter(_filter)  # which happens once, however often it is asked for
    token = _silent.set(True)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        _silent.reset(token)


@contextlib.contextmanager
def silence_stderr() -> Iterator[None]:
    """Drop what is written to the process's stderr, by C libraries too, and by any thread: keep it short."""
    with _one_at_a_time:
        try:
            before = os.dup(2)
        except OSError:  # there is none
            yield
            return
        try:
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), 2)
            yield
        finally:
            os.dup2(before, 2)
            os.close(before)
