"""A scan that is ready to be searched: seen from its sensor, thinned out, padded, with its foreground."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from kmn_jax.detection._scan_crop import SceneArrays, padded_points
from kmn_jax.detection._search import CropFeatures
from kmn_jax.detection._view import View
from kmn_jax.errors import InputError

LEAST_POINTS = 4096  # the smallest capacity that is compiled
_IMAGE_STEP = 256  # depth images are padded to a multiple of it


@dataclass(frozen=True)
class Scene:
    """A scan with all that searches for several parts share; the features of crops are kept for the next part."""

    view: View
    unit: str
    foreground: Bool[np.ndarray, " r"]  # of `points`
    points: Float32[np.ndarray, "r 3"]  # in the view's frame: all of the scan's, or a random part of them
    arrays: SceneArrays  # the same, padded
    depth: Float[Array, "h w"]  # the view's, padded
    warnings: tuple[str, ...] = ()
    doubt: str | None = None  # about its unit, told if nothing is found
    features: dict[tuple[object, ...], CropFeatures] = field(default_factory=dict)


def make_scene(
    view: View,
    unit: str,
    foreground: Bool[np.ndarray, " n"],
    most_points: int,
    keep: Float[np.ndarray, "k 3"] | None = None,
    warnings: tuple[str, ...] = (),
) -> Scene:
    """Thin a view out and pad it; the points nearest to places `keep`, in the view's frame, stay.

    The same view gives the same scene. Raises InputError if the foreground is empty.
    """
    if not foreground.any():
        raise InputError("no point of the scan is left as foreground: check background, region and units")
    rows = _thinned(foreground, most_points)
    if keep is not None:
        rows = np.union1d(rows, [nearest_row(view.points, place) for place in keep])
    points = view.points[rows]
    height, width = (-size % _IMAGE_STEP for size in view.depth.shape)
    return Scene(
        view,
        unit,
        foreground[rows],
        points,
        SceneArrays(*padded_points(points, LEAST_POINTS)),
        jnp.asarray(np.pad(view.depth, ((0, height), (0, width)))),
        warnings,
    )


def nearest_row(points: Float32[np.ndarray, "n 3"], place: Float[np.ndarray, "3"]) -> int:
    """Return the row of the point that is nearest to a place."""
    return int(((points - place) ** 2).sum(axis=1).argmin())


def padded_flags(flags: Bool[np.ndarray, " r"], capacity: int) -> Bool[Array, " c"]:
    """Return flags of points as long as the padded points are."""
    return jax.device_put(np.pad(flags, (0, capacity - len(flags))))


def _thinned(foreground: Bool[np.ndarray, " n"], most: int) -> Int[np.ndarray, " k"]:
    """Return a random part of the rows, in their order; all if they are few."""
    total = len(foreground)
    if total <= most:
        return np.arange(total)
    kept = np.random.default_rng(0).choice(total, most, replace=False)
    kept.sort()
    if not foreground[kept].any():  # then the foreground is small: it stays whole
        kept = np.union1d(kept[: most // 2], np.flatnonzero(foreground)[: most // 2])
    return kept
