"""From a scan to the ranked poses of an object's copies."""

from kmn_jax.detection._background import BinMargins, away_from_empty, bin_content, in_front_of_empty, inside_bin
from kmn_jax.detection._bin_program import BinPoses, BinPosesConfig, bin_poses, device_calibration
from kmn_jax.detection._calibration import (
    Calibration,
    CalibrationArrays,
    Probabilities,
    expected_calibration_error,
    fit_calibration,
    load_probabilities,
    probabilities_bytes,
    reliability,
)
from kmn_jax.detection._canonical import canonical_pose
from kmn_jax.detection._crop_search import (
    CropPoses,
    CropSearchConfig,
    Draw,
    DrawsSearch,
    Prediction,
    draw_of_crop,
    find_poses_in_crop,
    matches_of,
    poses_in_crop,
    poses_of_draw,
    predict,
    refined,
    search_crop,
    search_draws,
    surface_scores,
)
from kmn_jax.detection._depth_agreement import (
    DepthAgreement,
    DepthAgreementConfig,
    DepthImage,
    depth_agreement,
    depth_buffer,
)
from kmn_jax.detection._detect import THOROUGH, DetectConfig, chosen, detect, detections, explore, refined_candidates
from kmn_jax.detection._device_part import DevicePart, device_part, same_place, symmetry_transforms
from kmn_jax.detection._estimator import PoseEstimator
from kmn_jax.detection._evidence import EVIDENCE, gather_evidence
from kmn_jax.detection._export import export_estimator
from kmn_jax.detection._foreground import ForegroundOptions, OrientedBox, foreground
from kmn_jax.detection._frames import into, placed
from kmn_jax.detection._grasps import Conflict, Copy, grasp_conflict, with_grasps
from kmn_jax.detection._kept_parts import prepare_kept
from kmn_jax.detection._mapping import call_rows, map_real, map_rows
from kmn_jax.detection._output import as_json, describe, table, write_bop_csv, write_json
from kmn_jax.detection._picture_agreement import PictureAgreement, picture_agreement
from kmn_jax.detection._result import CropPrediction, Detection, Detections, Pick, Timing
from kmn_jax.detection._scene import MOST_POINTS, Scene, make_scene
from kmn_jax.detection._search import (
    Candidates,
    SearchConfig,
    candidates_of,
    join,
    network_prediction,
    poses_at,
    search_at,
    seed_crop,
    seed_keys,
)
from kmn_jax.detection._seeds import NUM_SEEDS, seeds_at, seeds_over, spread_seeds
from kmn_jax.detection._selection import Selection, select, select_poses
from kmn_jax.detection._sources import GraspSource, MeshLike, PartSource, ScanSource
from kmn_jax.detection._timing import Clock

__all__ = [
    "EVIDENCE",
    "MOST_POINTS",
    "NUM_SEEDS",
    "THOROUGH",
    "BinMargins",
    "BinPoses",
    "BinPosesConfig",
    "Calibration",
    "CalibrationArrays",
    "Candidates",
    "Clock",
    "Conflict",
    "Copy",
    "CropPoses",
    "CropPrediction",
    "CropSearchConfig",
    "DepthAgreement",
    "DepthAgreementConfig",
    "DepthImage",
    "DetectConfig",
    "Detection",
    "Detections",
    "DevicePart",
    "Draw",
    "DrawsSearch",
    "ForegroundOptions",
    "GraspSource",
    "MeshLike",
    "OrientedBox",
    "PartSource",
    "Pick",
    "PictureAgreement",
    "PoseEstimator",
    "Prediction",
    "Probabilities",
    "ScanSource",
    "Scene",
    "SearchConfig",
    "Selection",
    "Timing",
    "as_json",
    "away_from_empty",
    "bin_content",
    "bin_poses",
    "call_rows",
    "candidates_of",
    "canonical_pose",
    "chosen",
    "depth_agreement",
    "depth_buffer",
    "describe",
    "detect",
    "detections",
    "device_calibration",
    "device_part",
    "draw_of_crop",
    "expected_calibration_error",
    "explore",
    "export_estimator",
    "find_poses_in_crop",
    "fit_calibration",
    "foreground",
    "gather_evidence",
    "grasp_conflict",
    "in_front_of_empty",
    "inside_bin",
    "into",
    "join",
    "load_probabilities",
    "make_scene",
    "map_real",
    "map_rows",
    "matches_of",
    "network_prediction",
    "picture_agreement",
    "placed",
    "poses_at",
    "poses_in_crop",
    "poses_of_draw",
    "predict",
    "prepare_kept",
    "probabilities_bytes",
    "refined",
    "refined_candidates",
    "reliability",
    "same_place",
    "search_at",
    "search_crop",
    "search_draws",
    "seed_crop",
    "seed_keys",
    "seeds_at",
    "seeds_over",
    "select",
    "select_poses",
    "spread_seeds",
    "surface_scores",
    "symmetry_transforms",
    "table",
    "with_grasps",
    "write_bop_csv",
    "write_json",
]
