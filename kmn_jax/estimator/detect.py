"""Candidates of a whole bin: seeds over the foreground, poses around them, and what speaks for and against each."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from kmn_jax.checks import InputError
from kmn_jax.data.splat import Surfels
from kmn_jax.estimator.part import Part
from kmn_jax.estimator.search import Hypotheses, SceneArrays, SearchConfig, part_arrays, search, spread_seeds
from kmn_jax.estimator.select import SelectConfig
from kmn_jax.estimator.verify import Agreement, VerifyConfig, agreements
from kmn_jax.estimator.view import View
from kmn_jax.models import Model

_SEEDS = (8, 16, 32, 64, 128)  # numbers of seeds that are compiled
_LEAST_POINTS = 4096  # the smallest capacity that is compiled
_VERIFIED_POINTS = 2048  # on an object's surface


@dataclass(frozen=True)
class DetectConfig:
    """How a bin is searched; lengths are shares of the object's diameter."""

    search: SearchConfig = field(default_factory=SearchConfig)
    verify: VerifyConfig = field(default_factory=VerifyConfig)
    select: SelectConfig = field(default_factory=SelectConfig)
    most_points: int = 131_072  # of a scan: more are thinned out at random
    seed_spacing: float = 0.4  # seeds are at most about so far apart
    most_seeds: int = 128

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        if self.most_points < _LEAST_POINTS or self.most_seeds < 1 or not self.seed_spacing > 0:
            raise InputError(
                f"most_points = {self.most_points} must be at least {_LEAST_POINTS}, most_seeds = {self.most_seeds} at"
                f" least 1, and seed_spacing = {self.seed_spacing} above zero"
            )


class Candidates(NamedTuple):
    """Poses of a part in the view's frame, each with its evidence; arrays on the host, lengths in the scan's unit."""

    T_view_object: Float32[np.ndarray, "s 4 4"]
    usable: Bool[np.ndarray, " s"]  # false where no pose was found, and for repeated seeds
    seeds: Float32[np.ndarray, "s 3"]
    evidence: Float32[np.ndarray, "s f"]  # see EVIDENCE
    num_inliers: Int[np.ndarray, " s"]


EVIDENCE = (
    "explained",
    "violated",
    "occluded",
    "unknown",
    "confirmed",  # explained, of what was explained or violated
    "fit",
    "inlier_share",
    "log_inliers",
    "object_share",
    "rms_error",
)


def find_candidates(
    model: Model,
    part: Part,
    view: View,
    foreground: Bool[np.ndarray, " n"],
    seed: int,
    config: DetectConfig,
    at: Float[np.ndarray, "k 3"] | None = None,
) -> Candidates:
    """Return a candidate for each of the seeds spread over the foreground, or of the points `at` (in the view's frame).

    The part's lengths are in the unit of the view. The same inputs and `seed` give the same bits on one device.
    Raises InputError if the foreground is empty.
    """
    if not foreground.any():
        raise InputError("no point of the scan is left as foreground: check background, region and units")
    rows = _thinned(view.points, foreground, seed, config.most_points)
    if at is not None:  # what was pointed at stays
        rows = np.union1d(rows, [_nearest_row(view.points, place) for place in at])
    points, front = view.points[rows], foreground[rows]
    scene, candidates = _padded(points, front)
    if at is None:
        count = _seed_count(points[front], config.seed_spacing * part.diameter, config.most_seeds)
        chosen, real = _spread_seeds(scene, candidates, count)
    else:
        chosen, real = _nearest_rows(points, at)
    arrays = part_arrays(
        jnp.asarray(part.points),
        jnp.asarray(part.normals),
        jnp.asarray(part.features),
        jnp.float32(part.diameter),
        model.config.num_object_points,
    )
    key = jax.random.key(seed)
    found = search(
        model.graphdef,
        model.parameters,
        arrays,
        scene,
        chosen,
        key,
        config.search,
        model.config.num_scene_points,
    )
    count = _VERIFIED_POINTS
    surfels = Surfels(jnp.asarray(part.points[:count]), jnp.asarray(part.normals[:count]), jnp.float32(part.area))
    depth = jnp.asarray(view.depth)
    agreed = _agreements(
        found.T_scene_object, surfels, depth, view.intrinsics, jnp.float32(part.diameter), config=config.verify
    )
    host: tuple[Hypotheses, Agreement] = jax.device_get((found, agreed))
    poses = np.asarray(host[0].T_scene_object)
    return Candidates(
        T_view_object=poses,
        usable=np.asarray(host[0].found) & np.asarray(real),
        seeds=points[np.asarray(chosen)],
        evidence=_evidence(*host, part.diameter),
        num_inliers=np.asarray(host[0].num_inliers),
    )


_spread_seeds = jax.jit(spread_seeds, static_argnames="count")
_agreements = jax.jit(agreements, static_argnames="config")


def _evidence(found: Hypotheses, agreed: Agreement, diameter: float) -> Float32[np.ndarray, "s f"]:
    explained, violated = np.asarray(agreed.explained), np.asarray(agreed.violated)
    columns = {
        "explained": explained,
        "violated": violated,
        "occluded": agreed.occluded,
        "unknown": agreed.unknown,
        "confirmed": explained / np.maximum(explained + violated, 1e-6),
        "fit": found.fit,
        "inlier_share": found.inlier_share,
        "log_inliers": np.log1p(found.num_inliers),
        "object_share": found.object_share,
        "rms_error": np.asarray(found.rms_error) / diameter,
    }
    return np.stack([np.asarray(columns[name], dtype=np.float32) for name in EVIDENCE], axis=1)


def _thinned(
    points: Float32[np.ndarray, "n 3"], foreground: Bool[np.ndarray, " n"], seed: int, most: int
) -> Int[np.ndarray, " k"]:
    """Return the rows of a random part of the points, in their order; all if they are few."""
    if len(points) <= most:
        return np.arange(len(points))
    kept = np.random.default_rng(seed).choice(len(points), most, replace=False)
    kept.sort()
    if not foreground[kept].any():  # then the foreground is small: it stays whole
        kept = np.union1d(kept[: most // 2], np.flatnonzero(foreground)[: most // 2])
    return kept


def _padded(points: Float32[np.ndarray, "n 3"], front: Bool[np.ndarray, " n"]) -> tuple[SceneArrays, Array]:
    capacity = max(_LEAST_POINTS, 1 << (len(points) - 1).bit_length())
    padded = np.zeros((capacity, 3), dtype=np.float32)
    padded[: len(points)] = points
    flags = np.zeros(capacity, dtype=bool)
    flags[: len(points)] = front
    mask = np.arange(capacity) < len(points)
    return SceneArrays(jnp.asarray(padded), jnp.asarray(mask)), jnp.asarray(flags)


def _seed_count(points: Float32[np.ndarray, "n 3"], spacing: float, most: int) -> int:
    """Return about how many seeds it takes: the cells of a grid that hold points."""
    cells = len(np.unique(np.floor(points / spacing).astype(np.int64), axis=0))
    wanted = min(cells, most)
    return next((count for count in _SEEDS if count >= wanted), _SEEDS[-1])


def _nearest_rows(points: Float32[np.ndarray, "n 3"], at: Float[np.ndarray, "k 3"]) -> tuple[Array, Array]:
    rows = [_nearest_row(points, place) for place in at]
    count = next((size for size in _SEEDS if size >= len(rows)), len(rows))
    real = np.arange(count) < len(rows)
    return jnp.asarray(rows + rows[:1] * (count - len(rows)), dtype=jnp.int32), jnp.asarray(real)


def _nearest_row(points: Float32[np.ndarray, "n 3"], place: Float[np.ndarray, "3"]) -> int:
    return int(((points - place) ** 2).sum(axis=1).argmin())
