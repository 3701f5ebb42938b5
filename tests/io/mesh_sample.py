"""Whole mesh and cloud files of every format, each written by other libraries than the ones that read them."""

from pathlib import Path

import numpy as np
import open3d
import trimesh

STEP = (Path(__file__).parent / "files" / "box.step").read_bytes()  # 20 x 10 x 5 mm
BOX = trimesh.creation.box((20, 10, 5), transform=trimesh.transformations.translation_matrix((1, 2, 3)))
POINTS = np.random.default_rng(0).normal(size=(30, 3)).round(4).astype(np.float32)  # some writers have six digits
NORMALS = (POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)).astype(np.float32)
POLYGONS_PLY = """ply
format ascii 1.0
comment a quad and a triangle over five vertices, in the house of \u00c5ngstr\u00f6m
obj_info nothing
element vertex 5
property uchar red
property double x
property double y
property double z
element edge 1
property int vertex1
property int vertex2
element face 2
property list uchar int vertex_indices
property uchar material
end_header
9 0 0 0
9 1 0 0
9 1 1 0
9 0 1 0
9 0 0 1.5
0 1
4 0 1 2 3 7
3 0 1 4 8
"""


def mesh_bytes(suffix, **options):
    return BOX.export(file_type=suffix, **options)


def cloud_bytes(folder, suffix, normals=True, **options):
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(POINTS.astype(np.float64)))
    if normals:
        cloud.normals = open3d.utility.Vector3dVector(NORMALS.astype(np.float64))
    path = folder / f"written{suffix}"
    assert open3d.io.write_point_cloud(str(path), cloud, **options)
    return path.read_bytes()


def encoded(text):
    return text.encode() if isinstance(text, str) else text


MESHES = ["binary.stl", "text.stl", "mesh.obj", "binary.ply", "text.ply", "mesh.glb", "solid.step"]
CLOUDS = [
    "binary_cloud.ply",
    "text_cloud.ply",
    "binary.pcd",
    "text.pcd",
    "compressed.pcd",
    "cloud.xyz",
    "cloud.xyzn",
]


def whole_files(folder):
    """Return the contents of whole files by name."""
    return {
        "binary.stl": mesh_bytes("stl"),
        "text.stl": encoded(mesh_bytes("stl_ascii")),
        "mesh.obj": encoded(mesh_bytes("obj")),
        "binary.ply": mesh_bytes("ply"),
        "text.ply": encoded(mesh_bytes("ply", encoding="ascii")),
        "mesh.glb": mesh_bytes("glb"),
        "solid.step": STEP,
        "binary_cloud.ply": cloud_bytes(folder, ".ply"),
        "text_cloud.ply": cloud_bytes(folder, ".ply", write_ascii=True),
        "binary.pcd": cloud_bytes(folder, ".pcd"),
        "text.pcd": cloud_bytes(folder, ".pcd", write_ascii=True),
        "compressed.pcd": cloud_bytes(folder, ".pcd", compressed=True),
        "cloud.xyz": cloud_bytes(folder, ".xyz"),
        "cloud.xyzn": cloud_bytes(folder, ".xyzn"),
    }


def written(folder, name, content):
    path = folder / name
    path.write_bytes(encoded(content))
    return path
