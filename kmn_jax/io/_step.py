"""Converting STEP files."""

from __future__ import annotations

from kmn_jax.errors import InputError
from kmn_jax.io._apart import decoded_apart

_END = b"END-ISO-10303-21;"
_PROGRAM = """
import sys
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
    return decoded_apart(content, _PROGRAM, "cascadio")
