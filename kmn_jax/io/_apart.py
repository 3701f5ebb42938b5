"""Decoding files in a process of its own: damaged ones can crash the decoder or keep it for ever."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

from kmn_jax.errors import InputError

_SECONDS = 300  # files take one or two


def decoded_apart(content: bytes, program: str, package: str, *arguments: str) -> bytes:
    """Return what a Python program writes to the path `sys.argv[2]` for a file of this content at `sys.argv[1]`.

    Further arguments follow these. What the program prints goes nowhere. Raises InputError, without the file's name,
    if the program fails, which then names its last line of errors, if it takes longer than five minutes, or if the
    package that it needs is not installed.
    """
    if importlib.util.find_spec(package) is None:
        raise InputError("such files need a reader that is not installed: pip install 'kmn_jax[data]'")
    # The alarm is for the case that nobody is left who waits.
    alarm = f"import signal\nif hasattr(signal, 'alarm'):\n    signal.alarm({int(_SECONDS) + 60})\n"
    try:
        with tempfile.TemporaryDirectory() as folder:
            source, target = Path(folder, "source"), Path(folder, "target")
            source.write_bytes(content)
            command = [sys.executable, "-P", "-c", alarm + program, str(source), str(target), *arguments]
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, timeout=_SECONDS
            )
            if done.returncode == 0 and target.exists():
                return target.read_bytes()
    except subprocess.TimeoutExpired:
        raise InputError(f"its decoding takes longer than {_SECONDS} s: save it in another format") from None
    except OSError as error:
        raise InputError(f"it cannot be decoded: {error}") from None
    said = done.stderr.decode("utf-8", "replace").strip().splitlines()
    reason = said[-1][:120] if said else f"the decoder ended with code {done.returncode}"
    raise InputError(f"it is truncated or damaged, or holds nothing to read ({reason})")
