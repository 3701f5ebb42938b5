"""Coarse-to-fine RANSAC: the pose that most matches agree on, all hypotheses at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import cos, radians

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.errors import (
    InputError,
    check_type,
    check_whole,
    float_array,
    is_traced,
    mask_array,
    positive_scalar,
    require,
    row_count,
)
from kmn_jax.geometry import from_rotation_translation, largest
from kmn_jax.pose._kabsch import fit_rigid, rotation_is_determined
from kmn_jax.pose._matches import Matches
from kmn_jax.pose._modes import Pairs, refined_modes
from kmn_jax.pose._result import PoseResult, PoseStatus, first_status
from kmn_jax.typing import ArrayInput, Mask, Normals, Points, Pose, PRNGKey, Scalar

_MIN_HEIGHT = 0.01  # of the diameter: a flatter triangle says nothing about the rotation about its long side


@dataclass(frozen=True)
class RansacConfig:
    """Set the pose search. Hypotheses, normal gate and rounds as published (arXiv 2303.16102, pose estimation).

    Gates are fractions of the object's diameter. The distance gate has to span the gap between neighbouring
    keypoints: of 20 on a part, the nearest is 0.15 diameters away on average, and 0.1 loses poses that 0.15 finds.

    A pose counts as found when `min_inliers` matches and `min_inlier_share` of the usable ones support it. Pure
    chance stays below both, but without the normal check: it then brings up to 8 of 128 matches together.
    """

    num_hypotheses: int = 1000  # triplets that become poses and are scored against all matches
    num_candidates: int = 16384  # triplets drawn; the most congruent ones of them become hypotheses
    distance_gate: float = 0.15
    normal_gate_degrees: float = 30.0
    use_normals: bool = True
    num_refinements: int = 5
    min_inliers: int = 5
    min_inlier_share: float = 0.03

    def __post_init__(self) -> None:
        """Refuse values that contradict each other or their meaning."""
        require(
            1 <= self.num_hypotheses <= self.num_candidates,
            f"num_hypotheses is {self.num_hypotheses}, but must be between 1 and"
            f" num_candidates = {self.num_candidates}, from which they are selected",
        )
        require(self.distance_gate > 0, f"distance_gate is {self.distance_gate}, but must be above zero")
        require(
            0 < self.normal_gate_degrees <= 180,
            f"normal_gate_degrees is {self.normal_gate_degrees}, but must be in (0, 180]",
        )
        require(self.num_refinements >= 0, f"num_refinements is {self.num_refinements}, but cannot be negative")
        require(self.min_inliers >= 3, f"min_inliers is {self.min_inliers}, but any three matches agree: ask for more")
        if not 0 <= self.min_inlier_share <= 1:
            raise InputError(f"min_inlier_share is {self.min_inlier_share}, but must be in [0, 1]")

    @property
    def refinement_gates(self) -> tuple[float, ...]:
        """Return the gate of each refinement: its square is a half, a third, ... of the first one's."""
        return tuple(self.distance_gate / (step + 2) ** 0.5 for step in range(self.num_refinements))

    @property
    def min_cosine(self) -> float:
        """Return the least cosine between the normals of an inlier."""
        return cos(radians(self.normal_gate_degrees))


def ransac(key: ArrayInput, matches: Matches, config: RansacConfig = RansacConfig()) -> PoseResult:
    """Return the pose that most matches agree on, as a pure function: the same key gives the same bits.

    Draw triplets of matches, keep those whose object and scene triangles are most congruent, fit a pose to each,
    count the matches within the distance gate whose normals agree, then refit the best pose to its
    inliers under a shrinking gate. Inliers in the result are counted under the full gate. Without consensus the
    result says so (see PoseResult) and its pose is the identity.

    Raises InputError for wrong shapes, dtypes, values that are not finite, and a diameter that is not positive;
    under a trace, matches with such values are left out and such a diameter is PoseStatus.INVALID_INPUT.

    Method: arXiv 2303.16102, pose estimation section.
    """
    check_type(config, RansacConfig, "config")
    key, matches = _checked_key(key), _checked_matches(matches)
    if matches.mask.shape[0] > 0:
        return _first(_ransac(key, matches, config, 1))
    padding = {name: jnp.zeros((1, *getattr(matches, name).shape[1:]), jnp.float32) for name in Matches._fields[:5]}
    result = _first(_ransac(key, matches._replace(**padding, mask=jnp.zeros(1, dtype=bool)), config, 1))
    return result._replace(inlier_mask=result.inlier_mask[:0])


def ransac_modes(key: ArrayInput, matches: Matches, count: int, config: RansacConfig = RansacConfig()) -> PoseResult:
    """Return `count` poses that differ, best first, with a leading axis in all fields: what `ransac` chose among.

    Each is the best one left whose rotation differs by more than 30 degrees, or whose place of the matched points' mean
    by more than 0.15 diameters, from those before. Nearly symmetric parts have several; which one is right is for the
    surface to say. The first is that of `ransac`, up to rounding. Errors as there, and for a count below 1.
    """
    check_whole(count, "count", 1)
    check_type(config, RansacConfig, "config")
    key, matches = _checked_key(key), _checked_matches(matches)
    if not matches.mask.shape[0]:
        raise InputError("matches is empty: pad it, with a mask, to at least one row")
    return _ransac(key, matches, config, count)


def _checked_key(key: ArrayInput) -> jax.Array:
    typed = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.shape == ()
    raw = isinstance(key, jax.Array | np.ndarray) and key.dtype == jnp.uint32 and key.shape == (2,)
    if not (typed or raw):
        raise InputError("key is not a single JAX random key: make one by jax.random.key(seed)")
    return key if typed else jax.random.wrap_key_data(jnp.asarray(key))


def _checked_matches(matches: Matches) -> Matches:
    if not isinstance(matches, Matches):
        raise InputError(f"matches is a {type(matches).__name__}, but must be Matches: see find_matches")
    count = row_count(matches.object_points, "matches.object_points")
    mask = mask_array(matches.mask, "matches.mask", count)
    rows = None if is_traced(mask) else mask

    def checked(name: str, *width: int) -> jax.Array:
        array = float_array(getattr(matches, name), f"matches.{name}", (count, *width), mask=rows)
        return array.astype(jnp.float32)

    weights = checked("weights")
    if rows is not None and not is_traced(weights) and (np.asarray(weights)[np.asarray(rows)] < 0).any():
        raise InputError("matches.weights holds negative values: mask matches that are not to count")
    return Matches(
        object_points=checked("object_points", 3),
        object_normals=checked("object_normals", 3),
        scene_points=checked("scene_points", 3),
        scene_normals=checked("scene_normals", 3),
        weights=weights,
        mask=mask,
        overflow=jnp.asarray(matches.overflow, dtype=bool),
        object_diameter=positive_scalar(matches.object_diameter, "matches.object_diameter").astype(jnp.float32),
    )


def _first(modes: PoseResult) -> PoseResult:
    return jax.tree.map(lambda leaf: leaf[0], modes)


@partial(jax.jit, static_argnames=("config", "num_modes"))
def _ransac(key: PRNGKey, matches: Matches, config: RansacConfig, num_modes: int) -> PoseResult:
    diameter = matches.object_diameter
    input_is_valid = jnp.isfinite(diameter) & (diameter > 0)
    unit = jnp.where(input_is_valid, diameter, 1)
    usable = matches.mask & (matches.weights > 0) & jnp.isfinite(matches.weights)
    for array in matches[:4]:
        usable = usable & jnp.isfinite(array).all(axis=1)
    num_usable = usable.sum(dtype=jnp.int32)

    object_centre, object_points = _centred(matches.object_points, usable, unit)
    scene_centre, scene_points = _centred(matches.scene_points, usable, unit)
    pairs = Pairs(
        object_points,
        scene_points,
        _normalised(matches.object_normals, usable),
        _normalised(matches.scene_normals, usable),
        jnp.where(usable, matches.weights, 0),
        usable,
        jnp.float32(config.min_cosine) if config.use_normals else None,
    )

    triplets, is_candidate = _congruent_triplets(key, object_points, scene_points, usable, config)
    poses = jax.vmap(fit_rigid, in_axes=(0, 0, None))(
        object_points[triplets], scene_points[triplets], jnp.ones(3, jnp.float32)
    )

    counts = jax.vmap(lambda pose: pairs.inliers(pose, config.distance_gate)[0].sum(dtype=jnp.int32))(poses)

    gates = jnp.array(config.refinement_gates, dtype=jnp.float32)
    modes, there = refined_modes(poses, jnp.where(is_candidate, counts, -1), pairs, gates, num_modes)

    def finish(best: Pose, is_there: Bool[Array, ""]) -> PoseResult:
        inlier_mask, squares = pairs.inliers(best, config.distance_gate)
        num_inliers = inlier_mask.sum(dtype=jnp.int32)
        share = jnp.ceil(config.min_inlier_share * num_usable.astype(jnp.float32)).astype(jnp.int32)
        required = jnp.maximum(config.min_inliers, share)
        spread = rotation_is_determined(object_points, jnp.where(inlier_mask, pairs.weights, 0))
        pose = from_rotation_translation(
            best[:3, :3], unit * best[:3, 3] + scene_centre - (best[:3, :3] * object_centre[None, :]).sum(axis=1)
        )
        status = first_status(
            (~input_is_valid, PoseStatus.INVALID_INPUT),
            (num_usable < 3, PoseStatus.TOO_FEW_MATCHES),
            (~is_candidate.any(), PoseStatus.DEGENERATE),
            (~is_there | (num_inliers < required), PoseStatus.NO_CONSENSUS),
            (~spread, PoseStatus.DEGENERATE),
            (~jnp.isfinite(pose).all(), PoseStatus.INVALID_INPUT),
        )
        converged = status == PoseStatus.OK
        squared_error = jnp.where(inlier_mask, squares, 0).sum() / jnp.maximum(num_inliers, 1).astype(jnp.float32)
        return PoseResult(
            T_scene_object=jnp.where(converged, pose, jnp.eye(4, dtype=jnp.float32)),
            score=jnp.where(converged, num_inliers / jnp.maximum(num_usable, 1), 0),
            num_inliers=jnp.where(converged, num_inliers, 0),
            rms_error=jnp.where(converged, unit * jnp.sqrt(squared_error), 0),
            inlier_mask=inlier_mask & converged,
            converged=converged,
            status=status,
        )

    return jax.vmap(finish)(modes, there)


def _congruent_triplets(
    key: PRNGKey, object_points: Points, scene_points: Points, usable: Mask, config: RansacConfig
) -> tuple[Int[Array, "h 3"], Bool[Array, " h"]]:
    """Draw triplets of usable matches, return those with the most congruent triangles, and which of them have any.

    Congruence is the norm of the difference of the side lengths over the smallest height of both triangles.
    """
    count = usable.shape[0]
    order = jnp.nonzero(usable, size=count, fill_value=0)[0]
    num_usable = usable.sum(dtype=jnp.int32)
    uniform = jax.random.uniform(key, (3, config.num_candidates), jnp.float32)
    rank = jnp.floor(uniform * num_usable.astype(jnp.float32)).astype(jnp.int32)
    triplets = order[jnp.clip(rank, 0, jnp.maximum(num_usable - 1, 0))]
    corners = jnp.concatenate([object_points, scene_points], axis=1)[triplets]

    object_sides, object_height = _sides_and_height(corners[:, :, :3])
    scene_sides, scene_height = _sides_and_height(corners[:, :, 3:])
    height = jnp.minimum(object_height, scene_height)
    # A match drawn twice makes a triangle without height.
    proper = height >= _MIN_HEIGHT
    mismatch = jnp.sqrt(((object_sides - scene_sides) ** 2).sum(axis=0)) / jnp.where(proper, height, 1)
    ranking, chosen = largest(jnp.where(proper, -mismatch, -jnp.inf), config.num_hypotheses)
    return triplets[:, chosen].T, jnp.isfinite(ranking)


def _sides_and_height(corners: Float[Array, "3 t 3"]) -> tuple[Float[Array, "3 t"], Float[Array, " t"]]:
    """Return the side lengths of triangles and their smallest height."""
    edges = jnp.roll(corners, -1, axis=0) - corners
    sides = jnp.sqrt((edges**2).sum(axis=-1))
    double_area = jnp.sqrt((jnp.cross(edges[0], edges[1]) ** 2).sum(axis=-1))
    longest = sides.max(axis=0)
    return sides, double_area / jnp.where(longest > 0, longest, 1)


def _centred(points: Points, usable: Mask, unit: Scalar) -> tuple[Float[Array, "3"], Points]:
    """Return the mean of the usable points and the points relative to it in units of `unit`, zero if unusable."""
    points = jnp.where(usable[:, None], points, 0)
    centre = points.sum(axis=0) / jnp.maximum(usable.sum(dtype=jnp.int32), 1).astype(jnp.float32)
    return centre, jnp.where(usable[:, None], (points - centre[None, :]) / unit, 0)


def _normalised(normals: Normals, usable: Mask) -> Normals:
    normals = jnp.where(usable[:, None], normals, 0)
    length = jnp.sqrt((normals**2).sum(axis=1, keepdims=True))
    return normals / jnp.where(length > 0, length, 1)
