"""Stand-ins for readers, with every fault that the suite must see: they are called in its worker processes."""

from __future__ import annotations

import os
import resource
import signal
from pathlib import Path

from tests.attack.cases import Case, Outcome


def misbehave(case: Case, wholes: Path) -> Outcome:
    """Do what the case's number says: crash, take all memory, never end, wait for ever, or nothing."""
    match case.number:
        case 0:
            os.kill(os.getpid(), signal.SIGSEGV)
        case 1:
            _, most = resource.getrlimit(resource.RLIMIT_DATA)
            resource.setrlimit(resource.RLIMIT_DATA, (2**20, most))
            try:
                bytearray(2**30)
            finally:
                resource.setrlimit(resource.RLIMIT_DATA, (most, most))
        case 2:
            signal.setitimer(signal.ITIMER_PROF, 0.01)
            while True:
                pass
        case 3:
            return Outcome(case, "valid", megabytes=5000.0)
        case 4:
            return Outcome(case, "valid", seconds=21.0)
    return Outcome(case, "valid")
