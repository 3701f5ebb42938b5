"""From matches to a pose: alignment, consensus search, refinement and the errors they are judged by.

Three functions share the name of their module (`kabsch`, `ransac`, `icp`): as attributes of this package these
names are the functions.
"""

from kmn_jax.pose._accuracy import (
    LEFT_OUT,
    RIGHT,
    THRESHOLDS,
    WRONG,
    average_precision,
    average_recall,
    match_copies,
    symmetric_pose_error,
)
from kmn_jax.pose._icp import IcpConfig, icp, motion_between, plane_step
from kmn_jax.pose._kabsch import kabsch, rotation_is_determined
from kmn_jax.pose._matches import MatchConfig, Matches, find_matches
from kmn_jax.pose._metrics import (
    add,
    adi,
    bounding_box_diagonal,
    diameter,
    discretise_symmetry,
    mssd,
    recall,
)
from kmn_jax.pose._ransac import RansacConfig, ransac, ransac_modes
from kmn_jax.pose._result import PoseResult, PoseStatus
from kmn_jax.pose._rounds import repeat_while
from kmn_jax.pose._surface import SurfaceAgreement, SurfaceConfig, surface_agreement

__all__ = [
    "LEFT_OUT",
    "RIGHT",
    "THRESHOLDS",
    "WRONG",
    "IcpConfig",
    "MatchConfig",
    "Matches",
    "PoseResult",
    "PoseStatus",
    "RansacConfig",
    "SurfaceAgreement",
    "SurfaceConfig",
    "add",
    "adi",
    "average_precision",
    "average_recall",
    "bounding_box_diagonal",
    "diameter",
    "discretise_symmetry",
    "find_matches",
    "icp",
    "kabsch",
    "match_copies",
    "motion_between",
    "mssd",
    "plane_step",
    "ransac",
    "ransac_modes",
    "recall",
    "repeat_while",
    "rotation_is_determined",
    "surface_agreement",
    "symmetric_pose_error",
]
