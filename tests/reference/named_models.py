"""Models of evidence that say nothing, but which tests can tell apart by what they were made of."""

from __future__ import annotations

from typing import Any

import numpy as np


class Named(tuple[Any, ...]):
    """What a model was made of: those that it is the mean of, and its scale, if it has one."""

    def logit(self, evidence: np.ndarray) -> np.ndarray:
        """Return even odds."""
        return np.zeros(len(evidence))

    def scaled(self, factor: float, offset: float) -> Named:
        """Return the same, with its scale."""
        return Named((*self, factor, offset))
