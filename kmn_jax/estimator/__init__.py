"""From a CAD model and a scan to the ranked poses of a whole bin."""

from kmn_jax.estimator.detect import DetectConfig
from kmn_jax.estimator.estimator import PoseEstimator
from kmn_jax.estimator.output import as_json, table, write_bop_csv, write_json
from kmn_jax.estimator.part import Part, load_part, save_part
from kmn_jax.estimator.result import Detection, Detections
from kmn_jax.estimator.scene import Scene

__all__ = [
    "DetectConfig",
    "Detection",
    "Detections",
    "Part",
    "PoseEstimator",
    "Scene",
    "as_json",
    "load_part",
    "save_part",
    "table",
    "write_bop_csv",
    "write_json",
]
