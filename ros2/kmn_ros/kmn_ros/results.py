"""Results as messages: vision_msgs' Detection3DArray, and a TransformStamped of geometry_msgs for each pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from kmn_jax import Detection, Detections, Part
from kmn_jax.detection import placed
from kmn_jax.units import METRES

# From the names of a package and of a message to its class, whose constructor takes all fields by their names.
FindMessage = Callable[[str, str], Callable[..., Any]]


def likely(found: Detections, min_probability: float) -> tuple[Detection, ...]:
    """Return the poses of at least a probability, in pick order."""
    return tuple(pose for pose in found.poses if pose.probability >= min_probability)


def detection_array(
    find: FindMessage, header: Any, part: Part, unit: str, poses: Sequence[Detection], in_base: bool = False
) -> Any:
    """Return poses, whose lengths are in `unit`, as a Detection3DArray in pick order.

    Each has one hypothesis: the part's name, the probability, and the frame of its CAD file. The box is that around the
    part. Covariances are not known: all zero. With `in_base`, poses are those in the robot's frame.
    """
    part = part.in_unit("m")
    array, detection, posed, named, box = (
        find("vision_msgs", name)
        for name in ("Detection3DArray", "Detection3D", "ObjectHypothesisWithPose", "ObjectHypothesis", "BoundingBox3D")
    )
    uncertain = find("geometry_msgs", "PoseWithCovariance")
    size = _three(find("geometry_msgs", "Vector3"), part.maximum - part.minimum)
    rows = []
    for rank, one in enumerate(poses, start=1):
        T = metric(one, unit, in_base)
        hypothesis = named(class_id=part.name, score=float(one.probability))
        pose = uncertain(pose=_pose(find, T), covariance=np.zeros(36))
        middle = T.copy()
        middle[:3, 3] = placed(T, (part.minimum + part.maximum) / 2)
        bounds = box(center=_pose(find, middle), size=size)
        results = [posed(hypothesis=hypothesis, pose=pose)]
        rows.append(detection(header=header, results=results, bbox=bounds, id=str(rank)))
    return array(header=header, detections=rows)


def transforms(
    find: FindMessage, header: Any, frame: str, unit: str, poses: Sequence[Detection], in_base: bool = False
) -> list[Any]:
    """Return poses as TransformStamped from the header's frame to FRAME_1, FRAME_2 and so on, in pick order."""
    stamped, transform, vector = (find("geometry_msgs", name) for name in ("TransformStamped", "Transform", "Vector3"))
    rows = []
    for rank, one in enumerate(poses, start=1):
        T = metric(one, unit, in_base)
        moved = transform(translation=_three(vector, T[:3, 3]), rotation=_quaternion(find, T))
        rows.append(stamped(header=header, child_frame_id=f"{frame}_{rank}", transform=moved))
    return rows


def metric(pose: Detection, unit: str, in_base: bool = False) -> np.ndarray:
    """Return the pose (4, 4) of a copy in metres, in the scan's frame or the robot's."""
    T = np.array(pose.T_base_object if in_base else pose.T_scene_object, dtype=np.float64)
    T[:3, 3] *= METRES[unit]
    return T


def _pose(find: FindMessage, T: np.ndarray) -> Any:
    point, pose = find("geometry_msgs", "Point"), find("geometry_msgs", "Pose")
    return pose(position=_three(point, T[:3, 3]), orientation=_quaternion(find, T))


def _quaternion(find: FindMessage, T: np.ndarray) -> Any:
    x, y, z, w = (float(value) for value in Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True))
    return find("geometry_msgs", "Quaternion")(x=x, y=y, z=z, w=w)


def _three(kind: Callable[..., Any], values: np.ndarray) -> Any:
    x, y, z = (float(value) for value in values)
    return kind(x=x, y=y, z=z)
