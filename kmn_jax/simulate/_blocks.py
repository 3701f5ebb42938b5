"""A container as solid blocks, for physics and ray casting: the same shapes as the surfels of `container_surfels`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from kmn_jax.simulate._containers import Container

_GROUND = 40.0  # half the side of the table, or of the ground that a container stands on
_THICK = 0.5  # of table and ground
# Corners are numbered by bits: 1 for x, 2 for y, 4 for z.
_QUADS = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
_TRIANGLES = np.array([[q[a], q[b], q[c]] for q in _QUADS for a, b, c in ((0, 1, 2), (0, 2, 3))], dtype=np.int32)


def container_blocks(container: Container) -> list[Float[np.ndarray, "8 3"]]:
    """Return the corners of convex blocks that make up a container and the ground, in its frame and unit."""
    height, lift = float(container.height), float(container.lift)
    if height <= 0:
        return [_box((-_GROUND, -_GROUND, -_THICK), (_GROUND, _GROUND, 0.0))]
    outer = np.asarray(container.outer, dtype=np.float64)
    blocks = [_box((-_GROUND, -_GROUND, -lift - _THICK), (_GROUND, _GROUND, -lift))]
    blocks += _walls(container, np.zeros(3))
    if np.isfinite(float(container.gap)):
        blocks += _walls(container, np.array([2 * outer[0] + float(container.gap), 0, 0]))
    opening = np.asarray(container.opening, dtype=np.float64)
    for axis in (0, 1):
        top, middle = float(container.divider_height[axis]), float(container.divider[axis])
        if top > 0:
            low, high = np.append(-opening, 0), np.append(opening, top)
            low[axis], high[axis] = middle - container.divider_width / 2, middle + container.divider_width / 2
            blocks.append(_box(low, high))
    return blocks


def block_mesh(blocks: list[Float[np.ndarray, "8 3"]]) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]]:
    """Return vertices and triangles, wound outwards, of blocks."""
    triangles = [_TRIANGLES + 8 * number for number in range(len(blocks))]
    return np.concatenate(blocks), np.concatenate(triangles).astype(np.int32)


def _box(low: object, high: object) -> Float[np.ndarray, "8 3"]:
    ends = np.array([low, high], dtype=np.float64)
    return np.array([[ends[row >> axis & 1, axis] for axis in range(3)] for row in range(8)])


def _walls(container: Container, offset: Float[np.ndarray, "3"]) -> list[Float[np.ndarray, "8 3"]]:
    """Return the floor of a container and its four walls, whose outer sides are upright."""
    half, opening, outer = (
        np.asarray(size, dtype=np.float64) for size in (container.half, container.opening, container.outer)
    )
    height, lift = float(container.height), float(container.lift)
    blocks = [_box((*-outer, -lift), (*outer, 0.0))]
    for axis in (0, 1):
        other = 1 - axis
        for sign in (-1.0, 1.0):
            corners = np.zeros((8, 3))
            for row in range(8):
                upper, outside, end = row >> 2 & 1, row >> axis & 1, row >> other & 1
                inner = opening[axis] if upper else half[axis]
                # Blocks are not mirrored but turned, so that their triangles stay wound outwards.
                far = outside if sign > 0 else 1 - outside
                corners[row, axis] = sign * (outer[axis] if far else inner)
                corners[row, other] = (2 * end - 1) * outer[other]
                corners[row, 2] = height if upper else 0.0
            blocks.append(corners)
    return [block + offset for block in blocks]
