"""Frames of a BOP dataset as plain data, and the JSON entries that stand for them, in both directions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.bop._files import BopFault, Entry
from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera, depth_to_points
from kmn_jax.simulate import Bin, BinScene

Box: TypeAlias = tuple[int, int, int, int]  # left, top, width, height in pixels; a silhouette may leave the image

_NO_BOX = (-1, -1, -1, -1)  # how BOP writes the box of nothing


@dataclass(frozen=True)
class BopInstance:
    """One object in a frame. Its visibility is None where the dataset does not tell it."""

    object_id: int
    T_camera_object: Float[np.ndarray, "4 4"]
    visible_fraction: float | None = None  # visible pixels over those of the whole silhouette
    box: Box | None = None  # around the silhouette, as if nothing hid it
    visible_box: Box | None = None
    num_pixels: int | None = None  # of the silhouette
    num_valid_pixels: int | None = None  # of the silhouette, with a measured depth
    num_visible_pixels: int | None = None

    def __post_init__(self) -> None:
        if self.visible_fraction is not None and not 0 <= self.visible_fraction <= 1:
            raise InputError(f"visible_fraction is {self.visible_fraction}, but must be between 0 and 1")


@dataclass(frozen=True)
class BopFrame:
    """One image of a dataset, all lengths in one unit. What the dataset does not have is None."""

    camera: Camera
    depth: Float[np.ndarray, "h w"]  # 0 where nothing was measured
    instances: tuple[BopInstance, ...] | None = None
    T_camera_world: Float[np.ndarray, "4 4"] | None = None
    bin: Bin | None = None
    T_camera_bin: Float[np.ndarray, "4 4"] | None = None
    masks: Bool[np.ndarray, "n h w"] | None = None  # silhouettes of the instances, as if nothing hid them
    visible_masks: Bool[np.ndarray, "n h w"] | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.depth.shape != size:
            raise InputError(
                f"depth has {self.depth.shape[::-1]} pixels, but the camera {size[::-1]}: give both one size"
            )
        if (self.bin is None) != (self.T_camera_bin is None):
            raise InputError("bin and T_camera_bin belong together: give both or none")
        for name in ("masks", "visible_masks"):
            masks = getattr(self, name)
            if masks is not None and masks.shape != (len(self.instances or ()), *size):
                raise InputError(
                    f"{name} has shape {masks.shape}, but must be ({len(self.instances or ())}, {size[0]}, {size[1]}):"
                    " one image for each instance"
                )

    def points(self) -> Float[Array, "h w 3"]:
        """Return the points of the depth image in the camera frame; the zero point where nothing was measured."""
        return depth_to_points(jnp.asarray(self.depth, jnp.float32), jnp.asarray(self.camera.matrix, jnp.float32))

    def with_visibility(self) -> BopFrame:
        """Return the frame with the boxes, counts and fractions that its masks tell and its instances lack."""
        if self.instances is None or (self.masks is None and self.visible_masks is None):
            return self
        completed = []
        for index, instance in enumerate(self.instances):
            found: dict[str, Any] = {}
            if self.masks is not None:
                mask = self.masks[index]
                found |= {"box": _box(mask), "num_pixels": int(mask.sum())}
                found["num_valid_pixels"] = int((mask & (self.depth > 0)).sum())
            if self.visible_masks is not None:
                visible = self.visible_masks[index]
                found |= {"visible_box": _box(visible), "num_visible_pixels": int(visible.sum())}
                total = found.get("num_pixels") if instance.num_pixels is None else instance.num_pixels
                if total is not None:
                    found["visible_fraction"] = min(1.0, found["num_visible_pixels"] / total) if total else 0.0
            missing = {name: value for name, value in found.items() if getattr(instance, name) is None}
            completed.append(replace(instance, **missing))
        return replace(self, instances=tuple(completed))


def scene_frame(
    scene: BinScene,
    object_id: int,
    depth: Float[np.ndarray, "h w"],
    instances: Int[np.ndarray, "h w"],
    total_pixels: Int[np.ndarray, " n"] | None = None,
    total_boxes: Int[np.ndarray, "n 4"] | None = None,
) -> BopFrame:
    """Return the frame of a rendered bin: `instances` holds the number of the copy that each pixel shows.

    `total_pixels` and `total_boxes` are the size and the box of each copy's silhouette, without what hides it; unless
    they are given, the visible fractions stay unknown. The depth may be that of a sensor.
    """
    poses = scene.T_camera_object
    placed = []
    for index, pose in enumerate(poses):
        count = None if total_pixels is None else int(total_pixels[index])
        box = None
        if total_boxes is not None and count != 0:
            left, top, width, height = total_boxes[index].tolist()
            box = (left, top, width, height)
        placed.append(BopInstance(object_id, pose, box=box, num_pixels=count))
    visible = instances[None] == np.arange(len(poses))[:, None, None]
    frame = BopFrame(
        scene.camera, depth, tuple(placed), bin=scene.bin, T_camera_bin=scene.T_camera_bin, visible_masks=visible
    )
    return frame.with_visibility()


@dataclass(frozen=True)
class CameraEntry:
    """An image's entry in scene_camera.json; its image tells the size."""

    entry: Entry
    matrix: Float[np.ndarray, "3 3"]
    depth_scale: float  # mm of one step
    T_camera_world: Float[np.ndarray, "4 4"] | None

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera of an image of that size."""
        (fx, _, cx), (_, fy, cy), _ = self.matrix.tolist()
        try:
            return Camera(fx, fy, cx, cy, width, height)
        except InputError as error:
            raise self.entry.fault(str(error)) from None


def parse_camera(entry: Entry, factor: float) -> CameraEntry:
    """Read an entry of scene_camera.json; `factor` turns millimetres into the unit of the result's pose."""
    matrix = entry.numbers("cam_K", 9).reshape(3, 3)
    if matrix[0, 1] != 0 or matrix[1, 0] != 0 or matrix[2].tolist() != [0, 0, 1]:
        raise entry.fault("cam_K must be fx 0 cx 0 fy cy 0 0 1: a camera with skew is not supported")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise entry.fault(f"cam_K has the focal lengths {matrix[0, 0]:g}, {matrix[1, 1]:g}, which must be above zero")
    depth_scale = entry.number("depth_scale")
    if depth_scale <= 0:
        raise entry.fault(f"depth_scale is {depth_scale:g}, but must be above zero: it is the mm of one step")
    has_world = "cam_R_w2c" in entry.values or "cam_t_w2c" in entry.values
    T_camera_world = entry.pose("cam_R_w2c", "cam_t_w2c", factor) if has_world else None
    return CameraEntry(entry, matrix, depth_scale, T_camera_world)


def format_camera(frame: BopFrame, depth_scale: float, factor: float) -> dict[str, Any]:
    """Return a frame's entry of scene_camera.json; `factor` turns its lengths into millimetres."""
    result: dict[str, Any] = {"cam_K": frame.camera.matrix.ravel().tolist(), "depth_scale": depth_scale}
    if frame.T_camera_world is not None:
        result |= format_pose(frame.T_camera_world, "cam_R_w2c", "cam_t_w2c", factor)
    return result


def parse_instance(truth: Entry, info: Entry | None, factor: float) -> BopInstance:
    """Read an instance from its entries in scene_gt.json and, if there is one, scene_gt_info.json."""
    pose = truth.pose("cam_R_m2c", "cam_t_m2c", factor)
    instance = BopInstance(truth.integer("obj_id"), pose)
    if info is None:
        return instance
    found: dict[str, Any] = {}
    for name, key in (("box", "bbox_obj"), ("visible_box", "bbox_visib")):
        if key in info.values:
            numbers = tuple(int(number) for number in info.numbers(key, 4))
            found[name] = None if numbers == _NO_BOX else numbers
    for name, key in _COUNTS.items():
        if key in info.values:
            found[name] = info.integer(key)
    if "visib_fract" in info.values:
        found["visible_fraction"] = info.number("visib_fract")
    try:
        return replace(instance, **found)
    except InputError as error:
        raise info.fault(f"visib_fract: {error}") from None


def format_instance(instance: BopInstance, factor: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return an instance's entries of scene_gt.json and of scene_gt_info.json, the latter with what is known."""
    truth = {"obj_id": instance.object_id, **format_pose(instance.T_camera_object, "cam_R_m2c", "cam_t_m2c", factor)}
    info: dict[str, Any] = {key: getattr(instance, name) for name, key in _COUNTS.items()}
    info["visib_fract"] = instance.visible_fraction
    info["bbox_obj"] = _format_box(instance.box, instance.num_pixels)
    info["bbox_visib"] = _format_box(instance.visible_box, instance.num_visible_pixels)
    return truth, {key: value for key, value in info.items() if value is not None}


def parse_bin(entry: Entry, factor: float) -> tuple[Bin, Float[np.ndarray, "4 4"]]:
    """Read the bin and T_camera_bin of an image from scene_bin.json, a file of ours beside those of BOP."""
    pose = entry.pose("cam_R_b2c", "cam_t_b2c", factor)
    try:
        return Bin(*(entry.number(key) * factor for key in ("length", "width", "height", "thickness"))), pose
    except BopFault:
        raise
    except InputError as error:
        raise entry.fault(str(error)) from None


def format_bin(frame: BopFrame, factor: float) -> dict[str, float | list[float]] | None:
    """Return a frame's entry of scene_bin.json in millimetres, None without a bin."""
    if frame.bin is None or frame.T_camera_bin is None:
        return None
    sizes = {key: float(getattr(frame.bin, key) * factor) for key in ("length", "width", "height", "thickness")}
    return {**sizes, **format_pose(frame.T_camera_bin, "cam_R_b2c", "cam_t_b2c", factor)}


def format_pose(
    T_target_source: Float[np.ndarray, "4 4"], rotation: str, translation: str, factor: float
) -> dict[str, list[float]]:
    """Return a pose as a row-wise rotation and a translation in millimetres, under the given names."""
    pose = T_target_source.astype(np.float64)
    return {rotation: pose[:3, :3].ravel().tolist(), translation: (pose[:3, 3] * factor).tolist()}


_COUNTS = {
    "num_pixels": "px_count_all",
    "num_valid_pixels": "px_count_valid",
    "num_visible_pixels": "px_count_visib",
}


def _box(mask: Bool[np.ndarray, "h w"]) -> Box | None:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    left, top = int(columns[0]), int(rows[0])
    return left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1


def _format_box(box: Box | None, num_pixels: int | None) -> list[int] | None:
    if box is None:
        return list(_NO_BOX) if num_pixels == 0 else None
    return [int(number) for number in box]
