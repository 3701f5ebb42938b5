"""Crops of the depth images of a BOP dataset, read on the host, in the form that the steps take."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kmn_jax.bop import BopDataset
from kmn_jax.data import BopCropConfig, BopCrops, CropConfig, DevicePack, SampleIndex, load_models
from kmn_jax.errors import InputError
from kmn_jax.models import KeyMatchNetConfig
from kmn_jax.objects import ObjectConfig, ObjectModel
from kmn_jax.train._examples import RenderedCrops
from kmn_jax.train._step import RenderedSamples

_UNIT = "m"
_NUM_POINTS = 4096  # on an object, of which examples take a part, as from a pack


@dataclass(frozen=True)
class RenderedFrames:
    """The frames of a dataset's split as a source of samples: a frame takes the place of a pack's object.

    `pack` holds the objects without any scenes; `read` makes the crops of a batch, deterministically by its keys.
    """

    pack: DevicePack
    names: tuple[str, ...]  # of the pack's rows
    crops: BopCrops

    @property
    def num_frames(self) -> int:
        """How many frames can be used."""
        return len(self.crops.keys)

    @property
    def digest(self) -> str:
        """SHA-256 of the frames' ids and the objects: what indices of samples refer to."""
        frames = [[key.scene_id, key.image_id] for key in self.crops.keys]
        objects = [model.digest for model in self.crops.models]
        return hashlib.sha256(json.dumps([frames, objects]).encode()).hexdigest()

    def read(self, index: SampleIndex) -> RenderedSamples:
        """Return the samples of a batch whose `object` counts frames."""
        made = self.crops.read(index)
        crop = made.crop
        samples = SampleIndex(made.object, made.frame, index.key, made.mask)
        crops = RenderedCrops(
            crop.points, crop.normals, crop.mask, crop.is_object, crop.T_crop_object.astype(np.float32), crop.valid
        )
        return RenderedSamples(samples, crops)


def rendered_frames(
    folder: str | Path,
    split: str,
    network: KeyMatchNetConfig,
    crops: CropConfig,
    report: Callable[[str], None] | None = None,
) -> RenderedFrames:
    """Open a split of a BOP dataset with ground truth and meshes.

    Problems of single frames and objects go to `report`. Raises InputError if nothing of it can be used.
    """
    dataset = BopDataset(folder, split, unit=_UNIT)
    models, problems = load_models(dataset, ObjectConfig(num_points=max(_NUM_POINTS, network.num_object_points)))
    for problem in problems:
        if report is not None:
            report(problem)
    if not models:
        raise InputError(f"{folder} has no usable object: {'; '.join(problems) or 'its models folder is empty'}")
    config = BopCropConfig(crop=crops, num_keypoints=network.num_keypoints)
    source = BopCrops(dataset, models, config, report=report)
    ordered = [models[object_id] for object_id in source.object_ids]
    names = tuple(f"{object_id:06d}" for object_id in source.object_ids)
    return RenderedFrames(_objects(ordered), names, source)


def _objects(models: Sequence[ObjectModel]) -> DevicePack:
    """Return a pack of objects, of which none has a drop."""
    count = len(models)
    return DevicePack(
        points=np.stack([model.points.astype(np.float32) for model in models]),
        normals=np.stack([model.normals.astype(np.float32) for model in models]),
        area=np.array([model.area for model in models], dtype=np.float32),
        diameter=np.array([model.diameter for model in models], dtype=np.float32),
        num_drops=np.zeros(count, dtype=np.int32),
        T_camera_object=np.zeros((count, 0, 0, 4, 4), dtype=np.float32),
        num_copies=np.zeros((count, 0), dtype=np.int32),
        camera=np.zeros((count, 0, 6), dtype=np.float32),
        bin_size=np.zeros((count, 0, 3), dtype=np.float32),
        T_camera_bin=np.zeros((count, 0, 4, 4), dtype=np.float32),
    )
