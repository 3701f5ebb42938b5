"""Messages of ROS without ROS: the types that rosbags brings, and those of vision_msgs 4 (Humble and later)."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

VISION = {
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id"
    ),
    "Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}
STORE = get_typestore(Stores.ROS2_JAZZY)
for _name, _text in VISION.items():
    STORE.register(get_types_from_msg(_text, f"vision_msgs/msg/{_name}"))


def find(package: str, name: str) -> Any:
    return STORE.types[f"{package}/msg/{name}"]


def sent(message: Any) -> Any:
    """Return a message as another process gets it: through its bytes."""
    kind = message.__msgtype__
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, kind), kind)


def header(frame: str = "camera_optical", seconds: int = 7) -> Any:
    return find("std_msgs", "Header")(stamp=find("builtin_interfaces", "Time")(sec=seconds, nanosec=5), frame_id=frame)


def image(depth: np.ndarray, encoding: str, big: bool = False, padding: int = 0) -> Any:
    """Return a depth image whose rows end with some bytes that mean nothing."""
    stored = depth.astype(depth.dtype.newbyteorder(">" if big else "<"))
    rows = stored.view(np.uint8).reshape(len(depth), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=7)
    height, width = depth.shape
    return find("sensor_msgs", "Image")(
        header=header(),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=int(big),
        step=rows.shape[1],
        data=rows.reshape(-1),
    )


def info(K: np.ndarray, height: int, width: int, **changed: Any) -> Any:
    region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False} | changed.pop("roi", {})
    fields = {
        "header": header(),
        "height": height,
        "width": width,
        "distortion_model": "plumb_bob",
        "d": np.zeros(5),
        "k": np.asarray(K, dtype=np.float64).reshape(-1),
        "r": np.eye(3).reshape(-1),
        "p": np.column_stack([K, np.zeros(3)]).astype(np.float64).reshape(-1),
        "binning_x": 0,
        "binning_y": 0,
        "roi": find("sensor_msgs", "RegionOfInterest")(**region),
    }
    return find("sensor_msgs", "CameraInfo")(**fields | changed)


def cloud(points: np.ndarray, names: str = "xyz", big: bool = False, padding: int = 0) -> Any:
    """Return an organised cloud (h, w, 3) whose points hold something else after x, and whose rows end with bytes."""
    order = ">" if big else "<"
    kind = np.dtype(f"{order}{points.dtype.str[1:]}")
    layout = np.dtype([(names[0], kind), ("intensity", f"{order}f4"), (names[1], kind), (names[2], kind)])
    rows = np.zeros(points.shape[:2], dtype=layout)
    for axis, name in enumerate(names):
        rows[name] = points[..., axis]
    datatype = {4: 7, 8: 8}[kind.itemsize]
    fields = [
        find("sensor_msgs", "PointField")(
            name=name, offset=layout.fields[name][1], datatype=7 if name == "intensity" else datatype, count=1
        )
        for name in layout.names
    ]
    content = rows.view(np.uint8).reshape(len(points), -1)
    content = np.pad(content, ((0, 0), (0, padding)), constant_values=9)
    return find("sensor_msgs", "PointCloud2")(
        header=header(),
        height=points.shape[0],
        width=points.shape[1],
        fields=fields,
        is_bigendian=big,
        point_step=layout.itemsize,
        row_step=content.shape[1],
        data=content.reshape(-1),
        is_dense=False,
    )


def parts_of(message: Any) -> Any:
    """Return a message as plain values, to compare."""
    if hasattr(message, "__msgtype__"):
        return {name: parts_of(value) for name, value in vars(message).items()}
    if isinstance(message, np.ndarray):
        return message.tolist()
    return [parts_of(one) for one in message] if isinstance(message, list) else message


def same_but(message: Any, **changed: Any) -> Any:
    """Return a message of plain attributes with some of them changed."""
    return SimpleNamespace(**vars(message) | changed)
