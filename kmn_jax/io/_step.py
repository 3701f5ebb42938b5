"""Converting STEP files, in a process of its own: damaged ones can crash the converter or keep it for ever."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

from kmn_jax.errors import InputError

_SECONDS = 300  # parts take one or two
_END = b"END-ISO-10303-21;"
_PROGRAM = f"""
import signal, sys
if hasattr(signal, "alarm"):
    signal.alarm({_SECONDS})  # in case that nobody is left who waits
sys.modules["trimesh"] = None  # cascadio tries to import it, which would take most of the time
import cascadio
sys.exit(cascadio.step_to_glb(sys.argv[1], sys.argv[2], merge_primitives=True))
"""


def step_to_glb(content: bytes) -> bytes:
    """Return a STEP file's content as GLB, in metres.

    Raises InputError, without the file's name, if the content is truncated, damaged, holds no shape or takes longer
    than five minutes, or if the converter is not installed.
    """
    if not content.lstrip().startswith(b"ISO-10303-21"):
        raise InputError("it is not a STEP file: it does not start with ISO-10303-21")
    if _END not in content[-1000:]:
        raise InputError(f"it is truncated: it does not end with {_END.decode()}")
    if importlib.util.find_spec("cascadio") is None:
        raise InputError("STEP files need a reader that is not installed: pip install 'kmn_jax[data]'")
    try:
        with tempfile.TemporaryDirectory() as folder:
            source, target = Path(folder, "part.step"), Path(folder, "part.glb")
            source.write_bytes(content)
            command = [sys.executable, "-P", "-c", _PROGRAM, str(source), str(target)]
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, timeout=_SECONDS
            )
            if done.returncode == 0 and target.exists():
                return target.read_bytes()
    except subprocess.TimeoutExpired:
        raise InputError(f"its conversion takes longer than {_SECONDS} s: export it as STL") from None
    except OSError as error:
        raise InputError(f"it cannot be converted: {error}") from None
    said = done.stderr.decode("utf-8", "replace").strip().splitlines()
    reason = said[-1][:120] if said else f"the converter ended with code {done.returncode}"
    raise InputError(f"it is damaged, or holds no shape ({reason})")
