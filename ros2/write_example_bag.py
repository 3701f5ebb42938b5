"""Write a bag of the small test set's depth images, as a camera's driver would publish them.

    python ros2/write_example_bag.py outputs/bag

The bag has the topics /camera/depth/image_rect_raw (32FC1, metres) and /camera/depth/camera_info, one image a second.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from kmn_jax.bop import bop_scan
from kmn_jax.io import Scan

IMAGES = Path(__file__).parents[1] / "experiments" / "assets" / "small_test_set" / "test" / "000002" / "depth"
FRAME = "camera_depth_optical_frame"
STORE = get_typestore(Stores.ROS2_JAZZY)


def header(seconds: int) -> Any:
    """Return the header of a message of the camera."""
    stamp = STORE.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=0)
    return STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id=FRAME)


def depth_image(scan: Scan, seconds: int) -> Any:
    """Return a scan's depth image in metres as sensor_msgs/Image."""
    image = scan.in_unit("m").depth
    assert image is not None
    depth = image.astype("<f4")
    height, width = depth.shape
    return STORE.types["sensor_msgs/msg/Image"](
        header=header(seconds),
        height=height,
        width=width,
        encoding="32FC1",
        is_bigendian=0,
        step=4 * width,
        data=np.frombuffer(depth.tobytes(), dtype=np.uint8),
    )


def camera_info(scan: Scan, seconds: int) -> Any:
    """Return a scan's camera as sensor_msgs/CameraInfo: without distortion."""
    assert scan.camera is not None
    assert scan.depth is not None
    matrix = np.array(scan.camera.matrix, dtype=np.float64)
    height, width = scan.depth.shape
    region = STORE.types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return STORE.types["sensor_msgs/msg/CameraInfo"](
        header=header(seconds),
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=matrix.reshape(-1),
        r=np.eye(3).reshape(-1),
        p=np.column_stack([matrix, np.zeros(3)]).reshape(-1),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


def write_bag(folder: Path, images: list[Path]) -> None:
    """Write a bag, which is a folder that must not exist yet, of depth images of BOP scenes."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {
            name: writer.add_connection(f"/camera/depth/{name}", kind, typestore=STORE)
            for name, kind in (
                ("camera_info", "sensor_msgs/msg/CameraInfo"),
                ("image_rect_raw", "sensor_msgs/msg/Image"),
            )
        }
        for seconds, path in enumerate(images, start=1):
            scan = bop_scan(path)[0]
            messages = {"camera_info": camera_info(scan, seconds), "image_rect_raw": depth_image(scan, seconds)}
            # The camera comes a moment ahead: it is another one for each of these images.
            for ahead, (name, topic) in zip((10**8, 0), topics.items(), strict=True):
                writer.write(topic, seconds * 10**9 - ahead, STORE.serialize_cdr(messages[name], topic.msgtype))


def main() -> None:
    """Write the bag into the folder that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="the bag, which must not exist yet")
    folder = parser.parse_args().folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    write_bag(folder, sorted(IMAGES.glob("*.png")))
    print(f"wrote {folder}")


if __name__ == "__main__":
    main()
