"""Decoding files in a process of its own: damaged ones can crash the decoder or keep it for ever."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

from kmn_jax.errors import InputError
from kmn_jax.extras import install_command
from kmn_jax.limits import check_bytes, most_bytes

_SECONDS = 300  # files take one or two
_OWN_BYTES = 500_000_000  # of a decoder that decodes nothing, its threads on a large machine included
# The alarm is for the case that nobody is left who waits.
_LIMITS = """
import signal
if hasattr(signal, "alarm"):
    signal.alarm({seconds})
try:
    import resource
    resource.setrlimit(resource.RLIMIT_DATA, ({memory}, {memory}))
    resource.setrlimit(resource.RLIMIT_FSIZE, ({size}, {size}))
except (ImportError, ValueError, OSError):  # not everywhere
    pass
"""


def decoded_apart(content: bytes, program: str, package: str, *arguments: str) -> bytes:
    """Return what a Python program writes to the path `sys.argv[2]` for a file of this content at `sys.argv[1]`.

    Further arguments follow these. What the program prints goes nowhere. Raises InputError, without the file's name,
    if the program fails, which then names its last line of errors, if it takes longer than five minutes or more memory
    than the budget allows, or if the package that it needs is not installed.
    """
    if importlib.util.find_spec(package) is None:
        raise InputError(f"such files need packages that are not installed: {install_command(package)}")
    most = most_bytes()
    limits = _LIMITS.format(seconds=int(_SECONDS) + 60, memory=most + most // 2 + _OWN_BYTES, size=most)
    try:
        with tempfile.TemporaryDirectory() as folder:
            source, target = Path(folder, "source"), Path(folder, "target")
            source.write_bytes(content)
            command = [sys.executable, "-P", "-c", limits + program, str(source), str(target), *arguments]
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, timeout=_SECONDS
            )
            if done.returncode == 0 and target.exists():
                check_bytes(target.stat().st_size)
                return target.read_bytes()
    except subprocess.TimeoutExpired:
        raise InputError(f"its decoding takes longer than {_SECONDS} s: save it in another format") from None
    except OSError as error:
        raise InputError(f"it cannot be decoded: {error}") from None
    said = done.stderr.decode("utf-8", "replace").strip().splitlines()
    reason = said[-1][:120] if said else f"the decoder ended with code {done.returncode}"
    raise InputError(
        f"it is truncated or damaged, holds nothing to read, or takes more than {most} bytes to decode ({reason})"
    )
