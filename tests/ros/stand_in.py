"""What the node uses of ROS, without ROS: it keeps what is declared, published and logged. Messages are rosbags'."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import pytest

from tests.ros.messages import find

MESSAGES = {
    "sensor_msgs": ("Image", "CameraInfo", "PointCloud2"),
    "vision_msgs": (
        "Detection3DArray",
        "Detection3D",
        "ObjectHypothesisWithPose",
        "ObjectHypothesis",
        "BoundingBox3D",
    ),
    "geometry_msgs": (
        "Point",
        "Pose",
        "PoseWithCovariance",
        "Quaternion",
        "Transform",
        "TransformStamped",
        "Vector3",
    ),
}


class StandInNode:
    """A node whose parameters are given beforehand."""

    given: ClassVar[dict[str, Any]] = {}

    def __init__(self, name: str) -> None:
        self.name = name
        self.ends: dict[str, Callable[..., Any]] = {}
        self.published: list[Any] = []
        self.sent: list[Any] = []
        self.log: list[tuple[str, str]] = []

    def declare_parameter(self, name: str, default: Any) -> Any:
        value = self.given.get(name, default)
        assert type(value) is type(default), f"{name} is declared as a {type(default).__name__}"
        return SimpleNamespace(value=value)

    def create_publisher(self, kind: type, topic: str, depth: int) -> Any:
        assert (kind, topic) == (find("vision_msgs", "Detection3DArray"), "~/detections")
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, kind: type, topic: str, call: Any, qos: Any, callback_group: Any) -> None:
        self.ends[topic] = call

    def create_service(self, kind: type, name: str, call: Any, callback_group: Any) -> None:
        self.ends[name] = call

    def get_logger(self) -> Any:
        def logger(level: str) -> Callable[..., None]:
            return lambda text, throttle_duration_sec=None: self.log.append((level, text))

        return SimpleNamespace(**{level: logger(level) for level in ("info", "warning", "error")})


def install(monkeypatch: pytest.MonkeyPatch, **parameters: Any) -> None:
    """Let modules of ROS be imported, and the node be given these parameters."""
    policies = SimpleNamespace(KEEP_LAST=1, BEST_EFFORT=2)
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {},
        "rclpy.callback_groups": {"MutuallyExclusiveCallbackGroup": object},
        "rclpy.executors": {"ExternalShutdownException": RuntimeError, "MultiThreadedExecutor": object},
        "rclpy.node": {"Node": StandInNode},
        "rclpy.qos": {
            "HistoryPolicy": policies,
            "ReliabilityPolicy": policies,
            "QoSProfile": lambda **given: given,
        },
        "std_srvs": {},
        "std_srvs.srv": {"Trigger": object},
        "tf2_ros": {
            "TransformBroadcaster": lambda node: SimpleNamespace(sendTransform=lambda rows: node.sent.append(rows))
        },
    }
    for package, names in MESSAGES.items():
        modules[package] = {}
        modules[f"{package}.msg"] = {name: find(package, name) for name in names}
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(StandInNode, "given", parameters)
