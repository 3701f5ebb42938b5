"""The command line of a benchmark: wrong values are told in one sentence, before anything is measured."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import Any, NoReturn

import tyro

from kmn_jax.errors import InputError, check_whole, require
from kmn_jax.report import check_target

_FILES = ("json", "picture")  # what flags of files that are written are called
_MAY_BE_EMPTY = ("only", "training")  # lists of which none means something
_FROM_ZERO = ("seed", "dense_up_to")  # whole numbers that may be 0: all others count what must be there


def run(main: Callable[..., Any]) -> NoReturn:
    """Call a benchmark, whose signature is its list of flags, and end the process: with 2 after an InputError.

    Otherwise the exit status is what it returns, 0 for None.
    """

    @functools.wraps(main)
    def checked(**given: Any) -> Any:
        check_target(*(given[name] for name in _FILES if name in given))
        for name, value in given.items():
            flag = f"--{name.replace('_', '-')}"
            require(value != () or name in _MAY_BE_EMPTY, f"{flag} needs at least one value")
            for one in value if isinstance(value, tuple) else (value,):
                if isinstance(one, int) and not isinstance(one, bool):
                    check_whole(one, flag, int(name not in _FROM_ZERO))
        return main(**given)

    try:
        sys.exit(tyro.cli(checked))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
