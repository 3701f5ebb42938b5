"""Which packages of the extras are missing, so that one sentence can name them all."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, requires, version

_FIRST = "detect"  # what every command with a part and a scan needs
_OTHERS = ("plots", "view", "serve", "data", "train")  # those that others take in come first
_PACKAGE_OF = {"PIL": "pillow", "OpenEXR": "openexr"}  # modules that are not called as their package
_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)(?:\[(?P<extras>[\w,-]+)\])?(?P<bounds>[^;]*)(?:;(?P<marker>.*))?")


def missing_packages(module: str, lines: Iterable[str] | None = None) -> tuple[str, ...]:
    """Return what pip has to install when a module is missing: its package, and all others of the extras it is in.

    `lines` are the requirements of this package, by default those of its installation.
    """
    package = _PACKAGE_OF.get(module.partition(".")[0], module.partition(".")[0]).replace("_", "-").lower()
    groups = _extras(_requirements() if lines is None else lines)
    wanted = dict(groups.get(_FIRST, {}))
    for extra in _OTHERS:
        if package in wanted:
            break
        if package in groups.get(extra, {}):
            wanted |= groups[extra]
    if package not in wanted:  # of none of them: somebody else's
        return (package,)
    return tuple(f"{name}{bounds}" for name, bounds in sorted(wanted.items()) if name == package or not _is_there(name))


def install_command(module: str) -> str:
    """Return the command that installs what is missing when a module is."""
    return f"pip install {' '.join(shlex.quote(package) for package in missing_packages(module))}"


def _requirements() -> Iterable[str]:
    try:
        return requires("kmn_jax") or ()
    except PackageNotFoundError:  # run from its sources
        return ()


def _extras(lines: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return the bounds of an extra's packages by their names; extras that an extra takes in are part of it."""
    groups: dict[str, dict[str, str]] = {}
    nested: list[tuple[str, str]] = []
    for line in lines:
        found = _REQUIREMENT.match(line)
        extra = re.search(r"""extra\s*==\s*['"]([\w-]+)['"]""", line)
        if found is None or extra is None:
            continue
        name = found["name"].replace("_", "-").lower()
        if name == "kmn-jax":
            nested += [(extra[1], inner) for inner in (found["extras"] or "").split(",")]
        else:
            groups.setdefault(extra[1], {})[name] = found["bounds"].strip(" ()")
    for _ in nested:  # as deep as there are lines
        for outer, inner in nested:
            groups.setdefault(outer, {}).update(groups.get(inner, {}))
    return groups


def _is_there(package: str) -> bool:
    try:
        version(package)
    except PackageNotFoundError:
        return False
    return True
