"""Solution of small symmetric systems from plain elementwise arithmetic: one kernel, where a library starts several."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def solve_symmetric(system: Float[Array, "d d"], right: Float[Array, " d"]) -> Float[Array, " d"]:
    """Solve a positive semi-definite system, of few rows, by LDL^T with pivots held above the rounding of its trace.

    So the solution is finite, and small in directions that the system leaves open. Unrolled: its length grows with the
    cube of the number of rows.
    """
    size = system.shape[0]
    smallest = 4 * jnp.finfo(system.dtype).eps * jnp.maximum(jnp.trace(system), 1e-3)[None]
    # Rows of one, since XLA starts a kernel for each scalar on GPUs, but one for all arrays of a shape.
    entry = [[system[row, column][None] for column in range(row + 1)] for row in range(size)]
    solution = [right[row][None] for row in range(size)]
    pivots: list[Float[Array, " 1"]] = []
    for row in range(size):
        for column in range(row):
            # What is kept below the diagonal is L D until its row's own pivot is known.
            for before in range(column):
                entry[row][column] = entry[row][column] - entry[row][before] * entry[column][before]
        for column in range(row):
            factor = entry[row][column] / pivots[column]
            entry[row][row] = entry[row][row] - factor * entry[row][column]
            solution[row] = solution[row] - factor * solution[column]
            entry[row][column] = factor
        pivots.append(jnp.maximum(entry[row][row], smallest))
    solution = [value / pivot for value, pivot in zip(solution, pivots, strict=True)]
    for row in reversed(range(size)):
        for after in range(row + 1, size):
            solution[row] = solution[row] - entry[after][row] * solution[after]
    return jnp.concatenate(solution)
