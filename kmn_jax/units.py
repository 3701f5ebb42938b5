"""Units of length."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from jaxtyping import Float

from kmn_jax.errors import InputError, shown

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}  # one of each unit, in metres
_DECIMALS = {"m": 4, "cm": 2, "mm": 1, "in": 3}  # to a tenth of a millimetre
_LONG = 1e4

if TYPE_CHECKING:
    Unit: TypeAlias = Literal["m", "cm", "mm", "in"]
else:
    Unit = str  # any text is taken, and judged by `check_unit`


def check_unit(unit: str) -> Unit:
    """Return a known unit of length, or raise InputError."""
    if unit not in METRES:
        raise InputError(f"unit {shown(repr(unit))} is not known: use one of {', '.join(METRES)}")
    return unit  # type: ignore[return-value]


def place_text(place: Float[np.ndarray, "3"], unit: str) -> list[str]:
    """Return the coordinates of a place for people: four digits of each, or more if one is long."""
    digits = ".4g" if np.abs(place).max() < _LONG else f".{_DECIMALS[check_unit(unit)]}f"
    return [format(float(value), digits) for value in place]
