"""Arguments of the command line: values that begin with a minus sign, and one sentence for what is wrong."""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import is_dataclass
from functools import partial, wraps
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import tyro

from kmn_jax.errors import InputError


def joined(arguments: list[str]) -> list[str]:
    """Return arguments in which numbers with commas between them are joined to their flag, as they may be negative."""
    result: list[str] = []
    for argument in arguments:
        is_flag = bool(result) and result[-1].startswith("--") and "=" not in result[-1]
        if is_flag and argument.startswith("-") and "," in argument:
            result[-1] += f"={argument}"
        else:
            result.append(argument)
    return result


def parsed(arguments: list[str], calls: Iterable[Callable[..., None]]) -> Callable[[], None]:
    """Return the command that the arguments ask for, to be run.

    Raises InputError, in one sentence, for wrong ones.
    """
    calls = tuple(calls)
    flags = [argument.partition("=")[0].replace("_", "-") for argument in arguments if argument.startswith("--")]
    several = {flag for call in calls for flag in _repeatable(call)}
    repeated = next((flag for flag in flags if flags.count(flag) > 1 and flag not in several), None)
    if repeated is not None:
        raise InputError(f"{repeated} is given {flags.count(repeated)} times, but has one value: see kmn --help")

    def later(call: Callable[..., None]) -> Callable[..., Callable[[], None]]:
        return wraps(call)(lambda *values, **named: partial(call, *values, **named))

    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), _unwrapped({"-h", "--help"}.isdisjoint(arguments)):
            commands: dict[str, Any] = {call.__name__: later(call) for call in calls}
            chosen: Callable[[], None] = tyro.extras.subcommand_cli_from_dict(commands, prog="kmn", args=arguments)
            return chosen
    except SystemExit as error:
        if not error.code:  # of --help
            raise
    raise InputError(_sentence(said.getvalue()))


def _repeatable(call: Any) -> Iterator[str]:
    """Yield the flags of a command, or of a dataclass among its arguments, that may be given several times."""
    for name, hint in get_type_hints(call, include_extras=True).items():
        kind, *notes = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        if is_dataclass(kind):
            yield from _repeatable(kind)
        elif tyro.conf.UseAppendAction in notes:
            yield f"--{name.replace('_', '-')}"


@contextlib.contextmanager
def _unwrapped(wanted: bool) -> Iterator[None]:
    """Let the parser not break the lines of what it says of wrong arguments, in the middle of words if need be."""
    before = os.environ.get("COLUMNS")
    if wanted:
        os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        if wanted and before is None:
            del os.environ["COLUMNS"]
        elif wanted:
            os.environ["COLUMNS"] = str(before)


def _sentence(box: str) -> str:
    """Return what a box of the parser says of wrong arguments in one sentence, without the help texts in it."""
    box = re.sub(r"\x1b\[[\d;]*m", "", box)  # colours
    lines = [line[2:-1].rstrip() for line in box.splitlines()[1:] if not line.startswith("╰")]  # below its title
    parts: list[tuple[list[str], list[str]]] = [([], [])]  # a text, and the options that it lists
    for line in lines:
        text, options = parts[-1]
        if re.fullmatch("[─-]{3,}", line):
            parts.append(([], []))
        elif not line:  # what follows are details
            break
        elif not line.startswith(" " * 4):
            text.append(line)
        elif not line.startswith(" " * 5) and line.strip() not in options:  # help texts; the same of two commands
            options.append(line.strip())
    told = [f"{' '.join(text)} {', '.join(options)}".strip().rstrip(".") for text, options in parts]
    said = "; ".join(one for one in told if one and not one.startswith("For full help"))
    helped = re.search(r"kmn(?: \w+)? --help", box)
    return f"{said or box.strip()}: see {helped[0] if helped else 'kmn --help'}"
