"""Reading one frame of a BOP dataset, with every fault on the way."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from kmn_jax.bop._files import (
    BopFault,
    Entry,
    files_by_id,
    image_size,
    of_sensor,
    read_depth,
    read_json_by_id,
    read_mask,
)
from kmn_jax.bop._frames import BopFrame, BopInstance, CameraEntry, parse_bin, parse_camera, parse_instance
from kmn_jax.bop._writer import BIN_FILE
from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera
from kmn_jax.limits import check_bytes
from kmn_jax.simulate import Bin

_P = ParamSpec("_P")
_T = TypeVar("_T")
_CAMERA, _TRUTH, _INFO = "scene_camera", "scene_gt", "scene_gt_info"
_IMAGES = (".png", ".tif", ".tiff")


class Scene:
    """The folder of a scene, and what its JSON files hold.

    `entries` are those by image of each file that can be read, `faults` what is wrong with whole files.
    """

    def __init__(self, folder: Path, sensor: str | None, ground_truth: bool) -> None:
        self.folder, self.sensor = folder, sensor
        self.entries: dict[str, dict[int, Any]] = {}
        self.faults: list[BopFault] = []
        required = (_CAMERA, _TRUTH) if ground_truth else (_CAMERA,)
        for name in (*required, BIN_FILE, *([_INFO] if ground_truth else [])):
            file = self.path(name, ".json")
            if name in required or file.exists():
                try:
                    self.entries[name] = read_json_by_id(file)
                except BopFault as fault:
                    self.faults.append(fault)
        self.image_ids = tuple(sorted({image for name in required for image in self.entries.get(name, ())}))

    def path(self, name: str, suffix: str = "") -> Path:
        """Return the path of one of the scene's files or folders."""
        return self.folder / of_sensor(name, self.sensor, suffix)

    @cached_property
    def depth_files(self) -> dict[int, Path]:
        """The depth images that exist."""
        return files_by_id(self.path("depth"), _IMAGES)

    @cached_property
    def colour_files(self) -> dict[int, Path]:
        """The colour or grey images that exist."""
        gray, rgb = (files_by_id(self.path(name), (*_IMAGES, ".jpg", ".jpeg")) for name in ("gray", "rgb"))
        return {**gray, **rgb}

    @cached_property
    def mask_folders(self) -> tuple[str, ...]:
        """The kinds of masks that the scene has."""
        return tuple(name for name in ("mask", "mask_visib") if self.path(name).is_dir())


class FrameReader:
    """Reads one frame. `faults` collects what is wrong with it; whole files are the scene's concern.

    `factor` turns millimetres into the frame's unit; objects are to be among `object_ids`, if given.
    """

    def __init__(
        self,
        scene: Scene,
        image_id: int,
        factor: float,
        object_ids: tuple[int, ...] | None = None,
        sensor: Camera | None = None,
    ) -> None:
        self.scene, self.image_id, self.factor = scene, image_id, factor
        self.object_ids, self.sensor = object_ids, sensor
        self.faults: list[BopFault] = []
        missing = scene.path("depth") / f"{image_id:06d}.png"
        self.depth_file = scene.depth_files.get(image_id, missing)

    def read(self, masks: bool, decode: bool = True) -> BopFrame | None:
        """Return the frame, with its masks only if asked; None if there is a fault in what was asked for.

        Without `decode` look for faults only: in the JSON files and in the sizes of images.
        """
        entry, instances = self._attempt(self._camera), self._instances()
        its_bin, T_camera_bin = self._attempt(self._bin) or (None, None)
        if decode:
            depth = self._attempt(read_depth, self.depth_file, self.factor * (entry.depth_scale if entry else 1.0))
            size = None if depth is None else (depth.shape[1], depth.shape[0])
        else:
            depth, size = None, self._attempt(image_size, self.depth_file)
        if size is None:
            return None
        self._check_size(size, entry, None if not decode else 0 if masks else 1)
        shown = {name: self._masks(name, size) for name in self.scene.mask_folders if decode and masks}
        if depth is None or entry is None or self.faults:
            return None
        (fx, _, cx), (_, fy, cy), _ = entry.matrix.tolist()
        camera, both = Camera(fx, fy, cx, cy, *size), (shown.get("mask"), shown.get("mask_visib"))
        return BopFrame(camera, depth, instances, entry.T_camera_world, its_bin, T_camera_bin, *both)

    def _attempt(self, function: Callable[_P, _T], *args: _P.args, **kwargs: _P.kwargs) -> _T | None:
        try:
            return function(*args, **kwargs)
        except BopFault as fault:
            self.faults.append(fault)
            return None

    def _values(self, name: str) -> Any:
        """Return what a file holds for the image."""
        if self.image_id not in self.scene.entries[name]:
            raise self._fault(name, "is missing")
        return self.scene.entries[name][self.image_id]

    def _fault(self, name: str, what: str) -> BopFault:
        return BopFault(self.scene.path(name, ".json"), f"image {self.image_id}", what)

    def _entry(self, name: str, values: Any, instance: str = "") -> Entry:
        return Entry(self.scene.path(name, ".json"), f"image {self.image_id}{instance}", values)

    def _camera(self) -> CameraEntry | None:
        if _CAMERA not in self.scene.entries:
            return None
        return parse_camera(self._entry(_CAMERA, self._values(_CAMERA)), self.factor)

    def _bin(self) -> tuple[Bin, Float[np.ndarray, "4 4"]] | None:
        if self.image_id not in self.scene.entries.get(BIN_FILE, {}):
            return None
        return parse_bin(self._entry(BIN_FILE, self._values(BIN_FILE)), self.factor)

    def _instances(self) -> tuple[BopInstance, ...] | None:
        truths, infos = self._attempt(self._listed, _TRUTH), self._attempt(self._listed, _INFO)
        if truths is None:
            return None
        if infos is not None and len(infos) != len(truths):
            truth_name = self.scene.path(_TRUTH, ".json").name
            self.faults.append(self._fault(_INFO, f"has {len(infos)} instances, but {truth_name} has {len(truths)}"))
            infos = None
        pairs = zip(truths, infos or [None] * len(truths), strict=True)
        found = [self._attempt(self._instance, index, *pair) for index, pair in enumerate(pairs)]
        return tuple(instance for instance in found if instance is not None)

    def _listed(self, name: str) -> list[Any] | None:
        if name not in self.scene.entries:
            return None
        values = self._values(name)
        if not isinstance(values, list):
            raise self._fault(name, "must be a list of instances")
        return values

    def _instance(self, index: int, truth: Any, info: Any) -> BopInstance:
        name = f", instance {index}"
        entry = self._entry(_TRUTH, truth, name)
        instance = parse_instance(entry, None if info is None else self._entry(_INFO, info, name), self.factor)
        if self.object_ids is not None and instance.object_id not in self.object_ids:
            raise entry.fault(f"obj_id {instance.object_id} has no model: the dataset's models are {self.object_ids}")
        return instance

    def _mask_files(self, name: str) -> list[Path]:
        truths = self.scene.entries.get(_TRUTH, {}).get(self.image_id)
        count = len(truths) if isinstance(truths, list) else 0
        return [self.scene.path(name) / f"{self.image_id:06d}_{index:06d}.png" for index in range(count)]

    def _masks(self, name: str, size: tuple[int, int]) -> Bool[np.ndarray, "n h w"]:
        files = self._mask_files(name)
        try:
            check_bytes(len(files) * size[0] * size[1])
        except InputError as error:
            self.faults.append(self._fault(_TRUTH, f"names {len(files)} instances, and of their masks: {error}"))
            files = []
        masks = np.zeros((len(files), size[1], size[0]), dtype=bool)
        for index, file in enumerate(files):
            mask = self._attempt(read_mask, file)
            if mask is not None and self._same_size(size, f"{name}/{file.name}", (mask.shape[1], mask.shape[0])):
                masks[index] = mask
        return masks

    def _check_size(self, size: tuple[int, int], entry: CameraEntry | None, num_masks: int | None) -> None:
        """Compare the depth image with colour, the first masks, and camera.json if the intrinsics are the same.

        In some datasets the images of other splits are crops of the sensor's; those have other intrinsics.
        """
        colour = self.scene.colour_files.get(self.image_id)
        if colour is not None:
            with contextlib.suppress(BopFault):  # colour is not used, so it may be broken
                self._same_size(size, f"{colour.parent.name}/{colour.name}", image_size(colour))
        for name in self.scene.mask_folders:
            for file in self._mask_files(name)[:num_masks]:
                found = self._attempt(image_size, file)
                if found is not None:
                    self._same_size(size, f"{name}/{file.name}", found)
        if self.sensor is not None and entry is not None and np.allclose(entry.matrix, self.sensor.matrix, rtol=1e-6):
            self._same_size(size, "camera.json", (self.sensor.width, self.sensor.height))

    def _same_size(self, size: tuple[int, int], other: str, found: tuple[int, int]) -> bool:
        if found != size:
            what = f"has {size[0]} x {size[1]} pixels, but {other} {found[0]} x {found[1]}: both must show the same"
            self.faults.append(BopFault(self.depth_file, "", what))
        return found == size
