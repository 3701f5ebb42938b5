"""Small meshes and scenes whose pictures are known: boxes, planes, spheres, a bin seen from above."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from kmn_jax.geometry import Camera
from kmn_jax.simulate import Bin, BinScene
from kmn_jax.simulate._raycast import bin_triangles

Mesh = tuple[np.ndarray, np.ndarray]
CAMERA = Camera(fx=200.0, fy=190.0, cx=78.3, cy=61.9, width=160, height=120)
WIDE = Camera(fx=500.0, fy=500.0, cx=199.5, cy=149.5, width=400, height=300)
TOP = np.diag([1.0, -1, -1])  # the bin from above: its x to the right, its y upwards in the picture


def box(*extents: float) -> Mesh:
    """Return a box around the origin, wound outwards."""
    vertices = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(extents) / 2
    quads = [(0, 1, 3, 2), (6, 7, 5, 4), (4, 5, 1, 0), (2, 3, 7, 6), (0, 2, 6, 4), (5, 7, 3, 1)]
    return vertices, np.array([[a, *pair] for a, b, c, d in quads for pair in ((b, c), (c, d))], dtype=np.int32)


def bracket() -> Mesh:
    """Return a thick L of about unit diagonal, which hides parts of itself; wound outwards."""
    outline = np.array([[0, 0], [0.8, 0], [0.8, 0.6], [0.65, 0.6], [0.65, 0.15], [0, 0.15]]) - [0.4, 0.2]
    return _prism(outline, [[0, 1, 4], [0, 4, 5], [1, 2, 3], [1, 3, 4]])


def notched_box() -> Mesh:
    """Return a box of about unit diagonal without one of its edges: turned by halves it looks nearly the same."""
    outline = np.array([[0, 0], [0.8, 0], [0.8, 0.4], [0.65, 0.4], [0.65, 0.55], [0, 0.55]]) - [0.4, 0.275]
    return _prism(outline, [[3, 4, 5], [3, 5, 0], [3, 0, 1], [3, 1, 2]])


def tube(radius: float, wall: float, length: float, sides: int = 48) -> Mesh:
    """Return a pipe along z that is open at both ends; wound outwards."""
    angle = np.arange(sides) * 2 * np.pi / sides
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides)])
    half = np.array([0, 0, length / 2])
    # Once around the wall's section: outside below and above, inside above and below.
    rings = [radius * circle - half, radius * circle + half]
    rings += [(radius - wall) * circle + half, (radius - wall) * circle - half]
    here, after = np.arange(sides), (np.arange(sides) + 1) % sides
    quads = [
        (here + i * sides, after + i * sides, after + j * sides, here + j * sides)
        for i, j in zip(range(4), (1, 2, 3, 0), strict=True)
    ]
    faces = [np.column_stack([a, *pair]) for a, b, c, d in quads for pair in ((b, c), (c, d))]
    return np.concatenate(rings), np.concatenate(faces).astype(np.int32)


def _prism(outline: np.ndarray, cap: list[list[int]]) -> Mesh:
    """Return a hexagon in x and z with the triangles of its face, 0.3 thick along y."""
    sides = [np.column_stack([outline[:, 0], np.full(6, y), outline[:, 1]]) for y in (-0.15, 0.15)]
    front = np.array(cap)
    here, after = np.arange(6), (np.arange(6) + 1) % 6
    walls = [np.column_stack([after, here, here + 6]), np.column_stack([after, here + 6, after + 6])]
    return np.concatenate(sides), np.concatenate([front, front[:, ::-1] + 6, *walls]).astype(np.int32)


def square(side: float) -> Mesh:
    """Return a square in the plane z = 0."""
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * side / 2
    return vertices, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def sphere(radius: float, subdivisions: int = 4) -> Mesh:
    """Return a sphere around the origin, of 20 * 4^subdivisions triangles."""
    import trimesh

    made = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.asarray(made.vertices), np.asarray(made.faces, dtype=np.int32)


def surface_points(mesh: Mesh, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return random points on a mesh, spread by area, and the normals of their triangles."""
    rng = np.random.default_rng(seed)
    corners = mesh[0][mesh[1]]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    owner = rng.choice(len(area), count, p=area / area.sum())
    weights = rng.dirichlet([1, 1, 1], count)
    return np.einsum("nc,ncd->nd", weights, corners[owner]), (cross / area[:, None])[owner]


def pose(translation: tuple[float, float, float], rotation: np.ndarray | None = None) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = translation
    if rotation is not None:
        matrix[:3, :3] = rotation
    return matrix


def random_rotations(count: int, seed: int) -> np.ndarray:
    matrices = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))[0]
    return matrices * np.sign(np.linalg.det(matrices))[:, None, None]


def camera_scene(poses: list[np.ndarray], camera: Camera) -> BinScene:
    """Return a scene whose poses are given in the camera frame; its bin is out of sight."""
    return without_bin(BinScene(Bin(1.0, 1.0, 1.0, 0.1), np.array(poses).reshape(-1, 4, 4), camera, np.eye(4)))


def without_bin(scene: BinScene) -> BinScene:
    """Return a scene with its bin behind the camera, where it is neither seen nor hides anything."""
    T_camera_bin = pose((0, 0, -10.0))
    return replace(scene, T_bin_object=np.linalg.inv(T_camera_bin) @ scene.T_camera_object, T_camera_bin=T_camera_bin)


def pile(count: int, camera: Camera, seed: int = 0, height: float = 7.0) -> BinScene:
    """Return copies of an object of about unit size floating at random in a bin seen from above."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = random_rotations(count, seed)
    poses[:, :3, 3] = rng.uniform(-1, 1, (count, 3)) * [1.2, 0.8, 0.3] + [0, 0, 0.8]
    tilt = np.radians(12)
    turned = np.array([[1, 0, 0], [0, -np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), -np.cos(tilt)]])
    return BinScene(Bin(3.4, 2.4, 1.2, 0.05), poses, camera, pose((0, 0, height), turned))


def directions(camera: Camera) -> np.ndarray:
    """Return where the rays through the pixels' centres point, with z = 1."""
    row, column = np.mgrid[: camera.height, : camera.width].astype(float)
    x, y = (column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def plain_scene(mesh: Mesh, scene: BinScene) -> Any:
    """Return one open3d scene that holds every copy and the bin, in the camera frame."""
    import open3d

    caster = open3d.t.geometry.RaycastingScene(nthreads=1)
    bodies = [(*mesh, T) for T in scene.T_camera_object] + [(*bin_triangles(scene.bin), scene.T_camera_bin)]
    for vertices, triangles, T in bodies:
        moved = vertices @ T[:3, :3].T + T[:3, 3]
        caster.add_triangles(moved.astype(np.float32), np.ascontiguousarray(triangles, dtype=np.uint32))
    return caster
