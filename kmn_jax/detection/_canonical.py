"""Of the poses that look the same, the one that is reported."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from kmn_jax.objects import Symmetries


def canonical_pose(T_scene_object: Float[np.ndarray, "4 4"], symmetries: Symmetries) -> Float[np.ndarray, "4 4"]:
    """Return, of the poses that look the same, the one whose axes are nearest to the scene's, as a proper rigid pose.

    Nearest means the largest trace of the rotation; continuous symmetries are turned to it exactly.
    """
    rotation = _orthonormal(T_scene_object[:3, :3])
    forms = [rotation @ other for other in symmetries.rotations]
    for axis in symmetries.axes:
        forms = [_turned_to_identity(form, axis) for form in forms]
    best = max(range(len(forms)), key=lambda row: (round(float(np.trace(forms[row])), 6), -row))
    result = np.eye(4)
    result[:3, :3] = forms[best]
    # The symmetry's centre stays where it is.
    place = rotation @ symmetries.center + T_scene_object[:3, 3]
    result[:3, 3] = place - forms[best] @ symmetries.center
    return result


def _turned_to_identity(rotation: Float[np.ndarray, "3 3"], axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation followed, in the object's frame, by the turn about an axis that makes its trace largest."""
    cross = np.cross(np.eye(3), axis)  # the matrix of the product with the axis, up to its sign
    outer = np.outer(axis, axis)
    cosine = float(np.trace(rotation) - axis @ rotation @ axis)
    sine = float(np.trace(rotation @ cross.T))
    angle = np.arctan2(sine, cosine)
    turn = outer + np.cos(angle) * (np.eye(3) - outer) + np.sin(angle) * cross.T
    return rotation @ turn


def _orthonormal(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the nearest rotation: float32 leaves errors of 1e-6."""
    left, _, right = np.linalg.svd(rotation)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
