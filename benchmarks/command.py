"""The command line of a benchmark: what is wrong with it is told in one sentence, before anything is measured."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import Any, NoReturn

import tyro

from kmn_jax.errors import InputError, check_whole
from kmn_jax.report import check_target

_FILES = ("json", "picture")  # what flags of files that are written are called
_FROM_ZERO = ("seed", "dense_up_to")  # whole numbers that may be 0: all others count what must be there


def run(main: Callable[..., Any]) -> NoReturn:
    """Call a benchmark, whose signature is its list of flags, and end the process: with 2 for bad input.

    Otherwise the exit status is what it returns, 0 for None.
    """

    @functools.wraps(main)
    def checked(**given: Any) -> Any:
        for name, value in given.items():
            if name in _FILES:
                check_target(value)
            for one in value if isinstance(value, tuple) else (value,):
                if isinstance(one, int) and not isinstance(one, bool):
                    check_whole(one, f"--{name.replace('_', '-')}", int(name not in _FROM_ZERO))
        return main(**given)

    try:
        sys.exit(tyro.cli(checked))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
