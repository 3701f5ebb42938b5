"""How far from the origin of their frame coordinates may lie, in sizes of what they describe, to be held by floats.

Files place parts and scans anywhere: in a plant's frame, or in that of a map. Readers and records keep such coordinates
in float64, and what computes in float32 takes them from a nearer origin. Nothing is moved that float32 holds well.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64

from kmn_jax.errors import InputError, is_coarse

FAR = 100.0  # sizes: farther away, float32 moves points by more than a hundred-thousandth of the size
_LOST = 1e10  # sizes: farther away, float64 does
_SAMPLE = 100_000  # points that tell where a scan is
_PERCENTILES = (1, 99)  # of each axis: what lies beyond may be stray points


def far_origin(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """Return the middle of a box if it lies far from the origin, else zero."""
    middle = (low.astype(np.float64) + high.astype(np.float64)) / 2
    return middle if np.abs(middle).max() > FAR * float(np.linalg.norm(high - low)) else np.zeros(3)


def object_origin(points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "3"]:
    """Return the origin from which to take an object's points, zero if they lie near to that of their frame.

    Raises InputError if they lie so far away that their coordinates have lost the object's shape.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    origin, size = far_origin(low, high), float(np.linalg.norm(high - low))
    if not size:
        return np.zeros(3)  # one place has no surface, wherever it is
    farthest = float(np.abs(origin).max())
    if farthest > _LOST * size or _is_coarse(points, farthest, size):
        raise InputError(
            f"it lies {farthest:.3g} from the origin of its frame, but is only {size:.3g} large, and its coordinates"
            " have not enough digits for both: move it to the origin and export it again"
        )
    return origin


def held(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the points of a scan in float32, or in float64 if most lie too far from the origin for that.

    Raises InputError, without the file's name, if their coordinates have lost the scan's shape.
    """
    some = points[:: 1 + len(points) // _SAMPLE].astype(np.float64)
    low, high = np.percentile(some, _PERCENTILES, axis=0)
    farthest, size = float(np.abs(far_origin(low, high)).max()), float(np.linalg.norm(high - low))
    if not farthest:
        return points.astype(np.float32)
    if _is_coarse(some, farthest, size):
        raise InputError(
            f"its points lie {farthest:.3g} from the origin of their frame, but only {size:.3g} apart, and have not"
            " enough digits for both: export it again nearer to the origin, or in double precision"
        )
    return points.astype(np.float64)


def _is_coarse(points: Float[np.ndarray, "n 3"], farthest: float, size: float) -> bool:
    """Tell whether points are in single precision, whatever holds them, and have few steps across their size."""
    return is_coarse(farthest, size) and bool((points.astype(np.float32) == points).all())
