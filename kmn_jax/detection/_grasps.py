"""Which grasps of found copies are free: the gripper meets nothing that was measured, nor what that may hide."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.detection._depth_agreement import DepthImage, farthest_at
from kmn_jax.detection._device_part import symmetry_transforms
from kmn_jax.detection._frames import placed
from kmn_jax.detection._result import Detection, Detections, Pick
from kmn_jax.detection._scene import Scene
from kmn_jax.errors import InputError
from kmn_jax.geometry import PaddedCloud, inverse, pad_cloud, squared_distances, transform_points
from kmn_jax.objects import Grasps, Part
from kmn_jax.programs import compiled_size
from kmn_jax.typing import Points, Pose, Scalar

_OWN = 0.05  # diameters: what was measured so near to the copy's surface is the copy itself
_MOST_IN_PART = 0.02  # share of the gripper that may be deeper than that in the part that it holds
_STRAYS = 3  # measured points that a gripper may meet: sensors make some where edges are
_MOST_HIDDEN = 0.05  # share of the gripper that may be where the sensor could not see
_GRID = (4, 4, 8)  # places in a box that are looked at for that
_WINDOW = 2  # pixels to each side in which a measurement may lie
_OWN_POINTS = 256  # on the copy's surface
_MOST_TURNS = 48  # under which a part looks the same that are tried
_LEAST_POINTS = 4096  # the smallest capacity that is compiled
_TOGETHER = 16  # grasps


class Conflict(NamedTuple):
    """What a gripper would meet."""

    inside: Int[Array, ""]  # measured points in its boxes that are not the copy's
    hidden: Scalar  # share of its volume that is behind what was measured, other than the copy


class Copy(NamedTuple):
    """The measured surroundings of a found copy, in the camera's frame."""

    others: PaddedCloud  # what was measured around it, and is not the copy
    own: Points  # on the copy's surface
    margin: Scalar  # so near to these is the copy itself


def grasp_conflict(
    T_camera_grasp: Pose, centers: Float[Array, "b 3"], sizes: Float[Array, "b 3"], copy: Copy, image: DepthImage
) -> Conflict:
    """Return what a gripper, of boxes in its own frame, would meet at a grasp of a copy.

    Where nothing was measured, nothing is hidden; nor behind the copy itself, as deep as it reaches.
    """
    seen = transform_points(inverse(T_camera_grasp), copy.others.points)
    inside = (jnp.abs(seen[:, None] - centers[None]) <= sizes[None] / 2).all(axis=2).any(axis=1) & copy.others.mask
    grid = jnp.asarray(_grid(), dtype=jnp.float32)
    places = transform_points(T_camera_grasp, (centers[:, None] + grid[None] * sizes[:, None]).reshape(-1, 3))
    ahead = places[:, 2] > 0
    x, y = (jnp.where(ahead, places[:, axis] / jnp.where(ahead, places[:, 2], 1), 0) for axis in (0, 1))
    depth = farthest_at(*image, x, y, _WINDOW)
    surface = jnp.stack([x, y, jnp.ones_like(x)], axis=1) * depth[:, None]
    of_copy = squared_distances(surface, copy.own).min(axis=1) <= copy.margin**2
    beside_copy = of_copy & (places[:, 2] <= copy.own[:, 2].max() + copy.margin)  # it rests on what is deeper
    hidden = ahead & (depth > 0) & (places[:, 2] > depth + copy.margin) & ~beside_copy
    return Conflict(inside.sum(dtype=jnp.int32), hidden.mean(dtype=jnp.float32))


def with_grasps(
    found: Detections, grasps: Grasps, part: Part, scene: Scene, T_base_scene: Float[np.ndarray, "4 4"] | None
) -> Detections:
    """Return a result whose copies carry those of the grasps that are free, in the grasps' order.

    Of grasps that are the same up to the part's symmetry, the free one is taken that approaches most along the view.
    Raises InputError if the gripper would be inside of the part itself at one of them, or nowhere near.
    """
    own = grasps.in_unit(scene.unit)
    check_on_part(own, part)
    turns = symmetry_transforms(part.centred().symmetries).astype(np.float64)
    turns[:, :3, 3] += part.origin - turns[:, :3, :3] @ part.origin  # in the part's own frame, which may lie far away
    turns = turns[np.linspace(0, len(turns) - 1, min(len(turns), _MOST_TURNS)).astype(int)]
    boxes = [own.gripper.boxes(one.width) for one in own.grasps]
    centers, sizes = (
        np.repeat(np.array(side), len(turns), axis=0).astype(np.float32) for side in zip(*boxes, strict=True)
    )
    T_object_grasp = np.array([turn @ one.T_object_grasp for one in own.grasps for turn in turns])
    far = (
        np.linalg.norm(np.abs(centers) + sizes / 2, axis=2).max()
        + np.linalg.norm(T_object_grasp[:, :3, 3], axis=1).max()
    )
    copies = [_surroundings(copy, part, scene, float(far)) for copy in found.poses]
    most = max([_LEAST_POINTS, *(len(others) for others, _ in copies)])
    capacity = compiled_size(most)  # one for all copies
    poses = []
    for copy, (others, surface) in zip(found.poses, copies, strict=True):
        T_scene_grasp = copy.T_scene_object @ T_object_grasp
        T_camera_grasp = np.linalg.inv(scene.T_scene_camera) @ T_scene_grasp
        around = Copy(pad_cloud(others, capacity), jnp.asarray(surface), jnp.float32(_margin(part, len(surface))))
        free = np.asarray(_free(T_camera_grasp.astype(np.float32), centers, sizes, around, scene.image))
        # Among equal ones, from the view's side.
        chosen = np.where(free, T_camera_grasp[:, 2, 2], -np.inf).reshape(len(own.grasps), len(turns))
        picks = [
            Pick(
                one.name,
                one.width,
                T_scene_grasp[row],
                None if T_base_scene is None else T_base_scene @ T_scene_grasp[row],
            )
            for number, one in enumerate(own.grasps)
            if free[row := number * len(turns) + int(chosen[number].argmax())]
        ]
        poses.append(replace(copy, grasps=tuple(picks)))
    return replace(found, poses=tuple(poses))


def check_on_part(grasps: Grasps, part: Part) -> None:
    """Raise InputError if the gripper would be inside of the part that it holds, or nowhere near; lengths are in one
    unit.
    """
    from scipy.spatial import cKDTree

    surface = cKDTree(part.points)
    for one in grasps.grasps:
        centers, sizes = grasps.gripper.boxes(one.width)
        seen = placed(np.linalg.inv(one.T_object_grasp), part.points)  # in the gripper's frame
        beside = np.maximum(np.abs(seen[:, None] - centers[None]) - sizes[None] / 2, 0)
        gap = float(np.linalg.norm(beside, axis=2).min())
        if gap > part.diameter:
            raise InputError(
                f"at the grasp {one.name!r}, the gripper would be {gap / part.diameter:.1f} diameters away from"
                f" {part.name}: check its pose, width, boxes and unit"
            )
        places = placed(one.T_object_grasp, (centers[:, None] + _grid()[None] * sizes[:, None]).reshape(-1, 3))
        nearest = surface.query(places)[1]
        heights = ((places - part.points[nearest]) * part.normals[nearest]).sum(axis=1)
        share = float((heights < -_OWN * part.diameter).mean())
        if share > _MOST_IN_PART:
            raise InputError(
                f"at the grasp {one.name!r}, {share:.0%} of the gripper would be inside of {part.name}: check its pose,"
                " width, boxes and unit"
            )


def _grid() -> Float[np.ndarray, "n 3"]:
    """Return places in a box of size one around the origin."""
    axes = [(np.arange(count) + 0.5) / count - 0.5 for count in _GRID]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _margin(part: Part, count: int) -> float:
    return _OWN * part.diameter + float(np.sqrt(part.area / count))


def _surroundings(
    copy: Detection, part: Part, scene: Scene, reach: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "m 3"]]:
    """Return what was measured around a copy and is not the copy, and points of its surface, in the camera's frame."""
    from scipy.spatial import cKDTree

    T_camera_object = np.linalg.inv(scene.T_scene_camera) @ copy.T_scene_object
    surface = placed(T_camera_object, part.points.astype(np.float64))

    def near(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
        return points[np.linalg.norm(points - T_camera_object[:3, 3], axis=1) <= reach]

    seen = near(scene.points)
    others = seen[cKDTree(surface).query(seen)[0] > _margin(part, len(surface))] if len(seen) else seen
    if scene.empty is not None:  # none of its points is the copy's
        others = np.concatenate([others, near(scene.empty)])
    return others.astype(np.float32), surface[:_OWN_POINTS].astype(np.float32)


@jax.jit
def _free(
    poses: Float[Array, "g 4 4"],
    centers: Float[Array, "g b 3"],
    sizes: Float[Array, "g b 3"],
    copy: Copy,
    image: DepthImage,
) -> Bool[Array, " g"]:
    def is_free(one: tuple[Pose, Float[Array, "b 3"], Float[Array, "b 3"]]) -> Bool[Array, ""]:
        met = grasp_conflict(*one, copy, image)
        return (met.inside <= _STRAYS) & (met.hidden <= _MOST_HIDDEN)

    return jax.lax.map(is_free, (poses, centers, sizes), batch_size=_TOGETHER)
