"""Running cases in worker processes with limits of time and memory, kept warm, replaced when they die."""

from __future__ import annotations

import multiprocessing
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, TimeoutError, wait
from dataclasses import replace
from pathlib import Path

from pebble import ProcessExpired, ProcessPool

from tests.attack.cases import BYTES, SECONDS, WAIT, Case, Outcome, judge, limit_memory, whole_folders

_CASES_A_WORKER = 2000  # then a fresh one: readers leak


Judge = Callable[[Case, Path], Outcome]


def outcomes(cases: Sequence[Case], workers: int = 2, judged: Judge = judge) -> Iterator[Outcome]:
    """Yield what comes of cases, as they are done. A case over a limit costs its worker only."""
    with tempfile.TemporaryDirectory(prefix="attack-") as folder:
        wholes = whole_folders(Path(folder), dict.fromkeys(case.target for case in cases))
        yield from _outcomes(cases, workers, wholes, judged)


def _outcomes(cases: Sequence[Case], workers: int, wholes: Path, judged: Judge) -> Iterator[Outcome]:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.attack.cases", "open3d", "trimesh", "OpenEXR", "orbax.checkpoint"])
    queue, pending = iter(cases), dict[Future[Outcome], Case]()
    with ProcessPool(workers, max_tasks=_CASES_A_WORKER, initializer=limit_memory, context=context) as pool:
        try:
            while True:
                while len(pending) < 4 * workers and (case := next(queue, None)) is not None:
                    pending[pool.schedule(judged, (case, wholes), timeout=WAIT)] = case
                if not pending:
                    return
                for future in wait(pending, return_when=FIRST_COMPLETED).done:
                    yield _outcome(future, pending.pop(future))
        finally:
            for future in pending:
                future.cancel()
            pool.stop()


def _outcome(future: Future[Outcome], case: Case) -> Outcome:
    try:
        found = future.result()
    except TimeoutError:
        return Outcome(case, "timeout", f"waited over {WAIT} s", WAIT)
    except MemoryError:
        return Outcome(case, "memory", "took more than is allowed")
    except ProcessExpired as error:
        if error.exitcode == -signal.SIGPROF:
            return Outcome(case, "timeout", f"took over {SECONDS} s", SECONDS)
        return Outcome(case, "crash", f"the process ended with code {error.exitcode}")
    if found.seconds > SECONDS:
        return replace(found, kind="timeout", said=f"took {found.seconds:.0f} s")
    if found.megabytes * 2**20 > BYTES:
        return replace(found, kind="memory", said=f"took {found.megabytes:.0f} MB")
    return found
