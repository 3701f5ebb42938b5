"""From a scan to the ranked poses of an object's copies."""

from kmn_jax.detection._background import BinMargins, away_from_empty, bin_content, in_front_of_empty, inside_bin
from kmn_jax.detection._bin_program import BinPoses, BinPosesConfig, bin_poses, device_calibration
from kmn_jax.detection._calibration import (
    COMPANY,
    Calibration,
    CalibrationArrays,
    Probabilities,
    averaged,
    calibration_beside,
    chance_calibration_error,
    company,
    expected_calibration_error,
    in_company,
    keeps_order,
    load_probabilities,
    probabilities_bytes,
    reliability,
)
from kmn_jax.detection._canonical import canonical_pose
from kmn_jax.detection._choice import (
    Choice,
    choose_and_refine,
    chosen,
    in_unsure_places,
    next_best_rows,
    refined_candidates,
    reported,
)
from kmn_jax.detection._config import FAST, THOROUGH, DetectConfig, Effort, config_of
from kmn_jax.detection._coverage import near_surface
from kmn_jax.detection._crop_search import (
    CropPoses,
    DrawsSearch,
    find_poses_in_crop,
    poses_in_crop,
    search_crop,
    search_draws,
)
from kmn_jax.detection._depth_agreement import (
    DepthAgreement,
    DepthAgreementConfig,
    DepthImage,
    depth_agreement,
    depth_buffer,
)
from kmn_jax.detection._detect import detect, detections, explore
from kmn_jax.detection._device_part import DevicePart, device_part, same_place, symmetry_transforms
from kmn_jax.detection._draw import (
    CropSearchConfig,
    Draw,
    Prediction,
    draw_of_crop,
    matches_of,
    poses_of_draw,
    predict,
    refined,
    surface_scores,
)
from kmn_jax.detection._estimator import PoseEstimator
from kmn_jax.detection._evidence import EVIDENCE, PICTURE_EVIDENCE, gather_evidence
from kmn_jax.detection._export import export_estimator
from kmn_jax.detection._fitting import TREE_SETTINGS, fit_calibration, fit_logistic, load_lightgbm
from kmn_jax.detection._foreground import ForegroundOptions, OrientedBox, foreground
from kmn_jax.detection._frames import into, placed
from kmn_jax.detection._grasps import Conflict, Copy, grasp_conflict, with_grasps
from kmn_jax.detection._kept_parts import prepare_kept
from kmn_jax.detection._mapping import call_rows, map_real, map_rows
from kmn_jax.detection._output import as_json, describe, json_text, table, write_bop_csv
from kmn_jax.detection._picture_agreement import PictureAgreement, picture_agreement
from kmn_jax.detection._picture_cells import PREDICTED_CHANNELS, VERIFIER_SIDE, verifier_cells
from kmn_jax.detection._polish import polish
from kmn_jax.detection._result import CropPrediction, Detection, Detections, Pick, Timing, pose_notes, warnings_once
from kmn_jax.detection._scene import MOST_POINTS, Scene, make_scene
from kmn_jax.detection._search import (
    Candidates,
    SearchConfig,
    candidates_of,
    join,
    network_prediction,
    picture_evidence,
    poses_at,
    search_at,
    seed_crop,
    seed_keys,
)
from kmn_jax.detection._seeds import NUM_SEEDS, seeds_at, seeds_over, spread_seeds
from kmn_jax.detection._selection import Selection, select, select_poses
from kmn_jax.detection._sources import GraspSource, MeshLike, PartSource, ScanSource
from kmn_jax.detection._surroundings import Surroundings, surroundings
from kmn_jax.detection._timing import Clock
from kmn_jax.detection._verification import VERIFIED, verified

__all__ = [
    "COMPANY",
    "EVIDENCE",
    "FAST",
    "MOST_POINTS",
    "NUM_SEEDS",
    "PICTURE_EVIDENCE",
    "PREDICTED_CHANNELS",
    "THOROUGH",
    "TREE_SETTINGS",
    "VERIFIED",
    "VERIFIER_SIDE",
    "BinMargins",
    "BinPoses",
    "BinPosesConfig",
    "Calibration",
    "CalibrationArrays",
    "Candidates",
    "Choice",
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
    "Effort",
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
    "Surroundings",
    "Timing",
    "as_json",
    "averaged",
    "away_from_empty",
    "bin_content",
    "bin_poses",
    "calibration_beside",
    "call_rows",
    "candidates_of",
    "canonical_pose",
    "chance_calibration_error",
    "choose_and_refine",
    "chosen",
    "company",
    "config_of",
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
    "fit_logistic",
    "foreground",
    "gather_evidence",
    "grasp_conflict",
    "in_company",
    "in_front_of_empty",
    "in_unsure_places",
    "inside_bin",
    "into",
    "join",
    "json_text",
    "keeps_order",
    "load_lightgbm",
    "load_probabilities",
    "make_scene",
    "map_real",
    "map_rows",
    "matches_of",
    "near_surface",
    "network_prediction",
    "next_best_rows",
    "picture_agreement",
    "picture_evidence",
    "placed",
    "polish",
    "pose_notes",
    "poses_at",
    "poses_in_crop",
    "poses_of_draw",
    "predict",
    "prepare_kept",
    "probabilities_bytes",
    "refined",
    "refined_candidates",
    "reliability",
    "reported",
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
    "surroundings",
    "symmetry_transforms",
    "table",
    "verified",
    "verifier_cells",
    "warnings_once",
    "with_grasps",
    "write_bop_csv",
]
