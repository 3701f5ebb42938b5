"""Frames of a BOP dataset as plain data, and the JSON entries that stand for them, in both directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from kmn_jax.bop._files import Entry, pose_entry, pose_keys
from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera
from kmn_jax.simulate import Bin, BinScene

Box: TypeAlias = tuple[int, int, int, int]  # left, top, width, height in pixels; a silhouette may leave the image

_NO_BOX = (-1, -1, -1, -1)  # how BOP writes the box of nothing


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True, eq=False)
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
    total_pixels: Int[np.ndarray, " n"],
    total_boxes: Int[np.ndarray, "n 4"],
) -> BopFrame:
    """Return the frame of a rendered bin: `instances` holds the number of the copy that each pixel shows.

    `total_pixels` and `total_boxes` are the size and the box of each copy's silhouette, without what hides it. The
    depth may be that of a sensor.
    """
    placed = []
    for pose, count, box in zip(scene.T_camera_object, total_pixels.tolist(), total_boxes.tolist(), strict=True):
        placed.append(BopInstance(object_id, pose, box=tuple(box) if count else None, num_pixels=count))
    visible = instances[None] == np.arange(len(placed))[:, None, None]
    frame = BopFrame(
        scene.camera, depth, tuple(placed), bin=scene.bin, T_camera_bin=scene.T_camera_bin, visible_masks=visible
    )
    return frame.with_visibility()


class CameraEntry(NamedTuple):
    """An image's entry in scene_camera.json; its image tells the size."""

    matrix: Float[np.ndarray, "3 3"]
    depth_scale: float  # mm of one step
    T_camera_world: Float[np.ndarray, "4 4"] | None


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
    has_world = any(key in entry.values for key in pose_keys("w2c"))
    return CameraEntry(matrix, depth_scale, entry.pose("w2c", factor) if has_world else None)


def format_camera(frame: BopFrame, depth_scale: float, factor: float) -> dict[str, Any]:
    """Return a frame's entry of scene_camera.json; `factor` turns its lengths into millimetres."""
    world = {} if frame.T_camera_world is None else pose_entry("w2c", frame.T_camera_world, factor)
    return {"cam_K": frame.camera.matrix.ravel().tolist(), "depth_scale": depth_scale, **world}


def parse_instance(truth: Entry, info: Entry | None, factor: float) -> BopInstance:
    """Read an instance from its entries in scene_gt.json and, if there is one, scene_gt_info.json."""
    instance = BopInstance(truth.integer("obj_id"), truth.pose("m2c", factor))
    if info is None:
        return instance
    found = {name: read(info, key) for name, (key, read) in _VISIBILITY.items() if key in info.values}
    return info.make(replace, instance, **found)


def format_instance(instance: BopInstance, factor: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return an instance's entries of scene_gt.json and of scene_gt_info.json, the latter with what is known."""
    known = {key: getattr(instance, name) for name, (key, _) in _VISIBILITY.items()}
    for box, count in (("bbox_obj", "px_count_all"), ("bbox_visib", "px_count_visib")):
        if known[box] is None and known[count] == 0:
            known[box] = _NO_BOX
    info = {key: np.asarray(value).tolist() for key, value in known.items() if value is not None}
    return {"obj_id": instance.object_id, **pose_entry("m2c", instance.T_camera_object, factor)}, info


def parse_bin(entry: Entry, factor: float) -> tuple[Bin, Float[np.ndarray, "4 4"]]:
    """Read the bin and T_camera_bin of an image from scene_bin.json, a file of ours beside those of BOP."""
    pose = entry.pose("b2c", factor)
    return entry.make(Bin, *(entry.number(key) * factor for key in _BIN)), pose


def format_bin(frame: BopFrame, factor: float) -> dict[str, Any] | None:
    """Return a frame's entry of scene_bin.json in millimetres, None without a bin."""
    if frame.bin is None or frame.T_camera_bin is None:
        return None
    sizes = {key: float(getattr(frame.bin, key) * factor) for key in _BIN}
    return {**sizes, **pose_entry("b2c", frame.T_camera_bin, factor)}


def _read_box(entry: Entry, key: str) -> Box | None:
    left, top, width, height = (int(number) for number in entry.numbers(key, 4))
    return None if (left, top, width, height) == _NO_BOX else (left, top, width, height)


_BIN = ("length", "width", "height", "thickness")
# Of scene_gt_info.json: what an instance calls it, its key, and how to read it.
_VISIBILITY: dict[str, tuple[str, Callable[[Entry, str], Any]]] = {
    "visible_fraction": ("visib_fract", Entry.number),
    "box": ("bbox_obj", _read_box),
    "visible_box": ("bbox_visib", _read_box),
    "num_pixels": ("px_count_all", Entry.integer),
    "num_valid_pixels": ("px_count_valid", Entry.integer),
    "num_visible_pixels": ("px_count_visib", Entry.integer),
}


def _box(mask: Bool[np.ndarray, "h w"]) -> Box | None:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    left, top = int(columns[0]), int(rows[0])
    return left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1
