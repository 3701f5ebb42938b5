"""From a scan to the ranked poses of an object's copies."""

from kmn_jax.detection._background import bin_content
from kmn_jax.detection._bin_poses import BinPosesConfig, bin_part, bin_poses
from kmn_jax.detection._calibrate import (
    Calibration,
    Probabilities,
    expected_calibration_error,
    fit_calibration,
    load_probabilities,
    probabilities_bytes,
    reliability,
)
from kmn_jax.detection._candidates import (
    CandidateConfig,
    Candidates,
    Seeds,
    Solver,
    find_candidates,
    improved,
    seeds_over,
)
from kmn_jax.detection._crop_pose import (
    CropPoseConfig,
    Said,
    crop_for_draws,
    crop_pose,
    draw_of_crop,
    matches_of,
    poses_of_draw,
    refined,
    said_of_draw,
    search_draws,
    surface_scores,
)
from kmn_jax.detection._detect import THOROUGH, DetectConfig, detect
from kmn_jax.detection._estimator import PoseEstimator
from kmn_jax.detection._evidence import EVIDENCE, SIGNS, Sight
from kmn_jax.detection._export import export_estimator
from kmn_jax.detection._foreground import ForegroundOptions, foreground
from kmn_jax.detection._frames import into, placed
from kmn_jax.detection._output import as_json, table, write_bop_csv, write_json
from kmn_jax.detection._result import CropPrediction, Detection, Detections
from kmn_jax.detection._scan_crop import SceneArrays, first_crop, padded_points
from kmn_jax.detection._scene import Scene, make_scene
from kmn_jax.detection._search import (
    CropFeatures,
    Hypotheses,
    Predictions,
    SearchConfig,
    crop_features,
    search,
    seed_keys,
    spread_seeds,
)
from kmn_jax.detection._select import SelectConfig, select, symmetry_transforms
from kmn_jax.detection._timing import Clock
from kmn_jax.detection._view import View, view_of

__all__ = [
    "EVIDENCE",
    "SIGNS",
    "THOROUGH",
    "BinPosesConfig",
    "Calibration",
    "CandidateConfig",
    "Candidates",
    "Clock",
    "CropFeatures",
    "CropPoseConfig",
    "CropPrediction",
    "DetectConfig",
    "Detection",
    "Detections",
    "ForegroundOptions",
    "Hypotheses",
    "PoseEstimator",
    "Predictions",
    "Probabilities",
    "Said",
    "Scene",
    "SceneArrays",
    "SearchConfig",
    "Seeds",
    "SelectConfig",
    "Sight",
    "Solver",
    "View",
    "as_json",
    "bin_content",
    "bin_part",
    "bin_poses",
    "crop_features",
    "crop_for_draws",
    "crop_pose",
    "detect",
    "draw_of_crop",
    "expected_calibration_error",
    "export_estimator",
    "find_candidates",
    "first_crop",
    "fit_calibration",
    "foreground",
    "improved",
    "into",
    "load_probabilities",
    "make_scene",
    "matches_of",
    "padded_points",
    "placed",
    "poses_of_draw",
    "probabilities_bytes",
    "refined",
    "reliability",
    "said_of_draw",
    "search",
    "search_draws",
    "seed_keys",
    "seeds_over",
    "select",
    "spread_seeds",
    "surface_scores",
    "symmetry_transforms",
    "table",
    "view_of",
    "write_bop_csv",
    "write_json",
]
