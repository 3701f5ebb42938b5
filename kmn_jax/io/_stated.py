"""The unit that a CAD file states."""

from __future__ import annotations

import re
from pathlib import Path

from kmn_jax.io._meshes import read_file
from kmn_jax.units import Unit

_STEP, _GLB = (".step", ".stp"), ".glb"
_INCH = re.compile(rb"CONVERSION_BASED_UNIT\s*\(\s*'INCH'", re.IGNORECASE)
_METRE = re.compile(rb"SI_UNIT\s*\(\s*(?P<prefix>\.\w+\.|\$)\s*,\s*\.METRE\.\s*\)")
_PREFIXES: dict[bytes, Unit] = {b".MILLI.": "mm", b".CENTI.": "cm", b"$": "m"}


def stated_unit(path: str | Path) -> Unit | None:
    """Return the unit of a CAD file that states one: metres of GLB, what a STEP file says; None of other formats.

    A STEP file in a unit that is not known here, such as feet, is told in millimetres: it is read rightly all the same.
    """
    suffix = Path(path).suffix.lower()
    if suffix == _GLB:
        return "m"
    if suffix not in _STEP:
        return None
    content = read_file(Path(path))
    if _INCH.search(content):  # before its definition by millimetres
        return "in"
    found = _METRE.search(content)
    return "mm" if found is None else _PREFIXES.get(found["prefix"], "mm")
