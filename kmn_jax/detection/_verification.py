"""What the pose verifier that ships says of refined poses; for all that are found it would take too long."""

from __future__ import annotations

from functools import cache

import jax
import numpy as np
from flax import nnx
from jaxtyping import Float32

from kmn_jax.detection._depth_agreement import DepthImage
from kmn_jax.detection._device_part import DevicePart
from kmn_jax.detection._mapping import call_rows
from kmn_jax.detection._picture_cells import verifier_cells
from kmn_jax.detection._scene import Scene
from kmn_jax.models import Verifier, load_verifier, verify
from kmn_jax.programs import kept
from kmn_jax.simulate import Surfels
from kmn_jax.typing import Pose, Scalar

# The column of the evidence. The number goes up with the weights: a calibration that was fitted to what others say is
# one of other evidence.
VERIFIED = "verifier_2"


def verified(
    T_camera_object: Float32[np.ndarray, "s 4 4"], part: DevicePart, scene: Scene
) -> Float32[np.ndarray, " s"]:
    """Return the log odds that poses are right, as the verifier sees it."""
    if not len(T_camera_object):
        return np.zeros(0, dtype=np.float32)
    given = (*_shipped(), part.surfels, scene.image, part.arrays.diameter)
    return call_rows(lambda pose: verify_one(pose, *given), lambda poses: _verify_many(poses, *given), T_camera_object)


def verify_ahead(pose: Pose, part: DevicePart, image: DepthImage) -> None:
    """Verify some pose: the only use is that the program is compiled."""
    verify_one(pose, *_shipped(), part.surfels, image, part.arrays.diameter)


@cache
def _shipped() -> Verifier:
    return load_verifier()


def verified_pose(
    T_camera_object: Pose,
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    surfels: Surfels,
    image: DepthImage,
    diameter: Scalar,
) -> Scalar:
    """Return the log odds that an object's pose in a depth image is right, as a verifier sees it."""
    return verify(graphdef, parameters, verifier_cells(T_camera_object, surfels, image, diameter))


verify_one = kept("graphdef")(verified_pose)
_verify_many = jax.jit(jax.vmap(verified_pose, in_axes=(0, None, None, None, None, None)), static_argnums=1)
