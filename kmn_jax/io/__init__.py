"""Files in: CAD meshes, point clouds and depth images, with their units; and whether their lengths belong together."""

from kmn_jax.io._images import ImageHeader, image_header, read_image
from kmn_jax.io._meshes import MESH_SUFFIXES, check_triangles, read_file, read_mesh
from kmn_jax.io._origin import FAR, far_origin, held, object_origin
from kmn_jax.io._scale import length_doubt, length_problem, resolve_unit, scene_size
from kmn_jax.io._scans import DepthCamera, Scan, depth_scan, read_scan

__all__ = [
    "FAR",
    "MESH_SUFFIXES",
    "DepthCamera",
    "ImageHeader",
    "Scan",
    "check_triangles",
    "depth_scan",
    "far_origin",
    "held",
    "image_header",
    "length_doubt",
    "length_problem",
    "object_origin",
    "read_file",
    "read_image",
    "read_mesh",
    "read_scan",
    "resolve_unit",
    "scene_size",
]
