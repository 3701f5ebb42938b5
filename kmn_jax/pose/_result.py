"""The one answer to "where is the object?": a pose, how good it is, and why not if there is none."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from kmn_jax.errors import InputError


class PoseStatus(IntEnum):
    """Say how a search or a refinement ended.

    After a search (`ransac`) only OK means that the pose may be used; a refinement (`icp`) returns one no worse than
    the one it began with, whatever its status but INVALID_INPUT.
    """

    OK = 0
    INVALID_INPUT = 1
    TOO_FEW_MATCHES = 2
    DEGENERATE = 3
    NO_CONSENSUS = 4
    NO_OVERLAP = 5
    ITERATION_LIMIT = 6
    DIVERGED = 7

    @property
    def reason(self) -> str:
        """Return the outcome in words."""
        return _REASONS[self]


_REASONS = {
    PoseStatus.OK: "the pose was found",
    PoseStatus.INVALID_INPUT: "the object's diameter is not positive and finite, or the initial pose is not finite",
    PoseStatus.TOO_FEW_MATCHES: "fewer than three usable matches: no part of the scene was taken for the object",
    PoseStatus.DEGENERATE: "the matched points lie on one line or in one place, which leaves the rotation open",
    PoseStatus.NO_CONSENSUS: "no pose is supported by more matches than chance would bring together",
    PoseStatus.NO_OVERLAP: "too few scene points lie within the gate of the object at its initial pose",
    PoseStatus.ITERATION_LIMIT: "the last allowed iteration still moved the pose by more than the tolerance",
    PoseStatus.DIVERGED: "the refined pose fits worse than the initial one, which is kept",
}


def first_status(*conditions: tuple[Bool[Array, ""], PoseStatus]) -> Int[Array, ""]:
    """Return the status of the first condition that is true, OK if none is."""
    tests, codes = zip(*conditions, strict=True)
    return jnp.select(tests, [jnp.int32(code) for code in codes], PoseStatus.OK)


class PoseResult(NamedTuple):
    """Pose of an object in the scene, or the reason why there is none, as arrays (batched by vmap).

    Where `converged` is false, `T_scene_object` is the identity after a search (`ransac`) and a pose no worse
    than the initial one after a refinement (`icp`). No field is ever NaN.
    """

    T_scene_object: jax.Array  # (4, 4), maps object points into the scene, in the unit of the clouds
    score: jax.Array  # (), share of usable matches (ransac) or scene points (icp) that are inliers, in [0, 1]
    num_inliers: jax.Array  # (), int32
    rms_error: jax.Array  # (), root mean square distance over the inliers, in the unit of the clouds; 0 without any
    inlier_mask: jax.Array  # (c,), bool, one entry per match (ransac) or scene point (icp)
    converged: jax.Array  # (), bool
    status: jax.Array  # (), int32, a PoseStatus

    @property
    def reason(self) -> str:
        """Return in words how the search of a single (not batched) result ended."""
        status = np.asarray(self.status)
        if status.ndim:
            raise InputError(f"{status.size} results are batched here: take the reason of one, PoseStatus(status[i])")
        return PoseStatus(int(status)).reason
