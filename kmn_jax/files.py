"""Writing files that appear complete or not at all; reading safetensors files."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open

from kmn_jax.errors import InputError


def write_whole(path: str | Path, content: bytes) -> None:
    """Write `content` beside `path` and move it there in one step; an existing file is replaced.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """
    path = Path(path)
    try:
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None
    finally:
        if os.path.exists(temporary):
            os.unlink(temporary)


def read_safetensors(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return tensors and header of a .safetensors file, or raise InputError."""
    try:
        with safe_open(str(path), "np") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (not a mapping)
            return tensors, file.metadata() or {}
    except (SafetensorError, OSError, AttributeError, TypeError) as error:  # the latter two: dtypes NumPy lacks
        raise InputError(f"{path} is not a readable safetensors file: {error}") from None
