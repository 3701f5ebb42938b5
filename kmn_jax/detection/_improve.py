"""Found poses against the ones they are mistaken for, and refined on all points around them.

Parts that are nearly symmetric are found the wrong way round, as few points tell. So each found pose is compared with
its turns by quarters and halves about the part's main axes. Those that the depth image does not clearly speak against,
once roughly refined, are refined as the pose itself is.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from itertools import permutations, product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int, Key

from kmn_jax.data import CropConfig, crop_around
from kmn_jax.detection._evidence import Sight
from kmn_jax.detection._scan_crop import SceneArrays, as_visible
from kmn_jax.detection._search import each, spread_rows
from kmn_jax.detection._select import padded_symmetries
from kmn_jax.detection._verify import VerifyConfig, agreement
from kmn_jax.geometry import compose, inverse, nearest, transform_points
from kmn_jax.objects import Part
from kmn_jax.pose import IcpConfig, icp, mssd
from kmn_jax.simulate import Surfels
from kmn_jax.typing import Points, Pose, Scalar

_ALIKE = 0.3  # cosine of normals, for a point that may lie on a pose's surface
_SAME = 0.1  # diameters between points of turned and unturned parts that look the same
_SIMILAR = 0.05  # diameters, in the mean, between the surfaces of parts that may be taken for each other
_COMPARED = 256  # points


@dataclass(frozen=True)
class ImproveConfig:
    """How poses are improved; lengths are shares of the object's diameter."""

    alternatives: int = 2  # turned poses that are refined, too
    margin: float = 0.1  # by which the depth image may speak against a turned pose before it is refined
    num_points: int = 768  # of a crop around the pose's seed
    icp_points: int = 256  # of these, near to the pose's surface
    object_points: int = 512  # on the part's surface
    reach: float = 0.1  # how near
    icp: IcpConfig = field(default_factory=lambda: IcpConfig(iterations=15))
    rough_turns: int = 4  # the best turns as they are, which are roughly refined
    rough_icp: IcpConfig = field(default_factory=lambda: IcpConfig(iterations=6, distance_gate=0.2))
    rough_points: int = 128  # of the crop
    raw_tolerance: float = 0.1  # of depths, for turns as they are: the pose is not exact
    tolerance: float = 0.05  # the same, once they are roughly refined
    rough_surfels: int = 512  # by which turns are compared with the depth image and the crop
    normal_radius: float = 0.06
    normal_points: int = 2048


def main_turns(part: Part) -> tuple[Float32[np.ndarray, "v 4 4"], Bool[np.ndarray, " v"]]:
    """Return the 23 turns that map the part's main axes onto each other, about the centroid of its surface.

    These axes are those of its frame, or of its moments, whichever box along them is smaller.
    The flags are false for those under which the part looks the same, or not at all like itself.
    """
    from scipy.spatial import cKDTree

    points = part.points.astype(np.float64)
    center = points.mean(axis=0)
    moments = np.linalg.svd(points - center, full_matrices=False)[2]
    axes = min((np.eye(3), moments), key=lambda axes: float(np.prod(np.ptp(points @ axes.T, axis=0))))
    turns = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.zeros((3, 3))
        turn[range(3), order] = signs
        if np.linalg.det(turn) > 0 and not np.array_equal(turn, np.eye(3)):
            pose = np.eye(4)
            pose[:3, :3] = axes.T @ turn @ axes
            pose[:3, 3] = center - pose[:3, :3] @ center
            turns.append(pose)
    poses = np.array(turns, dtype=np.float32)
    moved = _moved(jnp.asarray(poses), jnp.asarray(part.points[:_COMPARED]), padded_symmetries(part))
    surface, some = cKDTree(points), points[:_COMPARED]
    apart = [surface.query(some @ pose[:3, :3].T + pose[:3, 3])[0].mean() for pose in turns]
    return poses, (np.asarray(moved) > _SAME * part.diameter) & (np.array(apart) <= _SIMILAR * part.diameter)


@jax.jit
def _moved(poses: Float[Array, "v 4 4"], points: Points, symmetries: Float[Array, "t 4 4"]) -> Float[Array, " v"]:
    return jax.lax.map(lambda pose: mssd(pose, jnp.eye(4), points, symmetries), poses)


@partial(jax.jit, static_argnames=("config", "verify"))
def improve(
    poses: Float[Array, "k 4 4"],
    real: Bool[Array, " k"],
    seeds: Int[Array, " k"],
    scene: SceneArrays,
    sight: Sight,
    surfels: Surfels,
    turns: Float[Array, "v 4 4"],
    is_rival: Bool[Array, " v"],
    diameter: Scalar,
    keys: Key[Array, " k"],
    config: ImproveConfig,
    verify: VerifyConfig,
) -> tuple[Float[Array, "k a 4 4"], Bool[Array, "k a"]]:
    """Return, for poses found around seed rows of a scene, themselves and turned ones refined, and which there are."""
    visible = as_visible(scene)
    crops = CropConfig(
        num_points=config.num_points,
        max_noise=0.0,
        normal_radius=config.normal_radius,
        normal_points=config.normal_points,
        min_points=1,
    )
    many, few = (
        Surfels(surfels.points[:count], surfels.normals[:count], surfels.area)
        for count in (config.object_points, config.rough_surfels)
    )

    def one(pose: Pose, seed: Int[Array, ""], key: Key[Array, ""]) -> tuple[Float[Array, "a 4 4"], Bool[Array, " a"]]:
        crop = crop_around(key, visible, seed, scene.mask[seed], jnp.zeros((1, 3)), jnp.eye(4)[None], diameter, crops)
        shown = crop.points + crop.seed[None]

        def score(pose: Pose, tolerance: float) -> Scalar:
            seen = agreement(pose, few, sight.depth, sight.camera, diameter, replace(verify, tolerance=tolerance))
            return seen.explained - seen.violated

        def refined(pose: Pose, surface: Surfels, count: int, settings: IcpConfig) -> Pose:
            to_object = inverse(pose)
            row, distance = nearest(transform_points(to_object, shown), few.points)
            turned = jnp.matmul(crop.normals, to_object[:3, :3].T, precision=jax.lax.Precision.HIGHEST)
            cosine = (turned * few.normals[row]).sum(axis=1)
            near = crop.mask & (distance <= config.reach * diameter) & (cosine > _ALIKE)
            rows, there = spread_rows(near, count)
            fine = icp(
                surface.points,
                shown[rows],
                pose,
                diameter,
                scene_normals=crop.normals[rows],
                scene_mask=there,
                config=settings,
            )
            return fine.T_scene_object

        turned = jax.lax.map(lambda turn: compose(pose, turn), turns)
        unlikely = jnp.float32(-jnp.inf)

        def raw_score(turned: Pose, is_rival: Bool[Array, ""]) -> Scalar:
            return jax.lax.cond(is_rival, lambda: score(turned, config.raw_tolerance), lambda: unlikely)

        def roughly_refined(start: Pose, is_rival: Bool[Array, ""]) -> tuple[Pose, Scalar]:
            def both() -> tuple[Pose, Scalar]:
                rough = refined(start, few, config.rough_points, config.rough_icp)
                return rough, score(rough, config.tolerance)

            return jax.lax.cond(is_rival, both, lambda: (start, unlikely))

        hope, rows = jax.lax.top_k(jax.lax.map(lambda item: raw_score(*item), (turned, is_rival)), config.rough_turns)
        rough, scores = jax.lax.map(lambda item: roughly_refined(*item), (turned[rows], jnp.isfinite(hope)))
        best, rows = jax.lax.top_k(scores, config.alternatives)
        there = jnp.concatenate([jnp.ones(1, dtype=bool), best >= score(pose, config.tolerance) - config.margin])
        starts = jnp.concatenate([pose[None], rough[rows]])

        def finish(start: Pose, there: Bool[Array, ""]) -> Pose:
            return jax.lax.cond(there, lambda: refined(start, many, config.icp_points, config.icp), lambda: start)

        return jax.lax.map(lambda item: finish(*item), (starts, there)), there

    return each(one, real, poses, seeds, keys)
