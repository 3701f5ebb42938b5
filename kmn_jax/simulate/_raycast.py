"""Exact renderings of a bin by ray casting: depth, instances, normals, silhouettes, and which surfels are visible.

Every copy is cast on its own, in the object's frame and only where it can be, and the nearest hit wins. So one search
tree serves all copies of all scenes, the silhouettes cost nothing extra, and float32 holds coordinates near the origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from kmn_jax.errors import InputError, rigid_pose
from kmn_jax.geometry import Camera
from kmn_jax.simulate._bin_scene import Bin, BinScene
from kmn_jax.simulate._hulls import triangle_corners

# Int16 coordinates put a surfel up to 1.3e-5 diagonals off its surface, float32 a ray's hit up to 1e-5 at 20 diagonals:
# ten times that, and still less than any step of a part that a camera resolves.
LIFT = 2e-4  # of the diagonal: what is nearer than that to a point's own plane does not hide it


class RayMesh:
    """A surface made ready for ray casting, in its own frame and unit: make one per object, use it for all scenes.

    The winding does not matter. Raises InputError for a mesh without triangles, extent or finite vertices.
    """

    def __init__(self, vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> None:
        import open3d

        corners = triangle_corners(vertices, triangles).reshape(-1, 3)
        self.minimum: Float[np.ndarray, "3"] = corners.min(axis=0)
        self.maximum: Float[np.ndarray, "3"] = corners.max(axis=0)
        self.center: Float[np.ndarray, "3"] = (self.minimum + self.maximum) / 2
        self.diagonal = float(np.linalg.norm(self.maximum - self.minimum))
        if not self.diagonal > 0:
            raise InputError("all vertices of the mesh coincide: it has no surface")
        self.radius = float(np.linalg.norm(corners - self.center, axis=1).max())
        self._rays = open3d.t.geometry.RaycastingScene(nthreads=1)
        self._rays.add_triangles(
            ((vertices - self.center) / self.diagonal).astype(np.float32), triangles.astype(np.uint32)
        )

    def cast(
        self,
        T_camera_object: Float[np.ndarray, "4 4"],
        columns: Float[np.ndarray, " w"],
        rows: Float[np.ndarray, " h"],
    ) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w 3"]]:
        """Return depth (infinite where nothing is hit) and normals in the object's frame, of any sign, for a window.

        The ray of column x and row y runs from the camera in the direction (x, y, 1), so its length is the depth.
        """
        local, origin = self._from_camera(T_camera_object)
        rays = np.empty((len(rows), len(columns), 6), np.float32)
        rays[..., :3] = origin
        across, down = columns[:, None] * local[:, 0], rows[:, None] * local[:, 1] + local[:, 2]
        np.add(across[None], down[:, None], out=rays[..., 3:], casting="same_kind")
        hits = self._rays.cast_rays(rays, nthreads=1)
        return hits["t_hit"].numpy(), hits["primitive_normals"].numpy()

    def blocks(
        self,
        T_camera_object: Float[np.ndarray, "4 4"],
        points: Float[np.ndarray, "k 3"],
        eye: Float[np.ndarray, "3"],
    ) -> Bool[np.ndarray, " k"]:
        """Tell for points in the camera frame whether the surface lies between them and the eye."""
        local, origin = self._from_camera(T_camera_object)
        rays = np.empty((len(points), 6), np.float32)
        rays[:, :3] = origin + local @ eye
        rays[:, 3:] = (points - eye) @ local.T
        return self._rays.test_occlusions(rays, tnear=0.0, tfar=1.0, nthreads=1).numpy()

    def _from_camera(
        self, T_camera_object: Float[np.ndarray, "4 4"]
    ) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
        """Return the linear part and the offset of the map from the camera's frame to centred, scaled coordinates."""
        T_object_camera = np.linalg.inv(T_camera_object.astype(np.float64))
        return T_object_camera[:3, :3] / self.diagonal, (T_object_camera[:3, 3] - self.center) / self.diagonal


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a camera sees of a scene, in the scene's unit and the camera's frame.

    `depth` is z along the optical axis, 0 where nothing was hit; `instances` holds the number of the copy, n for the
    bin and other fixtures, -1 for nothing; `normals` are those of the triangles, pointing to the camera, zero for
    nothing. `total_pixels` counts each copy's silhouette without anything else, and `total_boxes` bounds it (left, top,
    width, height; -1 where it is empty). As in BOP, it reaches beyond the picture, by up to the picture's size on each
    side.
    """

    depth: Float[np.ndarray, "h w"]
    instances: Int[np.ndarray, "h w"]
    normals: Float[np.ndarray, "h w 3"]
    visible_pixels: Int[np.ndarray, " n"]
    total_pixels: Int[np.ndarray, " n"]
    total_boxes: Int[np.ndarray, "n 4"]

    @property
    def visible_fraction(self) -> Float[np.ndarray, " n"]:
        """The visible share of each copy's silhouette, 0 where it has none."""
        return self.visible_pixels / np.maximum(self.total_pixels, 1)


def bin_triangles(bin: Bin) -> tuple[Float[np.ndarray, "16 3"], Int[np.ndarray, "28 3"]]:
    """Return vertices and triangles, wound outwards, of a bin with flat rims; the floor's upper side is at z = 0."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    inner = corners * [bin.length, bin.width]
    outer = corners * [bin.length + 2 * bin.thickness, bin.width + 2 * bin.thickness]
    rings = [(outer, -bin.thickness), (outer, bin.height), (inner, bin.height), (inner, 0.0)]
    vertices = np.concatenate([np.column_stack([ring, np.full(4, height)]) for ring, height in rings])
    # Four strips of quads join ring to ring, from the underside's edge over the rim down to the floor.
    here = np.arange(4)
    after = (here + 1) % 4
    quads = [np.column_stack([low + here, low + after, low + 4 + after, low + 4 + here]) for low in (0, 4, 8)]
    quads += [np.array([[12, 13, 14, 15]]), np.array([[3, 2, 1, 0]])]
    faces = np.concatenate(quads)
    return vertices, np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]]).astype(np.int32)


def render(mesh: RayMesh, scene: BinScene) -> Rendering:
    """Render the copies of an object and the bin from the scene's camera; the same input gives the same bits.

    Raises InputError for poses that are not rigid or not finite, and for a camera below the bin's floor.
    """
    _check_scene(scene)
    camera, poses = scene.camera, scene.T_camera_object
    width, height, total = camera.width, camera.height, len(poses)
    depth = np.full((height, width), np.inf, np.float32)
    instances = np.full((height, width), -1, np.int32)
    normals = np.zeros((height, width, 3), np.float32)
    counts, boxes = np.zeros(total, np.int32), np.full((total, 4), -1, np.int32)
    bodies = [*((mesh, pose) for pose in poses), *_fixtures(scene)]
    for number, (body, pose) in enumerate(bodies):
        left, top, right, bottom = _window(body, pose, camera)
        if left >= right or top >= bottom:
            continue
        columns = (np.arange(left, right) - camera.cx) / camera.fx
        rows = (np.arange(top, bottom) - camera.cy) / camera.fy
        found, directions = body.cast(pose, columns, rows)
        if number < total:
            hit = np.isfinite(found)
            counts[number] = np.count_nonzero(hit)
            if counts[number]:
                across, down = np.flatnonzero(hit.any(axis=0)), np.flatnonzero(hit.any(axis=1))
                boxes[number] = (left + across[0], top + down[0], np.ptp(across) + 1, np.ptp(down) + 1)
        first, last = np.clip([[left, top], [right, bottom]], 0, [[width, height]])
        picture = np.s_[first[1] : last[1], first[0] : last[0]]
        inside = np.s_[first[1] - top : last[1] - top, first[0] - left : last[0] - left]
        nearer = found[inside] < depth[picture]
        depth[picture][nearer] = found[inside][nearer]
        instances[picture][nearer] = min(number, total)
        normals[picture][nearer] = directions[inside][nearer] @ pose[:3, :3].T.astype(np.float32)
    columns = ((np.arange(width) - camera.cx) / camera.fx).astype(np.float32)
    rows = ((np.arange(height) - camera.cy) / camera.fy).astype(np.float32)
    away = normals[..., 0] * columns[None] + normals[..., 1] * rows[:, None] + normals[..., 2] > 0
    normals[away] *= -1
    depth[instances < 0] = 0
    return Rendering(
        depth=depth,
        instances=instances,
        normals=normals,
        visible_pixels=np.bincount(instances.ravel() + 1, minlength=total + 2)[1 : total + 1].astype(np.int32),
        total_pixels=counts,
        total_boxes=boxes,
    )


def visible_surfels(
    mesh: RayMesh, scene: BinScene, points: Float[np.ndarray, "m 3"], normals: Float[np.ndarray, "m 3"]
) -> Bool[np.ndarray, "n m"]:
    """Tell for each copy which of its surfels the camera sees: facing it, in the picture, and with nothing before it.

    Points and outward normals are in the object's frame. Raises InputError as `render` does, and for points or normals
    that are not finite.
    """
    _check_scene(scene)
    return _visible(mesh, scene, scene.T_camera_object, points, normals)


def visible_bin_surfels(
    mesh: RayMesh, scene: BinScene, points: Float[np.ndarray, "m 3"], normals: Float[np.ndarray, "m 3"]
) -> Bool[np.ndarray, " m"]:
    """Tell which surfels of the bin, given in its frame, the camera sees; otherwise as `visible_surfels`."""
    _check_scene(scene)
    return _visible(mesh, scene, scene.T_camera_bin[None], points, normals)[0]


def pack_bits(visible: Bool[np.ndarray, "*n m"]) -> UInt8[np.ndarray, "*n b"]:
    """Return eight flags a byte, the first in the lowest bit; the last byte of a row is filled with zeros."""
    return np.packbits(visible, axis=-1, bitorder="little")


def hidden_from(
    mesh: RayMesh,
    scene: BinScene,
    points: Float[np.ndarray, "k 3"],
    normals: Float[np.ndarray, "k 3"],
    eye: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, " k"]:
    """Tell which points on surfaces an eye cannot see, all in the camera frame: turned away, or something is between.

    What is less than `LIFT` diagonals above a point's own plane, on the way to the eye, is not between: so rounding, of
    rays and of the points themselves, hides none behind its own surface, however slanted. The scene is one that
    `render` takes, and all numbers are finite.
    """
    rays = points.astype(np.float64) - eye
    slope = -np.einsum("kc,kc->k", rays, normals)
    hidden = slope <= 0
    facing = ~hidden
    shortened = np.maximum(slope[facing] - LIFT * mesh.diagonal, 0) / slope[facing]
    hidden[facing] = _blocked(mesh, scene, eye + shortened[:, None] * rays[facing], eye)
    return hidden


def _visible(
    mesh: RayMesh,
    scene: BinScene,
    poses: Float[np.ndarray, "n 4 4"],
    points: Float[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "m 3"],
) -> Bool[np.ndarray, "n m"]:
    if not np.isfinite(points).all() or not np.isfinite(normals).all():
        raise InputError("the points or normals hold NaN or infinite values: remove such points first")
    camera = scene.camera
    at = points.astype(np.float64) @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    out = normals.astype(np.float64) @ poses[:, :3, :3].transpose(0, 2, 1)
    x, y, z = np.moveaxis(at, -1, 0)
    # A pixel is the square around its centre; multiplying by z spares the division by zero.
    seen = z > 0
    seen &= (camera.fx * x >= (-0.5 - camera.cx) * z) & (camera.fx * x < (camera.width - 0.5 - camera.cx) * z)
    seen &= (camera.fy * y >= (-0.5 - camera.cy) * z) & (camera.fy * y < (camera.height - 0.5 - camera.cy) * z)
    seen[seen] = ~hidden_from(mesh, scene, at[seen], out[seen], np.zeros(3))
    return seen


def _blocked(
    mesh: RayMesh, scene: BinScene, points: Float[np.ndarray, "k 3"], eye: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, " k"]:
    hidden: Bool[np.ndarray, " k"] = np.zeros(len(points), dtype=bool)
    for fixture, pose in _fixtures(scene):
        hidden |= fixture.blocks(pose, points, eye)
    poses = scene.T_camera_object
    rays = points - eye
    distances = np.linalg.norm(rays, axis=1)
    directions = (rays / np.maximum(distances, np.finfo(float).tiny)[:, None]).astype(np.float32)
    centers = poses[:, :3, :3] @ mesh.center + poses[:, :3, 3] - eye
    ranges = np.linalg.norm(centers, axis=1)
    # Only rays within the cone around a copy's bounding sphere, and beyond its near side, can meet it.
    sine = np.minimum(mesh.radius / np.maximum(ranges, np.finfo(float).tiny), 1)
    cosine = np.where(sine < 1, np.sqrt(1 - sine**2) - 1e-5, -2)
    along = directions @ (centers / np.maximum(ranges, np.finfo(float).tiny)[:, None]).T.astype(np.float32)
    for number in np.argsort(ranges, kind="stable"):
        near = (along[:, number] >= cosine[number]) & (distances >= (1 - 1e-5) * (ranges[number] - mesh.radius))
        tested = np.flatnonzero(near & ~hidden)
        hidden[tested] = mesh.blocks(poses[number], points[tested], eye)
    return hidden


def _fixtures(scene: BinScene) -> list[tuple[RayMesh, Float[np.ndarray, "4 4"]]]:
    """Return what is there beside the copies, with poses in the camera's frame."""
    if scene.fixtures is None:
        return [(RayMesh(*bin_triangles(scene.bin)), scene.T_camera_bin)]
    return [
        (mesh, scene.T_camera_bin @ pose)
        for fixture in scene.fixtures
        for mesh in [RayMesh(fixture.vertices, fixture.triangles)]
        for pose in fixture.T_bin_fixture
    ]


def _window(body: RayMesh, pose: Float[np.ndarray, "4 4"], camera: Camera) -> tuple[int, int, int, int]:
    """Return the rectangle (left, top, right, bottom; the last two exclusive) outside of which no ray can hit."""
    picks = np.array([[i >> axis & 1 for axis in range(3)] for i in range(8)], dtype=bool)
    corners = np.where(picks, body.maximum, body.minimum) @ pose[:3, :3].T + pose[:3, 3]
    x, y, z = corners.T
    width, height = camera.width, camera.height
    if (z <= 0).all():
        return 0, 0, 0, 0
    if (z <= 1e-6 * body.diagonal).any():  # beside or around the camera: it may be anywhere
        return -width, -height, 2 * width, 2 * height
    column = np.clip(camera.fx * x / z + camera.cx, -width, 2 * width - 1)
    row = np.clip(camera.fy * y / z + camera.cy, -height, 2 * height - 1)
    low, high = np.floor([column.min(), row.min()]), np.ceil([column.max(), row.max()]) + 1
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _check_scene(scene: BinScene) -> None:
    rigid_pose(scene.T_camera_bin, "T_camera_bin")
    for number, pose in enumerate(scene.T_bin_object):
        rigid_pose(pose, f"T_bin_object[{number}]")
    height = float(np.linalg.inv(scene.T_camera_bin)[2, 3])
    if height <= 0:
        raise InputError(f"the camera is {-height:g} below the bin's floor: it sees nothing but its underside")
