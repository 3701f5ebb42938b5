"""Training samples: packs of objects in bins, and labelled crops made of them or of rendered images."""

from kmn_jax.data._bop_crops import BopCropConfig, BopCrops, load_models
from kmn_jax.data._build import Record, Source, build_pack, one_thread_a_process
from kmn_jax.data._crops import CropConfig, LabelledCrop, NormalSource, draw_crop, labelled_crop_around
from kmn_jax.data._device_pack import DevicePack, StackedPack, stack_pack, take_scene, visible_points
from kmn_jax.data._pack import SPLITS, Pack, PackedObject
from kmn_jax.data._pipeline import BatchIterator, PipelineConfig, SampleBatches, SampleIndex
from kmn_jax.data._recipe import PackConfig, bin_scenes, rendered_frame

__all__ = [
    "SPLITS",
    "BatchIterator",
    "BopCropConfig",
    "BopCrops",
    "CropConfig",
    "DevicePack",
    "LabelledCrop",
    "NormalSource",
    "Pack",
    "PackConfig",
    "PackedObject",
    "PipelineConfig",
    "Record",
    "SampleBatches",
    "SampleIndex",
    "Source",
    "StackedPack",
    "bin_scenes",
    "build_pack",
    "draw_crop",
    "labelled_crop_around",
    "load_models",
    "one_thread_a_process",
    "rendered_frame",
    "stack_pack",
    "take_scene",
    "visible_points",
]
