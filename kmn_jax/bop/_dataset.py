"""Datasets in BOP format: frames read on demand, faults named by file and entry."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from kmn_jax.bop._files import BopFault, Entry, millimetres, of_sensor, read_json
from kmn_jax.bop._frames import BopFrame
from kmn_jax.bop._models import BopModel, mesh_files, read_models
from kmn_jax.bop._reader import FrameReader, Scene
from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera


class FrameKey(NamedTuple):
    """The ids of a frame in its split."""

    scene_id: int
    image_id: int


class BopDataset:
    """One split of a dataset. Nothing is read before it is asked for; the JSON files of a scene are then kept.

    Frames come in the order of their ids, with lengths in `unit`. `sensor` picks one of several that a scene has
    (`scene_gt_SENSOR.json`, `depth_SENSOR/`). Without `ground_truth` the frames have no instances, as in test splits
    whose poses are not public. A frame that is asked for and has a fault raises InputError; `problems` names all
    faults, `usable` the frames without one.
    """

    def __init__(
        self,
        folder: str | Path,
        split: str,
        unit: str = "mm",
        sensor: str | None = None,
        models_folder: str = "models",
        ground_truth: bool = True,
    ) -> None:
        """Open a split by its folder's name, such as test, test_primesense or train_pbr.

        Raises InputError if the folder has no such split.
        """
        self.folder, self.split, self.unit, self.sensor = Path(folder), split, unit, sensor
        self.models_folder, self.ground_truth = models_folder, ground_truth
        self._factor = 1 / millimetres(unit)
        if not self._folders:
            known = ", ".join(self.splits(folder)) or "none: a split is a folder of folders like 000000"
            raise InputError(f"{folder} has no split {split!r} with scenes; its splits: {known}")

    @staticmethod
    def splits(folder: str | Path) -> tuple[str, ...]:
        """Return the names of a dataset's splits. Raises InputError if there is no such folder."""
        if not Path(folder).is_dir():
            raise InputError(f"{folder} is not a folder: name the folder of a BOP dataset")
        return tuple(sorted(path.name for path in Path(folder).iterdir() if _numbered(path)))

    @cached_property
    def keys(self) -> tuple[FrameKey, ...]:
        """The frames that scene_camera.json or scene_gt.json name, broken ones included."""
        return tuple(FrameKey(scene_id, image) for scene_id, scene in self._scenes.items() for image in scene.image_ids)

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, index: int) -> BopFrame:
        return self.frame(*self.keys[index])

    def frame(self, scene_id: int, image_id: int, masks: bool = False) -> BopFrame:
        """Read a frame, its masks only if asked. Raises InputError if anything of it is missing or broken."""
        scene = self._scenes.get(scene_id)
        if scene is None:
            raise InputError(f"{self.folder / self.split} has no scene {scene_id}")
        if image_id not in scene.image_ids and not scene.faults:
            raise InputError(f"{scene.folder} has no image {image_id}")
        reader = self._reader(scene, image_id)
        frame = reader.read(masks)
        faults = [*scene.faults, *reader.faults]
        if faults or frame is None:
            more = f" ({len(faults) - 1} more faults: see BopDataset.problems)" if len(faults) > 1 else ""
            raise InputError(f"frame {image_id} of scene {scene_id} cannot be used: {faults[0]}{more}")
        return frame

    def problems(self, decode: bool = True) -> tuple[BopFault, ...]:
        """Check all of the split and return what is wrong, in the order of scenes and images.

        Every image is decoded, or, without `decode`, its size read only, which misses damage further on.
        """
        camera_fault, taken = self._camera[1], set(self._folders.values())
        found = [*self._models[1].values(), *([camera_fault] if camera_fault else [])]
        what = "has the scene id of another folder and is passed over: rename it"
        found += [BopFault(path, "", what) for path in _numbered(self.folder / self.split) if path not in taken]
        for scene_id, scene in self._scenes.items():
            found += [fault.of_frame(scene_id) for fault in scene.faults]
            for image_id in scene.image_ids:
                reader = self._reader(scene, image_id)
                reader.read(masks=True, decode=decode)
                found += [fault.of_frame(scene_id, image_id) for fault in reader.faults]
        return tuple(found)

    def usable(self, decode: bool = True) -> tuple[FrameKey, ...]:
        """Return the frames of which `problems` finds none."""
        bad = {(problem.scene_id, problem.image_id) for problem in self.problems(decode)}
        return tuple(key for key in self.keys if key not in bad and (key.scene_id, None) not in bad)

    @cached_property
    def object_ids(self) -> tuple[int, ...] | None:
        """The ids of the objects that have a mesh or are told of, None if the dataset has no models."""
        models, faults = self._models
        told = {*models, *(object_id for object_id in faults if object_id is not None)}
        return tuple(sorted(told | set(mesh_files(self.folder / self.models_folder)))) or None

    def model(self, object_id: int) -> BopModel:
        """Return an object's size and mesh. Raises InputError if they are missing or broken."""
        models, faults = self._models
        if object_id not in models:
            fault = faults.get(object_id, faults.get(None))
            reason = fault or f"{self.folder / self.models_folder} does not have it"
            raise InputError(f"object {object_id} has no usable model: {reason}")
        return models[object_id]

    def _reader(self, scene: Scene, image_id: int) -> FrameReader:
        return FrameReader(scene, image_id, self._factor, self.object_ids, self._camera[0])

    @cached_property
    def _folders(self) -> dict[int, Path]:
        """The folders of the scenes by id, in order; the first one where two have the same."""
        folders = {int(path.name): path for path in reversed(_numbered(self.folder / self.split))}
        return dict(sorted(folders.items()))

    @cached_property
    def _scenes(self) -> dict[int, Scene]:
        return {scene_id: Scene(path, self.sensor, self.ground_truth) for scene_id, path in self._folders.items()}

    @cached_property
    def _models(self) -> tuple[dict[int, BopModel], dict[int | None, BopFault]]:
        folder = self.folder / self.models_folder
        return read_models(folder, self.unit) if folder.is_dir() else ({}, {})

    @cached_property
    def _camera(self) -> tuple[Camera | None, BopFault | None]:
        """The sensor of camera.json, whose size that of images is compared with, or what is wrong with it."""
        file = self.folder / of_sensor("camera", self.sensor, ".json")
        if not file.exists():
            return None, None
        try:
            entry = Entry(file, "", read_json(file))
            intrinsics = {key: entry.number(key) for key in ("fx", "fy", "cx", "cy")}
            size = {key: entry.integer(key) for key in ("width", "height")}
            return entry.make(Camera, **intrinsics, **size), None
        except BopFault as fault:
            return None, fault


def _numbered(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.name.isascii() and path.name.isdigit() and path.is_dir())
