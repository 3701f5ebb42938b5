"""When a run ends early: a signal, or its time is up."""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType, TracebackType

from kmn_jax.errors import InputError

_SIGNALS = (signal.SIGTERM, signal.SIGINT)


class StopRequest:
    """Notices SIGTERM, SIGINT and the end of the time given, within a `with` block of the main thread.

    The run asks for `reason` between steps. A second SIGINT raises KeyboardInterrupt.
    """

    def __init__(self, max_minutes: float | None = None) -> None:
        """Begin to count the time. Raises InputError if it is negative."""
        if max_minutes is not None and not max_minutes >= 0:
            raise InputError(f"max_minutes = {max_minutes} must not be negative")
        self._end = None if max_minutes is None else time.monotonic() + 60 * max_minutes
        self._minutes, self._received = max_minutes, ""
        self._before: dict[signal.Signals, signal._HANDLER] = {}

    @property
    def reason(self) -> str:
        """Why to stop; empty if there is no reason to."""
        if self._received:
            return self._received
        if self._end is not None and time.monotonic() >= self._end:
            return f"{self._minutes:g} minutes are over"
        return ""

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._receive) for number in _SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self._received = f"{signal.Signals(number).name} came"
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.default_int_handler)
