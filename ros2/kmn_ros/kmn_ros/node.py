"""The node: depth images or clouds in; detections and transforms out; see docs/ros.md of kmn_jax."""

from __future__ import annotations

import importlib
import sys
import threading
from copy import deepcopy
from typing import Any

import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_srvs.srv import Trigger
from tf2_ros import TransformBroadcaster
from vision_msgs.msg import Detection3DArray

from kmn_jax import InputError, Scan
from kmn_jax.geometry import ask_for_fast_selection
from kmn_jax.programs import call_in_place, keep_compiled
from kmn_ros.results import detection_array, likely, transforms
from kmn_ros.scans import scan_of_cloud, scan_of_image
from kmn_ros.search import PartSearch, Settings

_NEWEST = QoSProfile(depth=1, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
_OFTEN = 5.0  # seconds, at most so often is the same complaint logged


class PosesNode(Node):
    """Searches every scan, or the next one after a call of `~/detect`; meanwhile the newest scan waits."""

    def __init__(self, estimator: Any = None) -> None:
        """Read the parameters and prepare the part. Raises InputError if one of them cannot be used."""
        super().__init__("kmn_poses")
        given = {name: self.declare_parameter(name, default).value for name, default in Settings.names().items()}
        self._settings = Settings(**given)
        self._search = PartSearch(self._settings, estimator)
        self._info: Any = None
        self._next = threading.Condition()  # guards what follows
        self._scan: tuple[Any, Scan] | None = None  # header and scan that came last
        self._count = 0  # of scans so far
        self._found = self.create_publisher(Detection3DArray, "~/detections", 10)
        self._broadcaster = TransformBroadcaster(self)
        scans, calls = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        if self._settings.input == "cloud":
            self.create_subscription(PointCloud2, "points", self._on_cloud, _NEWEST, callback_group=scans)
        else:
            self.create_subscription(CameraInfo, "camera_info", self._on_info, _NEWEST, callback_group=scans)
            self.create_subscription(Image, "depth", self._on_image, _NEWEST, callback_group=scans)
        if self._settings.on_demand:
            self.create_service(Trigger, "~/detect", self._on_detect, callback_group=calls)
        self.create_service(Trigger, "~/take_background", self._on_background, callback_group=calls)
        self.get_logger().info(f"looking for {self._search.part.name}; the first search compiles for some seconds")

    def _on_info(self, info: Any) -> None:
        self._info = info

    def _on_image(self, image: Any) -> None:
        if self._info is None:
            self.get_logger().warning("no camera info has come yet", throttle_duration_sec=_OFTEN)
            return
        step = self._settings.depth_unit or None
        self._take(image.header, lambda: scan_of_image(image, self._info, step))

    def _on_cloud(self, cloud: Any) -> None:
        self._take(cloud.header, lambda: scan_of_cloud(cloud))

    def _take(self, header: Any, read: Any) -> None:
        """Keep a scan for the services that wait, and search it unless that is left to them."""
        try:
            scan = read()
            with self._next:
                self._scan, self._count = (header, scan), self._count + 1
                self._next.notify_all()
            if not self._settings.on_demand:
                self._publish(header, scan)
        except InputError as error:
            self.get_logger().error(str(error), throttle_duration_sec=_OFTEN)

    def _publish(self, header: Any, scan: Scan) -> str:
        """Search a scan, publish what was found, and return it in a sentence."""
        found = self._search(scan)
        for warning in found.warnings:
            self.get_logger().warning(warning, throttle_duration_sec=_OFTEN)
        settings, in_base = self._settings, bool(self._settings.base_frame)
        poses = likely(found, settings.min_probability)
        header = deepcopy(header)
        header.frame_id = settings.base_frame or settings.frame or header.frame_id
        part, name = self._search.part, settings.object_frame or self._search.part.name
        self._found.publish(detection_array(_message, header, part, found.unit, poses, in_base))
        if poses:
            self._broadcaster.sendTransform(transforms(_message, header, name, found.unit, poses, in_base))
        reason = "" if found.reason is None else f": {found.reason}"
        return f"{len(found.poses)} poses, {len(poses)} of them published, in {found.timing.total:.2f} s{reason}"

    def _wait(self) -> tuple[Any, Scan]:
        """Return the first scan that comes from now on. Raises InputError if none does."""
        with self._next:
            count = self._count
            if not self._next.wait_for(lambda: self._count > count, self._settings.wait) or self._scan is None:
                raise InputError(f"no usable scan came within {self._settings.wait:g} s: see that the camera publishes")
            return self._scan

    def _on_detect(self, _: Any, response: Any) -> Any:
        try:
            response.message, response.success = self._publish(*self._wait()), True
        except InputError as error:
            response.message, response.success = str(error), False
        return response

    def _on_background(self, _: Any, response: Any) -> Any:
        try:
            self._search.take_background(self._wait()[1])
            response.message, response.success = "this scan is the empty bin from now on", True
        except InputError as error:
            response.message, response.success = str(error), False
        return response


def _message(package: str, name: str) -> Any:
    return getattr(importlib.import_module(f"{package}.msg"), name)


def main() -> None:
    """Run the node until ROS is shut down."""
    ask_for_fast_selection()
    call_in_place()
    keep_compiled()
    rclpy.init()
    executor = MultiThreadedExecutor(num_threads=2)  # one for scans, one for services
    try:
        executor.add_node(PosesNode())
        executor.spin()
    except InputError as error:
        sys.exit(f"kmn_ros: {error}")
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        executor.shutdown()
        rclpy.try_shutdown()
