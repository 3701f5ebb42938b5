"""Rigid alignment of corresponding points: weighted, reflection-safe, closed form, differentiable."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from kmn_jax.errors import InputError, check_digits, extent, float_array, is_traced, mask_array, row_count
from kmn_jax.geometry import dominant_eigenvector, from_rotation_translation, quaternion_to_matrix, solve_symmetric
from kmn_jax.typing import ArrayInput, Points, Pose, Rotation

_MIN_SPREAD = 1e-4  # variance across the line over variance along it, below which points count as collinear


def kabsch(source: ArrayInput, target: ArrayInput, weights: ArrayInput | None = None) -> jax.Array:
    """Return T_target_source (4, 4), the rigid motion that takes source points closest to target points.

    It minimises sum_i w_i |R source_i + t - target_i|^2 over proper rotations (never a mirror image) for points
    (n, 3) in any one unit and weights (n,) >= 0, by default all one. Rows of weight zero are padding and have
    no gradient. Collinear or coincident points leave a rotation open: the result is then one of the best. It may
    be differentiated in forward and reverse mode; where the rotation is open, gradients are finite.

    Raises InputError for unequal or wrong shapes, fewer than 3 points, fewer than 3 positive weights, negative
    weights, values that are not finite and points that lie too far from the origin for float32. Under a trace values
    cannot be checked: points or weights that are not finite, and negative weights, then count as weight zero.

    Method: B. K. P. Horn, Closed-form solution of absolute orientation using unit quaternions, 1987.
    """
    count = row_count(source, "source")
    if weights is None:
        weights = jnp.ones(count, dtype=jnp.float32)
    weights = float_array(weights, "weights", (count,))
    mask, used = None, None
    if not is_traced(weights):
        if (np.asarray(weights) < 0).any():
            raise InputError("weights holds negative values: give zero to points that are not to count")
        used = np.asarray(weights) > 0
        mask = mask_array(used, "weights", count)
    arrays = [float_array(source, "source", (None, 3), mask=mask), float_array(target, "target", (count, 3), mask=mask)]
    if count < 3:
        raise InputError(f"source has {count} points, but a pose needs at least 3")
    if used is not None and used.sum() < 3:
        raise InputError(f"weights are positive for {used.sum()} points only, but a pose needs at least 3")
    dtype = jnp.float64 if jnp.float64 in [array.dtype for array in arrays] else jnp.float32
    if used is not None and dtype != jnp.float64 and not any(map(is_traced, arrays)):
        clouds = [np.asarray(points, dtype=np.float64)[used] for points in (source, target)]
        size = max(map(extent, clouds))
        for points, name in zip(clouds, ("source", "target"), strict=True):
            check_digits(points, name, size)
    return _fit_rigid(*(array.astype(dtype) for array in (*arrays, weights)))


def fit_rigid(source: Points, target: Points, weights: Float[Array, " n"]) -> Pose:
    """Return T_target_source as `kabsch` does, without checks and not compiled by itself.

    All of it is elementwise arithmetic and sums: thousands of small problems run under vmap without a serial
    loop, and no matrix unit gets to lower the precision of a product.
    """
    finite = jnp.isfinite(source).all(axis=1) & jnp.isfinite(target).all(axis=1) & jnp.isfinite(weights)
    weights = _normalised(jnp.where(finite, weights, 0))
    source_centre, source = _centre(source, weights)
    target_centre, target = _centre(target, weights)
    # The rotation does not depend on either scale, so that its derivative by them is exactly zero.
    source_unit, target_unit = source / _magnitude(source), target / _magnitude(target)
    weighted = weights[:, None] * target_unit
    rotation = best_rotation((weighted[:, :, None] * source_unit[:, None, :]).sum(axis=0))
    translation = target_centre - (rotation * source_centre[None, :]).sum(axis=1)
    return from_rotation_translation(rotation, translation)


_fit_rigid = jax.jit(fit_rigid)


@jax.custom_jvp
def best_rotation(covariance: Float[Array, "3 3"]) -> Rotation:
    """Return the proper rotation R that maximises tr(R^T C) for the 3x3 cross-covariance C of target and source.

    C = sum_i w_i target_i source_i^T of centred points. Where several rotations are best, it is one of them.
    """
    unit = covariance / _magnitude(covariance)
    s = unit.T
    k01, k02, k03 = s[1, 2] - s[2, 1], s[2, 0] - s[0, 2], s[0, 1] - s[1, 0]
    k12, k13, k23 = s[0, 1] + s[1, 0], s[2, 0] + s[0, 2], s[1, 2] + s[2, 1]
    xx, yy, zz = s[0, 0], s[1, 1], s[2, 2]
    rows = [
        [xx + yy + zz, k01, k02, k03],
        [k01, xx - yy - zz, k12, k13],
        [k02, k12, yy - xx - zz, k23],
        [k03, k13, k23, zz - xx - yy],
    ]
    matrix = jnp.stack([jnp.stack(row) for row in rows])
    # No eigenvalue lies below minus the sum of singular values, itself at most sqrt(3) times the Frobenius norm.
    shift = jnp.sqrt(3 * (unit**2).sum())
    return quaternion_to_matrix(dominant_eigenvector(matrix + shift * jnp.eye(4, dtype=matrix.dtype)))


@best_rotation.defjvp
def _best_rotation_jvp(
    primals: tuple[Float[Array, "3 3"]], tangents: tuple[Float[Array, "3 3"]]
) -> tuple[Rotation, Float[Array, "3 3"]]:
    """Differentiate the optimality condition "S = R^T C is symmetric".

    With dR = R [omega]x it reads (tr(S) I - S) omega = vee(R^T dC - dC^T R). That matrix has the sums of two
    singular values as eigenvalues, not their differences: repeated ones do no harm. It is singular
    only where the rotation itself is open (collinear points), which the bounded pivots of `solve_symmetric` absorb.
    """
    (covariance,), (tangent,) = primals, tangents
    rotation = best_rotation(covariance)
    magnitude = _magnitude(covariance)
    unit, tangent = covariance / magnitude, tangent / magnitude
    stretch = _product(rotation.T, unit)
    stretch = (stretch + stretch.T) / 2
    system = jnp.trace(stretch) * jnp.eye(3, dtype=stretch.dtype) - stretch
    turned = _product(rotation.T, tangent)
    skew = turned - turned.T
    x, y, z = solve_symmetric(system, jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]]))
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    return rotation, _product(rotation, cross)


def rotation_is_determined(points: Points, weights: Float[Array, " n"]) -> Bool[Array, ""]:
    """Tell whether weighted points spread in at least two directions, so that their pose has one best rotation.

    Points in one place, on one line or within 1% of one (standard deviations) do not.
    """
    weights = _normalised(weights)
    _, centred = _centre(points, weights)
    centred = centred / _magnitude(centred)
    return spread_is_determined((weights[:, None, None] * centred[:, :, None] * centred[:, None, :]).sum(axis=0))


def spread_is_determined(scatter: Float[Array, "3 3"]) -> Bool[Array, ""]:
    """Tell the same from the points' second moments about their mean."""
    # Sum of the principal 2x2 minors over the squared trace: about the ratio of the two largest eigenvalues.
    trace = jnp.trace(scatter)
    minors = (trace**2 - (scatter**2).sum()) / 2
    return minors > _MIN_SPREAD * trace**2


def _normalised(weights: Float[Array, " n"]) -> Float[Array, " n"]:
    weights = jnp.where(weights > 0, weights, 0)
    total = weights.sum()
    return weights / jnp.where(total > 0, total, 1)


def _centre(points: Points, weights: Float[Array, " n"]) -> tuple[Float[Array, "3"], Points]:
    """Return the weighted mean and the points relative to it, zero where they have no weight.

    The mean is taken twice, as a single one far from the origin is coarse in float32.
    """
    used = weights[:, None] > 0
    points = jnp.where(used, points, 0)
    coarse = (weights[:, None] * points).sum(axis=0)
    centred = jnp.where(used, points - coarse[None, :], 0)
    rest = (weights[:, None] * centred).sum(axis=0)
    return coarse + rest, jnp.where(used, centred - rest[None, :], 0)


def _magnitude(values: Array) -> Float[Array, ""]:
    """Return the largest absolute value, or 1 if all are zero, as a constant to differentiation."""
    largest = jax.lax.stop_gradient(jnp.abs(values).max())
    return jnp.where(largest > 0, largest, 1)


def _product(a: Float[Array, "3 3"], b: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    return (a[:, :, None] * b[None, :, :]).sum(axis=1)
