"""Files in: CAD meshes, point clouds and depth images, with their units; and whether their lengths belong together."""

from kmn_jax.io._depth_arrays import CameraMatrix, depth_array_scan
from kmn_jax.io._images import ImageHeader, image_header, read_image
from kmn_jax.io._meshes import CLOUD_SUFFIXES, MESH_SUFFIXES, check_triangles, read_file, read_mesh
from kmn_jax.io._origin import FAR, far_origin, held, object_origin
from kmn_jax.io._poses import in_other_unit, pose_matrix, pose_of, read_pose
from kmn_jax.io._scale import (
    SceneSize,
    UnitWords,
    camera_question,
    length_doubt,
    length_problem,
    object_doubt,
    resolve_unit,
    scene_size,
    size_question,
)
from kmn_jax.io._scans import DepthCamera, Scan, depth_scan, read_scan
from kmn_jax.io._stated import stated_unit

__all__ = [
    "CLOUD_SUFFIXES",
    "FAR",
    "MESH_SUFFIXES",
    "CameraMatrix",
    "DepthCamera",
    "ImageHeader",
    "Scan",
    "SceneSize",
    "UnitWords",
    "camera_question",
    "check_triangles",
    "depth_array_scan",
    "depth_scan",
    "far_origin",
    "held",
    "image_header",
    "in_other_unit",
    "length_doubt",
    "length_problem",
    "object_doubt",
    "object_origin",
    "pose_matrix",
    "pose_of",
    "read_file",
    "read_image",
    "read_mesh",
    "read_pose",
    "read_scan",
    "resolve_unit",
    "scene_size",
    "size_question",
    "stated_unit",
]
