"""The one thread that searches, and the bounded queue before it."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from starlette.exceptions import HTTPException

Answer = TypeVar("Answer")
_FORGETTING = 0.2  # weight of the newest job in the mean time of jobs


class Worker:
    """Runs jobs one after the other: on a CPU, two searches at once take longer than one after the other."""

    def __init__(self, most_queued: int, time_limit: float) -> None:
        self._most, self._time_limit = most_queued, time_limit
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="kmn-serve")
        self._mean_s, self._lock = 1.0, threading.Lock()
        self.queued = 0  # that wait or run

    async def run(self, job: Callable[[], Answer], gone: Callable[[], Awaitable[None]]) -> Answer:
        """Return what a job returns.

        Raises HTTPException if the queue is full, or if the time limit passes; then a job that has begun goes on, and
        keeps its place. One that has not begun is forgotten, as it is once the client is `gone`.
        """
        if self.queued >= self._most:
            after = {"Retry-After": str(math.ceil(self.queued * self._mean_s))}
            raise HTTPException(503, f"{self.queued} requests are waiting already: try again later", after)
        future = self.start(job)
        answer, leaving = asyncio.wrap_future(future), asyncio.ensure_future(gone())
        try:
            await asyncio.wait((answer, leaving), timeout=self._time_limit, return_when=asyncio.FIRST_COMPLETED)
            if answer.done():
                return answer.result()
            if leaving.done():
                raise HTTPException(499, "the client has gone")
            raise HTTPException(504, f"no answer within {self._time_limit:g} s: try again later, or narrow it down")
        finally:
            leaving.cancel()
            answer.cancel()

    def start(self, job: Callable[[], Answer]) -> Future[Answer]:
        """Put a job into the queue, however long that is."""
        self._count(1)
        held = [job]  # a job that is cancelled stays in the thread's queue, but not with all that it holds
        future = self._thread.submit(self._timed, held)

        def done(_: Future[Answer]) -> None:
            held.clear()
            self._count(-1)

        future.add_done_callback(done)
        return future

    def close(self) -> None:
        """Forget what has not begun."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _timed(self, held: list[Callable[[], Answer]]) -> Answer:
        start = time.perf_counter()
        try:
            return held.pop()()
        finally:
            self._mean_s += _FORGETTING * (time.perf_counter() - start - self._mean_s)

    def _count(self, more: int) -> None:
        with self._lock:
            self.queued += more
