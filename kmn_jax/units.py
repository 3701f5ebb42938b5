"""Units of length."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, TypeAlias

from kmn_jax.errors import InputError

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}  # one of each unit, in metres

if TYPE_CHECKING:
    Unit: TypeAlias = Literal["m", "cm", "mm", "in"]
else:
    Unit = str  # any text is taken, and judged by `check_unit`


def check_unit(unit: str) -> Unit:
    """Return a known unit of length, or raise InputError."""
    if unit not in METRES:
        raise InputError(f"unit {unit!r} is not known: use one of {', '.join(METRES)}")
    return unit  # type: ignore[return-value]
