"""Units of length."""

from __future__ import annotations

from kmn_jax.errors import InputError

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}  # one of each unit, in metres
_DECIMALS = {"m": 4, "cm": 2, "mm": 1, "in": 3}  # to a tenth of a millimetre
_LONG = 1e4


def check_unit(unit: str) -> str:
    """Return a known unit of length, or raise InputError."""
    if unit not in METRES:
        raise InputError(f"unit {unit!r} is not known: use one of {', '.join(METRES)}")
    return unit


def coordinate_text(value: float, unit: str) -> str:
    """Return a coordinate for people: four digits, or more if it is a long one."""
    return f"{value:.4g}" if abs(value) < _LONG else f"{value:.{_DECIMALS[check_unit(unit)]}f}"
