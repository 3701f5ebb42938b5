"""Pure functions on points, poses and cameras, one example at a time; batching is the caller's `vmap`."""

from kmn_jax.geometry._ball_normals import normals_within_radius
from kmn_jax.geometry._camera import Camera, Intrinsics, intrinsics, measured_points
from kmn_jax.geometry._crops import Crop, PaddedCloud, crop_around, draw_rows, even_rows, pad_cloud, spread_rows
from kmn_jax.geometry._eigen import dominant_eigenvector
from kmn_jax.geometry._groups import PointGroups, group_points, nearest_within
from kmn_jax.geometry._knn import (
    first_smallest,
    k_nearest,
    largest_distance,
    nearest,
    neighbor_graph,
    squared_distances,
)
from kmn_jax.geometry._linear import solve_symmetric
from kmn_jax.geometry._normals import depth_normals, depth_to_points, estimate_normals, orient_to_camera
from kmn_jax.geometry._order import space_filling_order
from kmn_jax.geometry._sampling import farthest_point_indices
from kmn_jax.geometry._se3 import (
    compose,
    from_quaternion_translation,
    from_rotation_translation,
    inverse,
    matrix_to_quaternion,
    pose_error,
    quaternion_to_matrix,
    random_pose,
    random_rotation,
    rotate_vectors,
    rotation_angle_between,
    safe_norm,
    safe_sqrt,
    transform_points,
)
from kmn_jax.geometry._selection import ask_for_fast_selection, largest, smallest_at
from kmn_jax.geometry._smoothing import SmoothConfig, smoothed, with_normals

__all__ = [
    "Camera",
    "Crop",
    "Intrinsics",
    "PaddedCloud",
    "PointGroups",
    "SmoothConfig",
    "ask_for_fast_selection",
    "compose",
    "crop_around",
    "depth_normals",
    "depth_to_points",
    "dominant_eigenvector",
    "draw_rows",
    "estimate_normals",
    "even_rows",
    "farthest_point_indices",
    "first_smallest",
    "from_quaternion_translation",
    "from_rotation_translation",
    "group_points",
    "intrinsics",
    "inverse",
    "k_nearest",
    "largest",
    "largest_distance",
    "matrix_to_quaternion",
    "measured_points",
    "nearest",
    "nearest_within",
    "neighbor_graph",
    "normals_within_radius",
    "orient_to_camera",
    "pad_cloud",
    "pose_error",
    "quaternion_to_matrix",
    "random_pose",
    "random_rotation",
    "rotate_vectors",
    "rotation_angle_between",
    "safe_norm",
    "safe_sqrt",
    "smallest_at",
    "smoothed",
    "solve_symmetric",
    "space_filling_order",
    "spread_rows",
    "squared_distances",
    "transform_points",
    "with_normals",
]
