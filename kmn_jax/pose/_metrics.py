"""Pose errors and recall, as the field reports them. All lengths are in the unit of the points.

Poses and points may lie anywhere in their frames, if they are given in float64 (NumPy's) there: outside of a trace they
are taken relative to the object as it is truly posed before anything is computed in float32.

ADD and ADI: Hinterstoisser et al. 2012; MSSD and discretised symmetries: the BOP challenge's methodology.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kmn_jax.errors import (
    InputError,
    check_digits,
    check_whole,
    extent,
    float_array,
    is_coarse,
    is_traced,
    positive_scalar,
    rigid_pose,
    row_count,
)
from kmn_jax.geometry import (
    compose,
    from_quaternion_translation,
    largest_distance,
    safe_norm,
    safe_sqrt,
    squared_distances,
    transform_points,
)
from kmn_jax.typing import ArrayInput, Points, Pose, Scalar


def add(T_estimated: ArrayInput, T_true: ArrayInput, points: ArrayInput) -> jax.Array:
    """Return the mean distance between object points (m, 3) under two poses, for objects without symmetry."""
    return _add(*_checked(T_estimated, T_true, points))


def adi(T_estimated: ArrayInput, T_true: ArrayInput, points: ArrayInput) -> jax.Array:
    """Return the mean distance from each truly posed point to the nearest estimated one, for any object.

    It forgives symmetries, as each point may meet any other.
    """
    return _adi(*_checked(T_estimated, T_true, points))


def mssd(
    T_estimated: ArrayInput, T_true: ArrayInput, points: ArrayInput, symmetries: ArrayInput | None = None
) -> jax.Array:
    """Return the largest distance between object points under two poses, at the most favourable symmetry.

    `symmetries` (s, 4, 4) are motions of the object onto itself in its own frame, in the unit of the points
    (see `discretise_symmetry`); the identity always counts among them.
    """
    if symmetries is None:
        symmetries = np.zeros((0, 4, 4), np.float32)
    return _mssd(*_checked(T_estimated, T_true, points, symmetries))


def discretise_symmetry(axis: ArrayInput, offset: ArrayInput, count: int) -> jax.Array:
    """Return `count` turns (count, 4, 4) about an axis (3,) of any length through the point `offset` (3,).

    The turns are equally spaced and start with the identity. They stand for a continuous symmetry, or are exactly
    a discrete one of that order.
    """
    axis = float_array(axis, "axis", (3,))
    offset = float_array(offset, "offset", (3,))
    check_whole(count, "count", 1)
    if not is_traced(axis) and not np.asarray(axis).any():
        raise InputError("axis is zero, but must have a direction")
    return _turns(axis, offset, count)


def bounding_box_diagonal(points: ArrayInput) -> jax.Array:
    """Return the diagonal of the axis-aligned box around points (m, 3): the object's size as published."""
    points = _centred(points)
    return jnp.sqrt(((points.max(axis=0) - points.min(axis=0)) ** 2).sum())


def diameter(points: ArrayInput) -> jax.Array:
    """Return the largest distance between any two points (m, 3): the object's size as BOP takes it.

    Time grows with the square of m: thin clouds of many thousand points first, or take their convex hull.
    """
    return _diameter(_centred(points))


def recall(errors: ArrayInput, size: ArrayInput, threshold: ArrayInput = 0.1) -> jax.Array:
    """Return the share of errors (n,) below `threshold` times the size, one for all () or one each (n,).

    A pose that was not found counts by an infinite error. Raises InputError without a single error, for NaN among them
    and for sizes and thresholds that are not above zero.
    """
    errors = some_errors(errors)
    size = float_array(size, "size", errors.shape if np.ndim(size) else ())
    if not is_traced(size) and not (np.asarray(size) > 0).all():
        raise InputError("size must be above zero")
    return (errors < positive_scalar(threshold, "threshold") * size).mean(dtype=jnp.float32)


def some_errors(errors: ArrayInput) -> jax.Array:
    """Return pose errors (n,), at least one, infinite ones for poses that were not found, or raise InputError."""
    count = row_count(errors, "errors")
    if count == 0:
        raise InputError("errors is empty, but a share needs at least one")
    errors = float_array(errors, "errors", (count,), finite=False)
    if not is_traced(errors) and np.isnan(np.asarray(errors)).any():
        raise InputError("errors holds NaN: a pose that was not found has an infinite error")
    return errors


def about_the_object(T_estimated: np.ndarray, T_true: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two poses of an object for its frame with `centre` as the origin, in the scene's with its true place.

    All is float64 of the host: what is computed of these in float32 has lost no digits, wherever the object lies.
    """
    place = T_true[:3, :3] @ centre + T_true[:3, 3]
    return _moved(T_estimated, centre, place), _moved(T_true, centre, place)


def _moved(T_b_a: np.ndarray, origin_a: np.ndarray, origin_b: np.ndarray) -> np.ndarray:
    """Return a motion between frames with other origins."""
    T = T_b_a.copy()
    T[:3, 3] += T[:3, :3] @ origin_a - origin_b
    return T


def _checked(T_estimated: ArrayInput, T_true: ArrayInput, points: ArrayInput, *motions: ArrayInput) -> list[jax.Array]:
    """Return the arguments in float32, `motions` (s, 4, 4) of the object's frame in it among them."""
    given = (T_estimated, T_true, points, *motions)
    arrays = [rigid_pose(T_estimated, "T_estimated"), rigid_pose(T_true, "T_true"), _some_points(points)]
    arrays += [float_array(some, "symmetries", (None, 4, 4)) for some in motions]
    if not any(map(is_traced, arrays)):
        _check_places(T_estimated, T_true, points)
        estimated, true, cloud, *several = (np.asarray(value, dtype=np.float64) for value in given)
        centre = cloud.mean(axis=0)
        turns = [np.array([_moved(T, centre, centre) for T in some]).reshape(-1, 4, 4) for some in several]
        arrays = [jnp.asarray(value) for value in (*about_the_object(estimated, true, centre), cloud - centre, *turns)]
    return [array.astype(jnp.float32) for array in arrays]


def _check_places(T_estimated: ArrayInput, T_true: ArrayInput, points: ArrayInput) -> None:
    """Raise InputError if poses or points in single precision lie where it does not hold the object's shape."""
    size = extent(_double(points))
    for name, pose in (("T_estimated", np.asarray(T_estimated)), ("T_true", np.asarray(T_true))):
        farthest = float(np.abs(pose[:3, 3]).max())
        if _is_single(pose) and is_coarse(farthest, size):
            raise InputError(
                f"{name} places an object of size {size:.3g} at a distance of {farthest:.3g}, and float32 has not"
                " enough digits for both: give it in float64, as an array of NumPy"
            )


def _centred(points: ArrayInput) -> jax.Array:
    """Return points in float32, those that are not traced about their mean, whose sizes are the same."""
    array = _some_points(points)
    if is_traced(array):
        return array
    double = _double(points)
    return jnp.asarray(double - double.mean(axis=0)).astype(jnp.float32)


def _double(points: ArrayInput) -> np.ndarray:
    """Return points in float64, or raise InputError if they have lost their digits before."""
    double = np.asarray(points, dtype=np.float64)
    if _is_single(np.asarray(points)):
        check_digits(double, "points")
    return double


def _is_single(array: np.ndarray) -> bool:
    """Tell whether an array may have been rounded to single precision, or less, before it came here."""
    return array.dtype != np.float64 and array.dtype.kind not in "iu"


def _some_points(points: ArrayInput) -> jax.Array:
    array = float_array(points, "points", (None, 3)).astype(jnp.float32)
    if array.shape[0] == 0:
        raise InputError("points is empty, but at least one point is needed")
    return array


def _both(T_estimated: Pose, T_true: Pose, points: Points) -> tuple[Points, Points]:
    """Return the points under both poses, relative to the centre of the true ones so that digits are not lost."""
    centre = points.mean(axis=0)
    points = points - centre[None, :]
    here = transform_points(T_estimated, centre[None, :]) - transform_points(T_true, centre[None, :])
    turned = jnp.matmul(points, T_estimated[:3, :3].T, precision=jax.lax.Precision.HIGHEST)
    return turned + here, jnp.matmul(points, T_true[:3, :3].T, precision=jax.lax.Precision.HIGHEST)


@jax.jit
def _add(T_estimated: Pose, T_true: Pose, points: Points) -> Scalar:
    estimated, true = _both(T_estimated, T_true, points)
    return safe_norm(estimated - true).mean()


@jax.jit
def _adi(T_estimated: Pose, T_true: Pose, points: Points) -> Scalar:
    estimated, true = _both(T_estimated, T_true, points)
    return safe_sqrt(squared_distances(true, estimated).min(axis=1)).mean()


@jax.jit
def _mssd(T_estimated: Pose, T_true: Pose, points: Points, symmetries: Float[Array, "s 4 4"]) -> Scalar:
    symmetries = jnp.concatenate([jnp.eye(4, dtype=jnp.float32)[None], symmetries.astype(jnp.float32)])

    def largest(symmetry: Pose) -> Scalar:
        estimated, true = transform_points(T_estimated, points), transform_points(compose(T_true, symmetry), points)
        return safe_norm(estimated - true).max()

    return jax.vmap(largest)(symmetries).min()


_diameter = jax.jit(largest_distance)


@partial(jax.jit, static_argnums=2)
def _turns(axis: Float[Array, "3"], offset: Float[Array, "3"], count: int) -> Float[Array, "c 4 4"]:
    half = jnp.arange(count, dtype=axis.dtype) * (jnp.pi / count)
    unit = axis / jnp.sqrt((axis**2).sum())
    quaternions = jnp.concatenate([jnp.cos(half)[:, None], jnp.sin(half)[:, None] * unit[None, :]], axis=1)

    def turn(quaternion: Float[Array, "4"]) -> Pose:
        about_origin = from_quaternion_translation(quaternion, jnp.zeros_like(axis))
        return about_origin.at[:3, 3].set(offset - (about_origin[:3, :3] * offset[None, :]).sum(axis=1))

    return jax.vmap(turn)(quaternions)
