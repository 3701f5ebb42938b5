"""Reading one frame of a BOP dataset, with every fault on the way."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Float32

from kmn_jax.bop._files import BopFault, Entry, files_by_id, image_size, read_depth, read_json_by_id, read_mask
from kmn_jax.bop._frames import BopFrame, BopInstance, CameraEntry, parse_bin, parse_camera, parse_instance
from kmn_jax.bop._writer import BIN_FILE
from kmn_jax.geometry import Camera
from kmn_jax.simulate import Bin

_P = ParamSpec("_P")
_T = TypeVar("_T")
_CAMERA, _TRUTH, _INFO = "scene_camera", "scene_gt", "scene_gt_info"


class Scene:
    """The folder of a scene, and what its JSON files hold, each read once and when needed."""

    def __init__(self, folder: Path, sensor: str | None, ground_truth: bool) -> None:
        self.folder, self.sensor, self.ground_truth = folder, sensor, ground_truth

    def path(self, name: str, suffix: str = "") -> Path:
        """Return the path of one of the scene's files or folders."""
        return self.folder / (f"{name}_{self.sensor}{suffix}" if self.sensor else f"{name}{suffix}")

    @cached_property
    def image_ids(self) -> dict[int, None]:
        """The images that either required file names, in order."""
        return dict.fromkeys(sorted({image for entries in self._required[0].values() for image in entries}))

    @property
    def entries(self) -> dict[str, dict[int, Any]]:
        """The entries by image of each file that is there and can be read."""
        return {**self._required[0], **self._optional[0]}

    @property
    def faults(self) -> list[BopFault]:
        """What is wrong with whole files."""
        return [*self._required[1], *self._optional[1]]

    @cached_property
    def depth_files(self) -> dict[int, Path]:
        """The depth images that exist."""
        return files_by_id(self.path("depth"), (".png", ".tif", ".tiff"))

    @cached_property
    def colour_files(self) -> dict[int, Path]:
        """The colour or grey images that exist."""
        suffixes = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
        return {**files_by_id(self.path("gray"), suffixes), **files_by_id(self.path("rgb"), suffixes)}

    @cached_property
    def mask_folders(self) -> tuple[str, ...]:
        """The kinds of masks that the scene has."""
        return tuple(name for name in ("mask", "mask_visib") if self.path(name).is_dir())

    @cached_property
    def _required(self) -> tuple[dict[str, dict[int, Any]], list[BopFault]]:
        return self._read(_CAMERA, *([_TRUTH] if self.ground_truth else []))

    @cached_property
    def _optional(self) -> tuple[dict[str, dict[int, Any]], list[BopFault]]:
        names = (BIN_FILE, _INFO) if self.ground_truth else (BIN_FILE,)
        return self._read(*(name for name in names if self.path(name, ".json").exists()))

    def _read(self, *names: str) -> tuple[dict[str, dict[int, Any]], list[BopFault]]:
        entries, faults = {}, []
        for name in names:
            try:
                entries[name] = read_json_by_id(self.path(name, ".json"))
            except BopFault as fault:
                faults.append(fault)
        return entries, faults


class FrameReader:
    """Reads one frame. `faults` collects what is wrong with it; whole files are the scene's concern."""

    def __init__(
        self, scene: Scene, image_id: int, factor: float, object_ids: tuple[int, ...] | None, sensor: Camera | None
    ) -> None:
        self.scene, self.image_id, self.factor = scene, image_id, factor
        self.object_ids, self.sensor = object_ids, sensor
        self.faults: list[BopFault] = []

    def frame(self, with_masks: bool) -> BopFrame | None:
        """Return the frame, or None if there is a fault that concerns what was asked for."""
        entry, instances, (its_bin, T_camera_bin) = self._camera(), self._instances(), self._bin()
        depth = self._depth(entry, self.factor)
        if entry is None or depth is None:
            return None
        size = (depth.shape[1], depth.shape[0])
        self._check_size(size, entry, num_masks=0 if with_masks else 1)
        camera = self._attempt(entry.camera, *size)
        masks = {name: self._masks(name, size) for name in self.scene.mask_folders if with_masks}
        if camera is None or self.faults:
            return None
        shown = (masks.get("mask"), masks.get("mask_visib"))
        return BopFrame(camera, depth, instances, entry.T_camera_world, its_bin, T_camera_bin, *shown)

    def check(self, decode: bool) -> None:
        """Look for every fault, in all images too, or with `decode` false in their sizes only."""
        entry, _, _ = self._camera(), self._instances(), self._bin()
        if decode:
            depth = self._depth(entry, self.factor)
            size = None if depth is None else (depth.shape[1], depth.shape[0])
        else:
            size = self._attempt(image_size, self._depth_file)
        if size is None:
            return
        self._check_size(size, entry, num_masks=0 if decode else None)
        for name in self.scene.mask_folders:
            if decode:
                self._masks(name, size)

    def _attempt(self, function: Callable[_P, _T], *args: _P.args, **kwargs: _P.kwargs) -> _T | None:
        try:
            return function(*args, **kwargs)
        except BopFault as fault:
            self.faults.append(fault)
            return None

    def _file(self, name: str) -> Path:
        return self.scene.path(name, ".json")

    def _entry(self, name: str) -> Any:
        if self.image_id not in self.scene.entries[name]:
            raise BopFault(self._file(name), f"image {self.image_id}", "is missing")
        return self.scene.entries[name][self.image_id]

    def _camera(self) -> CameraEntry | None:
        def parse() -> CameraEntry:
            entry = Entry(self._file(_CAMERA), f"image {self.image_id}", self._entry(_CAMERA))
            return parse_camera(entry, self.factor)

        return self._attempt(parse) if _CAMERA in self.scene.entries else None

    def _instances(self) -> tuple[BopInstance, ...] | None:
        def listed(name: str) -> list[Any]:
            values = self._entry(name)
            if not isinstance(values, list):
                raise BopFault(self._file(name), f"image {self.image_id}", "must be a list of instances")
            return values

        truths, infos = (
            self._attempt(listed, name) if name in self.scene.entries else None for name in (_TRUTH, _INFO)
        )
        if truths is None:
            return None
        if infos is not None and len(infos) != len(truths):
            what = f"has {len(infos)} instances, but {self._file(_TRUTH).name} has {len(truths)}"
            self.faults.append(BopFault(self._file(_INFO), f"image {self.image_id}", what))
            infos = None
        pairs = zip(truths, infos or [None] * len(truths), strict=True)
        found = [self._attempt(self._instance, index, *pair) for index, pair in enumerate(pairs)]
        return tuple(instance for instance in found if instance is not None)

    def _instance(self, index: int, truth: Any, info: Any) -> BopInstance:
        name = f"image {self.image_id}, instance {index}"
        entry = Entry(self._file(_TRUTH), name, truth)
        instance = parse_instance(entry, None if info is None else Entry(self._file(_INFO), name, info), self.factor)
        if self.object_ids is not None and instance.object_id not in self.object_ids:
            raise entry.fault(f"obj_id {instance.object_id} has no model: the dataset's models are {self.object_ids}")
        return instance

    def _bin(self) -> tuple[Bin, Float[np.ndarray, "4 4"]] | tuple[None, None]:
        def parse() -> tuple[Bin, Float[np.ndarray, "4 4"]]:
            entry = Entry(self._file(BIN_FILE), f"image {self.image_id}", self._entry(BIN_FILE))
            return parse_bin(entry, self.factor)

        there = self.image_id in self.scene.entries.get(BIN_FILE, {})
        return (self._attempt(parse) if there else None) or (None, None)

    @property
    def _depth_file(self) -> Path:
        return self.scene.depth_files.get(self.image_id, self.scene.path("depth") / f"{self.image_id:06d}.png")

    def _depth(self, camera: CameraEntry | None, factor: float) -> Float32[np.ndarray, "h w"] | None:
        return self._attempt(read_depth, self._depth_file, factor * (camera.depth_scale if camera else 1.0))

    def _mask_files(self, name: str) -> list[Path]:
        truths = self.scene.entries.get(_TRUTH, {}).get(self.image_id)
        count = len(truths) if isinstance(truths, list) else 0
        return [self.scene.path(name) / f"{self.image_id:06d}_{index:06d}.png" for index in range(count)]

    def _masks(self, name: str, size: tuple[int, int]) -> Bool[np.ndarray, "n h w"]:
        files = self._mask_files(name)
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
            self.faults.append(BopFault(self._depth_file, "", what))
        return found == size
