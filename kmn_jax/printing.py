"""What commands print: text for people, which may fail to be read without a failure of the command."""

from __future__ import annotations

import os
import sys

from kmn_jax.errors import InputError


def say(text: str) -> None:
    """Print a text at once; what stdout's encoding lacks is written as its number, as on stderr.

    That nobody reads on, as in `kmn detect ... | head -1`, is no failure. Raises InputError if stdout cannot take it.
    """
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    try:
        print(text.encode(encoding, "backslashreplace").decode(encoding), flush=True)
    except OSError as error:
        drop_what_is_printed()
        if not isinstance(error, BrokenPipeError):
            raise InputError(f"cannot print: {error.strerror}; files are written before anything is printed") from None


def drop_what_is_printed() -> None:
    """Let what is still to be printed go nowhere, which Python would otherwise try again at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def open_closed_streams() -> None:
    """Open stdout and stderr if they are closed, so that no file takes their place."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115  (until the process ends)
