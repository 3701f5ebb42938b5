"""Iterative closest points: move a nearly right pose onto the scene."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.errors import (
    InputError,
    check_type,
    float_array,
    is_traced,
    mask_array,
    point_array,
    positive_scalar,
    rigid_pose,
    row_count,
)
from kmn_jax.geometry import (
    compose,
    from_quaternion_translation,
    from_rotation_translation,
    group_points,
    inverse,
    nearest,
    nearest_within,
    rotate_vectors,
    solve_symmetric,
    transform_points,
)
from kmn_jax.pose._kabsch import fit_rigid, rotation_is_determined
from kmn_jax.pose._result import PoseResult, PoseStatus, first_status
from kmn_jax.pose._rounds import repeat_while
from kmn_jax.typing import ArrayInput, Mask, Normals, Points, Pose, Scalar

_MIN_PAIRS = 6  # equations that fix a pose when each pair gives one
_DIVERGED = 0.01  # of the squared gate: a cost that grows by less is noise about the optimum
_FEW_DISTANCES = 2**20  # up to which all of them take CPUs less time than groups
_ALIKE = 0.3  # cosine of normals: pairs of less are of two surfaces
_DAMPING = 1e-5  # of the mean diagonal: directions that no pair constrains stay where they are


@dataclass(frozen=True)
class IcpConfig:
    """Set the refinement. Lengths are fractions of the object's diameter."""

    method: Literal["point_to_plane", "point_to_point"] = "point_to_plane"
    iterations: int = 50
    distance_gate: float = 0.1  # pairs further apart are left out
    robust: Literal["none", "cauchy", "tukey"] = "cauchy"  # how pairs lose weight on the way to the gate
    tolerance: float = 1e-4  # converged when a step is smaller, rotation (radians) plus translation

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        if self.method not in ("point_to_plane", "point_to_point"):
            raise InputError(f"method is {self.method!r}, but must be 'point_to_plane' or 'point_to_point'")
        if self.robust not in ("none", "cauchy", "tukey"):
            raise InputError(f"robust is {self.robust!r}, but must be 'none', 'cauchy' or 'tukey'")
        if self.iterations < 1:
            raise InputError(f"iterations is {self.iterations}, but must be at least 1")
        for name in ("distance_gate", "tolerance"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} is {getattr(self, name)}, but must be above zero")


class _Pairs(NamedTuple):
    """Each scene point with its nearest object point, in diameters about the object's initial place."""

    moved: Points  # object point under the present pose
    object_points: Points  # the same in the object's frame
    inside: Mask  # within the gate
    squares: Float[Array, " n"]  # squared distance of the two points
    cost: Scalar  # mean squared residual over all scene points, cut off at the gate


class _State(NamedTuple):
    step: Int[Array, ""]
    pose: Pose
    pairs: _Pairs
    change: Scalar
    determined: Bool[Array, ""]


def icp(
    object_points: ArrayInput,
    scene_points: ArrayInput,
    T_scene_object: ArrayInput,
    object_diameter: ArrayInput,
    scene_normals: ArrayInput | None = None,
    object_mask: ArrayInput | None = None,
    scene_mask: ArrayInput | None = None,
    config: IcpConfig = IcpConfig(),
    *,
    object_normals: ArrayInput | None = None,
) -> PoseResult:
    """Refine an initial T_scene_object (4, 4) so that object points (m, 3) meet scene points (n, 3).

    Every scene point is paired with its nearest object point, not the other way round, as the object has
    points that the camera did not see. Point to plane measures along the scene's normals (n, 3), which it needs.
    With normals of the object (m, 3), too, pairs whose normals disagree are left out, as of the two sides of a thin
    wall. Rows where a mask is false are padding; the object's may also leave out what cannot be seen. Directions that
    the geometry leaves open, such as sliding along a single plane, keep their initial value.

    A refinement returns a usable pose even when it fails, other than a search: with `converged` false it is the
    initial one (status NO_OVERLAP, DEGENERATE or DIVERGED) or the last and better one (ITERATION_LIMIT). A start
    that is as good as the result is returned itself. Under a trace, an initial pose or diameter that is not
    finite is INVALID_INPUT, with the identity as the pose. `score` is the share of scene points
    within the gate.

    Raises InputError for wrong shapes and dtypes, values that are not finite, points that lie too far from the origin
    for float32, an initial pose that is not rigid and missing normals.
    """
    check_type(config, IcpConfig, "config")
    object_count = row_count(object_points, "object_points")
    scene_count = row_count(scene_points, "scene_points")
    object_mask = mask_array(object_mask, "object_mask", object_count)
    scene_mask = mask_array(scene_mask, "scene_mask", scene_count)
    object_rows, scene_rows = (None if is_traced(m) else m for m in (object_mask, scene_mask))
    if config.method == "point_to_plane" and scene_normals is None:
        raise InputError("scene_normals is missing: point to plane needs it, or choose method='point_to_point'")
    diameter = positive_scalar(object_diameter, "object_diameter")
    arrays = [
        point_array(object_points, "object_points", mask=object_rows, size=diameter),
        point_array(scene_points, "scene_points", mask=scene_rows, size=diameter),
        rigid_pose(T_scene_object, "T_scene_object"),
        diameter,
    ]
    if object_count == 0 or scene_count == 0:
        raise InputError(f"{object_count} object points and {scene_count} scene points given: both must be some")
    if object_normals is not None and scene_normals is None:
        raise InputError("object_normals is given without scene_normals to compare it with: give both")
    if scene_normals is None:
        scene_normals = jnp.zeros((scene_count, 3), dtype=jnp.float32)
    arrays.append(float_array(scene_normals, "scene_normals", (scene_count, 3), mask=scene_rows))
    if object_normals is not None:
        object_normals = float_array(object_normals, "object_normals", (object_count, 3), mask=object_rows)
        object_normals = object_normals.astype(jnp.float32)
    return _icp(*(array.astype(jnp.float32) for array in arrays), object_mask, scene_mask, object_normals, config)


@partial(jax.jit, static_argnames="config")
def _icp(
    object_points: Float[Array, "m 3"],
    scene_points: Points,
    T_scene_object: Pose,
    object_diameter: Scalar,
    scene_normals: Normals,
    object_mask: Bool[Array, " m"],
    scene_mask: Mask,
    object_normals: Float[Array, "m 3"] | None,
    config: IcpConfig,
) -> PoseResult:
    valid = jnp.isfinite(T_scene_object).all() & jnp.isfinite(object_diameter) & (object_diameter > 0)
    initial = jnp.where(valid, T_scene_object, jnp.eye(4, dtype=jnp.float32))
    unit = jnp.where(valid, object_diameter, 1)
    object_mask = object_mask & jnp.isfinite(object_points).all(axis=1)
    scene_mask = scene_mask & jnp.isfinite(scene_points).all(axis=1) & jnp.isfinite(scene_normals).all(axis=1)
    if config.method == "point_to_plane":  # a point without a normal measures nothing
        scene_mask = scene_mask & (scene_normals != 0).any(axis=1)

    # Both clouds about the object's centre at its initial pose, in diameters: small numbers, and no unit.
    object_points = jnp.where(object_mask[:, None], object_points, 0)
    num_object = jnp.maximum(object_mask.sum(dtype=jnp.int32), 1).astype(jnp.float32)
    object_centre = object_points.sum(axis=0) / num_object
    scene_centre = transform_points(initial, object_centre[None, :])[0]
    model = (object_points - object_centre[None, :]) / unit
    scene = jnp.where(scene_mask[:, None], (scene_points - scene_centre[None, :]) / unit, 0)
    normals = jnp.where(scene_mask[:, None], scene_normals, 0)
    num_scene = jnp.maximum(scene_mask.sum(dtype=jnp.int32), 1).astype(jnp.float32)
    gate = config.distance_gate

    grouped = scene.shape[0] * model.shape[0] > _FEW_DISTANCES
    if grouped:
        groups, blocks = group_points(model, object_mask), group_points(scene, scene_mask)
        # The pose moves all scene points as one: blocks of them that lie together stay together.
        scene, normals, scene_mask = (array[blocks.rows.reshape(-1)] for array in (scene, normals, scene_mask))
        scene_mask = scene_mask & blocks.mask.reshape(-1)

    def nearest_of_object(local: Points) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
        if not grouped:
            return nearest(local, model, object_mask)
        rows, distances = nearest_within(local.reshape(*blocks.mask.shape, 3), blocks.mask, groups, gate)
        return rows.reshape(-1), distances.reshape(-1)

    def in_order_given(mask: Bool[Array, " blocked"]) -> Mask:
        if not grouped:
            return mask
        rows = jnp.where(blocks.mask, blocks.rows, scene_points.shape[0]).reshape(-1)
        return jnp.zeros_like(scene_points[:, 0], dtype=bool).at[rows].set(mask, mode="drop")

    def residuals(pairs_moved: Points) -> Float[Array, " n"]:
        difference = pairs_moved - scene
        if config.method == "point_to_plane":
            return (normals * difference).sum(axis=1)
        return jnp.sqrt((difference**2).sum(axis=1))

    def find_pairs(pose: Pose) -> _Pairs:
        index, distance = nearest_of_object(transform_points(inverse(pose), scene))
        moved = transform_points(pose, model[index])
        inside = scene_mask & (distance <= gate)
        # Of all pairs within the gate: one that is left out must not weigh more than one that fits badly.
        cost = jnp.where(inside, residuals(moved) ** 2, gate**2)
        if object_normals is not None:
            turned = rotate_vectors(pose, object_normals[index])
            inside = inside & ((turned * normals).sum(axis=1) > _ALIKE)
        return _Pairs(moved, model[index], inside, distance**2, jnp.where(scene_mask, cost, 0).sum() / num_scene)

    def iterate(state: _State) -> _State:
        moved, object_side, inside, _, _ = state.pairs
        residual = residuals(moved)
        weights = jnp.where(inside, _robust_weight(residual / gate, config.robust), 0)
        if config.method == "point_to_plane":
            update = plane_step(moved, normals, residual, weights)
            pose = compose(update, state.pose)
            # A single plane leaves sliding open, which the damping holds; a line or a point leaves a turn open.
            sides = jnp.stack([object_side, scene])
            determined = jax.vmap(rotation_is_determined, in_axes=(0, None))(sides, weights).all()
        else:
            pose, determined = fit_rigid(object_side, scene, weights), rotation_is_determined(object_side, weights)
        usable = determined & jnp.isfinite(pose).all() & (inside.sum(dtype=jnp.int32) >= _MIN_PAIRS)
        pose = jnp.where(usable, pose, state.pose)
        return _State(state.step + 1, pose, find_pairs(pose), motion_between(state.pose, pose), determined)

    def is_moving(state: _State) -> Bool[Array, ""]:
        return (state.step < config.iterations) & (state.change > config.tolerance)

    start = from_rotation_translation(initial[:3, :3], jnp.zeros_like(initial[:3, 3]))
    first = find_pairs(start)
    state = _State(jnp.int32(0), start, first, jnp.float32(jnp.inf), jnp.array(True))
    state = repeat_while(is_moving, iterate, state, config.iterations)

    status = first_status(
        (~valid, PoseStatus.INVALID_INPUT),
        (first.inside.sum(dtype=jnp.int32) < _MIN_PAIRS, PoseStatus.NO_OVERLAP),
        (~state.determined, PoseStatus.DEGENERATE),
        (state.pairs.cost > first.cost + _DIVERGED * gate**2, PoseStatus.DIVERGED),
        (state.change > config.tolerance, PoseStatus.ITERATION_LIMIT),
    )
    moved_on = (status == PoseStatus.OK) | (status == PoseStatus.ITERATION_LIMIT)
    moved_on = moved_on & (state.pairs.cost <= first.cost)
    pairs = jax.tree.map(lambda new, old: jnp.where(moved_on, new, old), state.pairs, first)
    rotation = state.pose[:3, :3]
    shift = unit * state.pose[:3, 3] + scene_centre - (rotation * object_centre[None, :]).sum(axis=1)
    num_inliers = pairs.inside.sum(dtype=jnp.int32)
    mean_square = jnp.where(pairs.inside, pairs.squares, 0).sum() / jnp.maximum(num_inliers, 1).astype(jnp.float32)
    return PoseResult(
        T_scene_object=jnp.where(moved_on, from_rotation_translation(rotation, shift), initial),
        score=num_inliers.astype(jnp.float32) / num_scene,
        num_inliers=num_inliers,
        rms_error=unit * jnp.sqrt(mean_square),
        inlier_mask=in_order_given(pairs.inside),
        converged=status == PoseStatus.OK,
        status=status,
    )


def motion_between(before: Pose, after: Pose) -> Scalar:
    """Return how far a small motion has turned a pose, in radians, plus how far it has shifted it."""
    turned = jnp.sqrt(((after[:3, :3] - before[:3, :3]) ** 2).sum() / 2)
    return turned + jnp.sqrt(((after[:3, 3] - before[:3, 3]) ** 2).sum())


def _robust_weight(residual: Float[Array, " n"], kind: str) -> Float[Array, " n"]:
    """Weigh residuals given in gates."""
    if kind == "tukey":
        return jnp.maximum(1 - residual**2, 0) ** 2
    if kind == "cauchy":
        return 1 / (1 + (residual / 0.25) ** 2)
    return jnp.ones_like(residual)


def plane_step(moved: Points, normals: Normals, residual: Float[Array, " n"], weights: Float[Array, " n"]) -> Pose:
    """Return the small motion that brings points onto their planes, by the damped 6x6 normal equations."""
    rows = jnp.concatenate([jnp.cross(moved, normals), normals, residual[:, None]], axis=1)
    # The residual is one column more: all sums are one product.
    sums = jnp.matmul((weights[:, None] * rows).T, rows, precision=jax.lax.Precision.HIGHEST)
    system = sums[:6, :6]
    damping = _DAMPING * jnp.trace(system) / 6
    solution = solve_symmetric(
        system + jnp.where(damping > 0, damping, 1) * jnp.eye(6, dtype=system.dtype), -sums[:6, 6]
    )
    # A quaternion of any length turns by a proper rotation, also when the linear step is not small.
    return from_quaternion_translation(jnp.concatenate([jnp.ones(1, solution.dtype), solution[:3] / 2]), solution[3:])
