"""How exact poses are, symmetries taken out, and how well detections rank: what a gripper cares about beyond ADI.

Average recall and precision: the BOP challenge's methodology, with MSSD as the error.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from kmn_jax.errors import InputError, check_whole, float_array, is_traced, mask_array, rigid_pose
from kmn_jax.geometry import rotation_angle_between, safe_norm
from kmn_jax.pose._metrics import about_the_object, some_errors
from kmn_jax.typing import ArrayInput, Pose, Scalar

THRESHOLDS = tuple(round(0.05 * step, 2) for step in range(1, 11))  # of MSSD, in diameters, as BOP takes them
_RECALLS = 101  # at which precision is read
RIGHT, WRONG, LEFT_OUT = 1, 0, -1  # what a pose is at a threshold


def symmetric_pose_error(
    T_estimated: ArrayInput, T_true: ArrayInput, rotations: ArrayInput, axes: ArrayInput, center: ArrayInput
) -> tuple[jax.Array, jax.Array]:
    """Return rotation error in radians, at the most favourable symmetry, and the distance of the object's centres.

    `rotations` (s, 3, 3) are the object's discrete symmetries about `center` (3,), the identity among them; about
    `axes` (c, 3), of unit length, every turn is one. With one axis, the error is the angle between both poses' axes;
    with several, as of a ball, it is zero. Far from the origin, give poses in float64 (see `adi`). Raises InputError
    for wrong shapes, poses that are not rigid and no symmetry at all.
    """
    poses = [rigid_pose(T_estimated, "T_estimated"), rigid_pose(T_true, "T_true")]
    rotations = float_array(rotations, "rotations", (None, 3, 3))
    if len(rotations) == 0:
        raise InputError("rotations is empty, but the identity is a symmetry of every object")
    axes = float_array(axes, "axes", (None, 3))
    place = float_array(center, "center", (3,))
    if not any(map(is_traced, (*poses, place))):
        given = (np.asarray(value, dtype=np.float64) for value in (T_estimated, T_true, center))
        poses = [jnp.asarray(pose) for pose in about_the_object(*given)]
        place = jnp.zeros(3, jnp.float32)
    arrays = (*poses, rotations, axes, place)
    return _symmetric_pose_error(*(array.astype(jnp.float32) for array in arrays))


@jax.jit
def _symmetric_pose_error(
    T_estimated: Pose,
    T_true: Pose,
    rotations: Float[Array, "s 3 3"],
    axes: Float[Array, "c 3"],
    center: Float[Array, "3"],
) -> tuple[Scalar, Scalar]:
    def product(*matrices: Float[Array, "..."]) -> Float[Array, "..."]:
        result = matrices[0]
        for matrix in matrices[1:]:
            result = jnp.matmul(result, matrix, precision=jax.lax.Precision.HIGHEST)
        return result

    estimated, true = T_estimated[:3, :3], T_true[:3, :3]

    def angle(symmetry: Float[Array, "3 3"]) -> Scalar:
        if len(axes) == 0:
            return rotation_angle_between(estimated, product(true, symmetry))
        one, other = product(estimated, axes[0]), product(true, symmetry, axes[0])
        return jnp.arctan2(safe_norm(jnp.cross(one, other)), (one * other).sum())

    # Differences first, so that digits far from the origin are kept.
    apart = T_estimated[:3, 3] - T_true[:3, 3] + product(estimated - true, center)
    rotation = jnp.zeros((), jnp.float32) if len(axes) > 1 else jax.vmap(angle)(rotations).min()
    return rotation, safe_norm(apart)


def average_recall(errors: ArrayInput) -> float:
    """Return the mean share of errors (n,), in diameters, below the thresholds from 0.05 to 0.5.

    A pose that was not found counts by an infinite error. Raises InputError without a single error, and for NaN.
    """
    found = np.asarray(some_errors(errors))
    return float(np.mean([(found < threshold).mean() for threshold in THRESHOLDS]))


def match_copies(errors: ArrayInput, counted: ArrayInput, threshold: float) -> Int[np.ndarray, " s"]:
    """Return what each pose of an image is: RIGHT, WRONG, or LEFT_OUT of the count.

    `errors` (s, i) are those of poses as each copy's, of which `counted` (i,) tells those that count.
    Poses come from the most probable one on; each takes the copy, of those that are free, to which its error is least
    and below the threshold. Copies that are not `counted`, as hardly anything of them is seen, are taken last; what
    takes them is left out. Raises InputError for wrong shapes and NaN.
    """
    copies = float_array(errors, "errors", (None, None), finite=False).shape[1]
    errors = np.asarray(errors)
    counted = np.asarray(mask_array(counted, "counted", copies))
    if np.isnan(errors).any():
        raise InputError("errors holds NaN: a pose that cannot be a copy's has an infinite error")
    if not threshold > 0:
        raise InputError(f"threshold is {threshold}, but must be above zero")
    states, free = np.full(len(errors), WRONG), np.ones(len(counted), dtype=bool)
    for row, own in enumerate(errors):
        for group, state in ((counted, RIGHT), (~counted, LEFT_OUT)):
            possible = np.where(free & group & (own < threshold), own, np.inf)
            if np.isfinite(possible).any():
                free[possible.argmin()] = False
                states[row] = state
                break
    return states


def average_precision(scores: ArrayInput, right: ArrayInput, num_true: int) -> float:
    """Return the mean precision over all recalls, of detections with scores (n,), higher ones better, and `right` (n,).

    At each recall from 0 to 1, in steps of 0.01, counts the best precision at that recall or a higher one, zero where
    none is so high. `num_true` is how many there are to find. Raises InputError if there are none, or fewer than are
    right, for wrong shapes and for scores that are not finite.
    """
    count = len(float_array(scores, "scores", (None,)))
    scores = np.asarray(scores, dtype=np.float64)
    right = np.asarray(mask_array(right, "right", count))
    check_whole(num_true, "num_true", 1)
    if right.sum() > num_true:
        raise InputError(f"{right.sum()} detections are right, but num_true is only {num_true}: match each copy once")
    if not len(scores):
        return 0.0
    hits = np.cumsum(right[np.argsort(-scores, kind="stable")])
    precision = hits / np.arange(1, len(hits) + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    # Recalls are compared as whole numbers of hits: 0.07 * 100 is above 7.
    rows = np.searchsorted(hits * (_RECALLS - 1), np.arange(_RECALLS) * num_true)
    return float(np.append(best, 0.0)[rows].mean())
