"""Labelled crops of the depth images of a BOP dataset, read on the host: the same record as from a pack's scenes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Int32

from kmn_jax.bop import BopDataset, BopFrame, BopInstance, FrameKey
from kmn_jax.data._crops import CropConfig, LabelledCrop, labelled_crop_around
from kmn_jax.data._pipeline import SampleIndex
from kmn_jax.errors import InputError
from kmn_jax.geometry import measured_points
from kmn_jax.objects import ObjectConfig, ObjectModel, load_object
from kmn_jax.simulate import BIN, VisiblePoints

_crop_around = jax.jit(labelled_crop_around, static_argnames="config")


@dataclass(frozen=True)
class BopCropConfig:
    """Choose what a crop holds, and how points are labelled where the dataset has no masks of what is visible."""

    crop: CropConfig = field(default_factory=CropConfig)
    num_keypoints: int = 20
    # A point belongs to the instance with the nearest surface within this share of its diameter. It must cover the
    # sensor's noise and the errors of the poses; points of copies that touch are told apart no better than by it.
    label_tolerance: float = 0.02

    def __post_init__(self) -> None:
        if self.num_keypoints < 1 or not 0 < self.label_tolerance < 1:
            raise InputError(
                f"BOP crops: num_keypoints = {self.num_keypoints} must be 1 or more, and label_tolerance ="
                f" {self.label_tolerance} between 0 and 1"
            )
        if self.crop.normals != "estimated":
            raise InputError(f'BOP crops: normals = "{self.crop.normals}", but depth images have none: use "estimated"')


class FrameCrops(NamedTuple):
    """A batch of crops and what they show."""

    crop: LabelledCrop  # each array with a leading axis b; `instance` counts those of the frame
    object: Int32[np.ndarray, " b"]  # row in `BopCrops.object_ids`
    frame: Int32[np.ndarray, " b"]  # row in `BopCrops.keys`
    mask: Bool[np.ndarray, " b"]  # false for padding of the batch


class BopCrops:
    """Crops of a dataset's frames, as a function of the frame's row and a key: `SampleIndex` in, `FrameCrops` out.

    Give `len(keys)` as the number of objects to `kmn_jax.data._pipeline.SampleBatches`, 1 as that of drops, and `read`
    as what makes batches: a frame then takes the place of an object, and the crops of a group show one object.

    A crop's seed is a random visible point of a random instance of which enough is visible, if it is known how much.
    Frames with a fault are left out if the JSON files or the images' sizes show it, else they give crops that are not
    valid; either way `problems` names file and entry. Frames without a usable instance give crops that are not valid.
    """

    def __init__(
        self,
        dataset: BopDataset,
        models: Mapping[int, ObjectModel],
        config: BopCropConfig | None = None,
        decode: bool = False,
        report: Callable[[str], None] | None = None,
    ) -> None:
        """Check the dataset; `decode` finds damage inside of images, too, but reads them all.

        Instances of objects without a model are not cropped. Each problem goes to `report` once, when it is found.
        Raises InputError if there is no ground truth, no usable frame, or if a model has too few points.
        """
        if not dataset.ground_truth:
            raise InputError(f"{dataset.folder} was opened without ground truth, which crops need for their labels")
        if not models:
            raise InputError(f"{dataset.folder}: no object has a model, which crops need for their labels")
        self.dataset, self.config = dataset, config or BopCropConfig()
        self.problems: list[str] = []
        self._report = report
        found = dataset.problems(decode)
        for problem in found:
            self._add_problem(str(problem))
        bad = {(problem.scene_id, problem.image_id) for problem in found}
        self.keys: tuple[FrameKey, ...] = tuple(
            key for key in dataset.keys if key not in bad and (key.scene_id, None) not in bad
        )
        if not self.keys:
            reason = f": {self.problems[0]}" if self.problems else ""
            raise InputError(f"{dataset.folder / dataset.split} has no usable frame{reason}")
        self.object_ids = tuple(sorted(models))
        self.models = tuple(models[object_id].in_unit(dataset.unit) for object_id in self.object_ids)
        for object_id, model in zip(self.object_ids, self.models, strict=True):
            if len(model.points) < self.config.num_keypoints:
                raise InputError(
                    f"the model of object {object_id} has {len(model.points)} points, too few for"
                    f" {self.config.num_keypoints} keypoints"
                )
        self._surfaces = {
            object_id: _Surface(model) for object_id, model in zip(self.object_ids, self.models, strict=True)
        }

    def read(self, index: SampleIndex) -> FrameCrops:
        """Return the crops of a batch; the rows of one frame that follow one another show one object."""
        objects, crops = [], []
        rows = index.object.tolist()
        start = 0
        while start < len(rows):
            stop = next((row for row in range(start, len(rows)) if rows[row] != rows[start]), len(rows))
            which, made = self._crops(rows[start], index.key[start:stop])
            objects += [which] * len(made)
            crops += made
            start = stop
        stacked: LabelledCrop = jax.tree.map(lambda *parts: np.stack(parts), *crops)
        return FrameCrops(stacked, np.array(objects, dtype=np.int32), index.object, index.mask)

    def _crops(self, row: int, keys: np.ndarray) -> tuple[int, list[LabelledCrop]]:
        """Return the row of an object and one crop of its instances for each key."""
        key = self.keys[row]
        try:
            frame = self.dataset.frame(*key, masks=True)
        except InputError as error:
            self._add_problem(str(error))
            return 0, [self._empty_crop(keys[0])] * len(keys)
        view = _View(frame, self._surfaces, self.config)
        crops: list[LabelledCrop] = []
        object_id = None
        for sample_key in keys:
            words = [int(word) for word in sample_key]
            rng = np.random.Generator(np.random.Philox(key=words[0] << 32 | words[1]))
            seed = view.draw_seed(rng, object_id)
            if seed is None:
                crops.append(self._empty_crop(sample_key))
                continue
            object_id = view.instances[seed[0]].object_id
            crops.append(self._crop(view, *seed, sample_key, rng))
        return 0 if object_id is None else self.object_ids.index(object_id), crops

    def _crop(
        self, view: _View, instance: int, seed: Float[np.ndarray, "3"], key: np.ndarray, rng: np.random.Generator
    ) -> LabelledCrop:
        """Return the crop around a seed: its points are drawn here, so that arrays of one small size go into jit."""
        config, placed = self.config.crop, view.instances[instance]
        surface = self._surfaces[placed.object_id]
        near = view.rows_within(seed, config.radius * surface.model.diameter)
        if not config.include_bin:
            near = near[view.owners(near) != BIN]
        others = near[_squared_lengths(view.points[near] - seed) > 0]
        drawn = rng.choice(others, min(len(others), config.num_drawn - 1), replace=False)
        owners = view.owners(drawn)
        points = np.concatenate([seed[None], view.points[drawn]])
        copies = np.array([0, *np.where(owners == instance, 0, np.where(owners == BIN, BIN, 1))])
        crop: Any = self._jitted(key, points, copies, placed.T_camera_object, surface.model)
        made: LabelledCrop = crop._replace(instance=np.int32(instance), num_inside=np.int32(1 + len(others)))
        return made

    def _empty_crop(self, key: np.ndarray) -> LabelledCrop:
        return self._jitted(key, np.zeros((0, 3)), np.zeros(0), np.eye(4), self.models[0])

    def _jitted(
        self,
        key: np.ndarray,
        points: Float[np.ndarray, "n 3"],
        copies: np.ndarray,
        T_camera_object: Float[np.ndarray, "4 4"],
        model: ObjectModel,
    ) -> LabelledCrop:
        """Return the crop of points around the first, which lies on copy 0."""
        count, capacity = len(points), self.config.crop.num_drawn
        arrays: dict[str, Any] = {
            "points": np.zeros((capacity, 3), dtype=np.float32),
            "normals": np.zeros((capacity, 3), dtype=np.float32),
            "picture_area": np.ones(capacity, dtype=np.float32),  # pixels cover the same area of the picture
            "instance": np.full(capacity, BIN, dtype=np.int32),
            "mask": np.arange(capacity) < count,
            "visible_fraction": np.array([1, 0], dtype=np.float32),
        }
        arrays["points"][:count], arrays["instance"][:count] = points, copies
        poses = np.stack([T_camera_object, np.eye(4)]).astype(np.float32)
        keypoints, diameter = model.points[: self.config.num_keypoints], np.float32(model.diameter)
        with _on_host():
            crop = _crop_around(
                key,
                VisiblePoints(**arrays),
                np.int32(0),
                np.bool_(count > 0),
                keypoints,
                poses,
                diameter,
                config=self.config.crop,
            )
            result: LabelledCrop = jax.tree.map(np.asarray, crop)
        return result

    def _add_problem(self, problem: str) -> None:
        if problem not in self.problems:
            self.problems.append(problem)
            if self._report is not None:
                self._report(problem)


def load_models(
    dataset: BopDataset, config: ObjectConfig | None = None
) -> tuple[dict[int, ObjectModel], tuple[str, ...]]:
    """Make object models of a dataset's meshes, in its unit; return them by id, and why others cannot be used."""
    models, problems = {}, []
    for object_id in dataset.object_ids or ():
        try:
            path = dataset.model(object_id).path
            if path is None:
                raise InputError(f"object {object_id} has no mesh in {dataset.folder / dataset.models_folder}")
            models[object_id] = load_object(path, "mm", config).near().in_unit(dataset.unit)
        except InputError as error:
            problems.append(str(error))
    return models, tuple(problems)


class _Surface:
    """A model whose distance to points can be told."""

    def __init__(self, model: ObjectModel) -> None:
        self.model = model
        self.center = (model.minimum + model.maximum) / 2
        self.radius = model.diagonal / 2
        self.spacing = float(np.sqrt(model.area / len(model.points)))

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.model.points)

    def distances(self, points_object: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return distances to discs about the model's points, which cover its surface."""
        _, nearest = self._tree.query(points_object)
        offsets = points_object - self.model.points[nearest]
        along = np.abs((offsets * self.model.normals[nearest]).sum(axis=1))
        across = np.sqrt(np.maximum(_squared_lengths(offsets) - along**2, 0))
        return np.hypot(along, np.maximum(across - self.spacing, 0))


class _View:
    """The measured points of a frame and the instance that each belongs to."""

    def __init__(self, frame: BopFrame, surfaces: Mapping[int, _Surface], config: BopCropConfig) -> None:
        self._surfaces, self._config = surfaces, config
        self.instances: Sequence[BopInstance] = frame.with_visibility().instances or ()
        self._pixels = np.flatnonzero(frame.depth > 0)
        self.points = measured_points(frame.depth, frame.camera)
        self._masks = None
        if frame.visible_masks is not None:
            self._masks = frame.visible_masks.reshape(len(frame.visible_masks), -1)

    def draw_seed(self, rng: np.random.Generator, object_id: int | None) -> tuple[int, Float[np.ndarray, "3"]] | None:
        """Return a random instance, of one object if given, and a random one of its points; None if there is none."""
        least = self._config.crop.min_visible_fraction
        usable = [
            index
            for index, instance in enumerate(self.instances)
            if instance.object_id in (self._surfaces if object_id is None else (object_id,))
            and (instance.visible_fraction is None or instance.visible_fraction >= least)
        ]
        for index in rng.permutation(np.array(usable, dtype=np.int64)).tolist():
            rows = self._rows_of(index)
            if len(rows):
                return index, self.points[rng.choice(rows)]
        return None

    def rows_within(self, center: Float[np.ndarray, "3"], radius: float) -> Int[np.ndarray, " n"]:
        """Return the rows of points in a ball."""
        return np.flatnonzero(_squared_lengths(self.points - center) <= radius**2)

    def owners(self, rows: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        """Return the instance that each point is on, or BIN."""
        if self._masks is not None:
            if not len(self._masks):
                return np.full(len(rows), BIN)
            seen = self._masks[:, self._pixels[rows]]
            return np.where(seen.any(axis=0), seen.argmax(axis=0), BIN)
        points = self.points[rows].astype(np.float64)
        least, owners = np.full(len(rows), np.inf), np.full(len(rows), BIN)
        for index, instance in enumerate(self.instances):
            surface = self._surfaces.get(instance.object_id)
            if surface is None:
                continue
            tolerance = self._config.label_tolerance * surface.model.diameter
            pose = instance.T_camera_object
            center = pose[:3, :3] @ surface.center + pose[:3, 3]
            near = np.flatnonzero(_squared_lengths(points - center) <= (surface.radius + tolerance) ** 2)
            distances = surface.distances((points[near] - pose[:3, 3]) @ pose[:3, :3]) if len(near) else np.zeros(0)
            better = (distances <= tolerance) & (distances < least[near])
            least[near[better]], owners[near[better]] = distances[better], index
        return owners

    def _rows_of(self, index: int) -> Int[np.ndarray, " n"]:
        if self._masks is not None:
            return np.flatnonzero(self._masks[index, self._pixels])
        pose, surface = self.instances[index].T_camera_object, self._surfaces[self.instances[index].object_id]
        reach = surface.radius + self._config.label_tolerance * surface.model.diameter
        rows = self.rows_within(pose[:3, :3] @ surface.center + pose[:3, 3], reach)
        return rows[self.owners(rows) == index]


def _squared_lengths(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return np.einsum("ij,ij->i", vectors, vectors)  # ten times faster than a sum over the short axis


def _on_host() -> AbstractContextManager[Any]:
    """Keep small computations off the accelerator, unless JAX has been told to know nothing else."""
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:
        return nullcontext()
