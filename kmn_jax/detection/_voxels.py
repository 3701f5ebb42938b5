"""Points on the host by the cells of a cubic grid that they lie in."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def cell_numbers(points: Float[np.ndarray, "n 3"], side: float) -> Int[np.ndarray, " n"]:
    """Return a number for the cell of each point, the same for no two cells of a grid of up to a million a side."""
    cells = np.floor(points / side).astype(np.int64)
    if not len(cells):
        return np.zeros(0, dtype=np.int64)
    cells -= cells.min(axis=0)
    _, rows, columns = (cells.max(axis=0) + 1).tolist()
    return np.asarray((cells[:, 0] * rows + cells[:, 1]) * columns + cells[:, 2])
