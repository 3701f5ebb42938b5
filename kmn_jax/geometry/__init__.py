"""Pure functions on points and poses, one example at a time; batching is the caller's `vmap`."""

from kmn_jax.geometry.crop import Selection, radius_crop, voxel_thin
from kmn_jax.geometry.eigen import dominant_eigenvector
from kmn_jax.geometry.knn import k_nearest, largest_distance, nearest, neighbor_graph, squared_distances
from kmn_jax.geometry.normals import depth_normals, depth_to_points, estimate_normals, orient_to_camera
from kmn_jax.geometry.order import space_filling_order
from kmn_jax.geometry.sampling import farthest_point_indices
from kmn_jax.geometry.se3 import (
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
    transform_points,
    translation_between,
)

__all__ = [
    "Selection",
    "compose",
    "depth_normals",
    "depth_to_points",
    "dominant_eigenvector",
    "estimate_normals",
    "farthest_point_indices",
    "from_quaternion_translation",
    "from_rotation_translation",
    "inverse",
    "k_nearest",
    "largest_distance",
    "matrix_to_quaternion",
    "nearest",
    "neighbor_graph",
    "orient_to_camera",
    "pose_error",
    "quaternion_to_matrix",
    "radius_crop",
    "random_pose",
    "random_rotation",
    "rotate_vectors",
    "rotation_angle_between",
    "space_filling_order",
    "squared_distances",
    "transform_points",
    "translation_between",
    "voxel_thin",
]
