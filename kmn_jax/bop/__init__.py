"""Datasets and result files in BOP format: read, checked and written."""

from kmn_jax.bop._dataset import BopDataset, FrameKey
from kmn_jax.bop._frames import BopFrame, BopInstance, scene_frame
from kmn_jax.bop._models import NAMES_FILE, write_models
from kmn_jax.bop._results import BopEstimate, write_results
from kmn_jax.bop._scans import bop_files, bop_object, bop_scan, bop_scene_id, bop_sizes, is_bop_image
from kmn_jax.bop._writer import dataset_digest, finest_depth_scale, write_camera, write_scene

__all__ = [
    "NAMES_FILE",
    "BopDataset",
    "BopEstimate",
    "BopFrame",
    "BopInstance",
    "FrameKey",
    "bop_files",
    "bop_object",
    "bop_scan",
    "bop_scene_id",
    "bop_sizes",
    "dataset_digest",
    "finest_depth_scale",
    "is_bop_image",
    "scene_frame",
    "write_camera",
    "write_models",
    "write_results",
    "write_scene",
]
