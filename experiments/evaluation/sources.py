"""Where scans of known poses come from: BOP datasets, folders of clouds with poses, and our own ray-cast bins."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Float32

from experiments.evaluation.cases import UNIT, Image, ObjectImages
from experiments.evaluation.clouds import camera_of, mesh_of, scans_with_poses
from kmn_jax.bop import NAMES_FILE, BopDataset, BopFrame, FrameKey
from kmn_jax.data import load_models
from kmn_jax.detection import bin_content, foreground, make_scene
from kmn_jax.errors import InputError
from kmn_jax.geometry import measured_points
from kmn_jax.io import Scan, read_file, read_scan
from kmn_jax.objects import ObjectConfig, ObjectModel, load_object
from kmn_jax.units import METRES

OBJECT = ObjectConfig(num_points=4096)
Report = Callable[[str], None]
_Item = TypeVar("_Item")


def bop_objects(folder: Path, split: str, report: Report, most_images: int | None = None) -> list[ObjectImages]:
    """Return the objects of a BOP dataset with their images, or so many, evenly spread; all copies of one image count.

    What is broken (no ground truth, a depth image of another size, an unknown object, an empty scene) is reported and
    left out. Raises InputError if nothing can be used.
    """
    dataset = BopDataset(folder, split, unit=UNIT)
    models, problems = load_models(dataset, OBJECT)
    for problem in (*problems, *map(str, dataset.problems(decode=False))):
        report(problem)
    keys: dict[int, list[tuple[FrameKey, int]]] = {object_id: [] for object_id in models}
    for key in dataset.usable(decode=False):
        try:
            frame = dataset.frame(*key)
        except InputError as error:
            report(str(error))
            continue
        present = Counter(instance.object_id for instance in frame.instances or ())
        if not present:
            report(f"{folder.name}: image {key.image_id} of scene {key.scene_id} shows no object")
        for object_id in sorted(set(present) & set(models)):
            keys[object_id].append((key, present[object_id]))
    names = {object_id: _names(folder).get(object_id, f"object {object_id}") for object_id in models}
    found = [
        ObjectImages(
            names[object_id],
            replace(model, name=names[object_id]),
            BopImages(dataset, model, object_id, *zip(*_spread(keys[object_id], most_images), strict=True)),
        )
        for object_id, model in models.items()
        if keys[object_id]
    ]
    if not found:
        raise InputError(f"{folder} has no image that can be evaluated: see what was reported, or its models")
    return found


@dataclass(frozen=True)
class BopImages:
    """The images of a BOP dataset that show an object."""

    dataset: BopDataset
    model: ObjectModel
    object_id: int
    keys: tuple[FrameKey, ...]
    counts: tuple[int, ...]  # of copies in each

    @property
    def fullest(self) -> FrameKey:
        """The image with the most copies, the first one of several."""
        return self.keys[self.counts.index(max(self.counts))]

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, row: int, /) -> Image:
        key = self.keys[row]
        frame = self.dataset.frame(*key, masks=True).with_visibility()
        copies = [instance for instance in frame.instances or () if instance.object_id == self.object_id]
        points = measured_points(frame.depth, frame.camera)
        return Image(
            f"{key.scene_id}/{key.image_id}",
            points,
            _content(frame, points, self.model.diameter),
            np.stack([copy.T_camera_object for copy in copies]),
            np.array([np.nan if copy.visible_fraction is None else copy.visible_fraction for copy in copies]),
        )


@dataclass(frozen=True)
class CloudImages:
    """Clouds of one object with the poses of its copies, in files beside each other."""

    model: ObjectModel
    files: tuple[tuple[Path, Float[np.ndarray, "i 4 4"]], ...]
    camera: Path | None
    unit: str  # of clouds, poses and sensor, as of the CAD file
    sensor: Float[np.ndarray, "3"] | None  # in the clouds' frame; the origin unless given

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, row: int, /) -> Image:
        path, poses = self.files[row]
        scale = METRES[self.unit] / METRES[UNIT]
        scan = read_scan(path, self.unit, self.camera).in_unit(UNIT)
        scene = make_scene(scan, self.model.diameter, sensor=None if self.sensor is None else self.sensor * scale)
        scaled = poses.copy()
        scaled[:, :3, 3] *= scale
        T_camera_object = np.linalg.inv(scene.T_scene_camera) @ scaled
        return Image(path.name, scene.points, scene.foreground, T_camera_object, np.full(len(poses), np.nan))


def cloud_objects(
    folder: Path,
    cad: Path | None,
    camera: Path | None,
    unit: str,
    sensor: Float[np.ndarray, "3"] | None,
    most_images: int | None = None,
) -> list[ObjectImages]:
    """Return the object of a folder of scans with poses; see `clouds`. Lengths are in `unit`, those of the CAD too."""
    for given, what in ((cad, "a CAD file"), (camera, "a camera file")):
        if given is not None:
            read_file(given, what)
    files = scans_with_poses(folder, cad)
    path = cad or mesh_of(folder)
    model = load_object(path, unit, OBJECT).near().in_unit(UNIT)
    images = CloudImages(model, tuple(_spread(files, most_images)), camera or camera_of(folder), unit, sensor)
    return [ObjectImages(path.stem, model, images)]


def _content(frame: BopFrame, points: Float32[np.ndarray, "n 3"], diameter: float) -> Bool[np.ndarray, " n"]:
    """Return which points may show parts: what is inside of the bin if that is known, else off floor and walls."""
    if frame.bin is not None and frame.T_camera_bin is not None:
        content = np.asarray(bin_content(frame.depth, frame.camera, frame.T_camera_bin, frame.bin, diameter))
        inside = content[frame.depth > 0]
    else:
        inside, _ = foreground(Scan(points, None, None, None, UNIT), diameter)
    return inside if inside.any() else np.ones_like(inside)


def _spread(items: list[_Item], most: int | None) -> list[_Item]:
    count = len(items) if most is None else min(most, len(items))
    return [items[row * len(items) // count] for row in range(count)]


def _names(folder: Path) -> dict[int, str]:
    """Return what the dataset calls its objects."""
    path = folder / "models" / NAMES_FILE
    try:
        return {int(key): str(name) for key, name in json.loads(path.read_text(encoding="utf-8")).items()}
    except (OSError, ValueError, AttributeError):
        return {}
