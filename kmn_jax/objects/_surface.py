"""The outer surface of a mesh: what can be seen from outside, with normals that point there.

CAD models hide faces inside and wind them as they like. From sample points on both sides of each triangle, rays are
cast into the half-space of that side; the side from which some reach infinity is the outer one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from kmn_jax.errors import InputError

_RAYS_PER_SIDE = 64
_MIN_ESCAPES = 2  # of 64: a ray may slip through the hairline gaps between faces, two hardly do
_LIFT = 1e-4  # of the diagonal: the rays' starting height, above float32 rounding, below any real step
_MAX_TRIANGLES = 100_000  # meshes above it are simplified first
_CLUSTERS = 200  # along the diagonal, when simplifying; finer ones leave too many triangles


@dataclass(frozen=True, eq=False)
class OuterSurface:
    """Visible triangles wound outwards, and evenly spread visible points on them. Frame and unit of the mesh."""

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    area: float  # that can be seen
    hidden_share: float  # of the mesh's area that cannot


def outer_surface(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], num_points: int, random_seed: int = 0
) -> OuterSurface:
    """Return the part of a mesh that is visible from outside, and `num_points` Poisson-disk points on it.

    Meshes need not be watertight; on an open sheet, seen from both sides, the given winding says which side is
    outer. The same input and random seed give the same bits. Above 100,000 triangles the mesh is simplified first,
    which moves the surface by about 0.1% of its diagonal, and edges by 0.2%, so that time stays bounded.
    Raises InputError if there is no area to see.
    """
    simplified = len(triangles) > _MAX_TRIANGLES
    if simplified:
        vertices, triangles = _simplify(vertices, triangles)
    vertices, triangles = _without_degenerate(vertices, triangles)
    corners = vertices[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled_area = np.linalg.norm(cross, axis=1)
    directions = cross / doubled_area[:, None]
    escapes = RayScene(vertices, triangles).escapes
    generator = np.random.default_rng(random_seed)
    samples, visible = [], 0
    for _ in range(6):  # hidden area costs more rounds; what is nearly all hidden is not a part
        owner = generator.choice(len(triangles), size=5 * num_points, p=doubled_area / doubled_area.sum())
        point = _on_triangles(generator, corners[owner])
        samples.append((owner, point, escapes(point, directions[owner])))
        visible += int((samples[-1][2].max(axis=1) >= _MIN_ESCAPES).sum())
        if visible >= 4 * num_points:
            break
    owner, point, count = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    seen = count.max(axis=1) >= _MIN_ESCAPES
    if seen.sum() < num_points:
        raise InputError(
            f"only {seen.mean():.0%} of the mesh can be seen from outside: that is not an object's surface"
        )

    total = np.zeros((len(triangles), 2), np.int64)
    np.add.at(total, owner, count)
    unsampled = np.bincount(owner, minlength=len(triangles)) == 0
    # Nearly all triangles of a simplified mesh are small and have no sample: fewer rays have to do for them.
    rays, enough = (_RAYS_PER_SIDE // 4, 1) if simplified else (_RAYS_PER_SIDE, _MIN_ESCAPES)
    total[unsampled] = escapes(corners[unsampled].mean(axis=1), directions[unsampled], rays)
    best = np.zeros(len(triangles), np.int64)
    np.maximum.at(best, owner, count.max(axis=1))
    kept = best >= _MIN_ESCAPES
    kept[unsampled] = total[unsampled].max(axis=1, initial=0) >= enough
    # Within a quarter both sides see as much: an open sheet, whose own winding then counts.
    inverted = total[:, 1] > 1.25 * total[:, 0]
    oriented = np.where(inverted[:, None], triangles[:, ::-1], triangles)
    used, renumbered = np.unique(oriented[kept], return_inverse=True)
    signs = np.where(inverted[owner], -1.0, 1.0)
    chosen = _poisson_disk(vertices, triangles, point[seen], num_points)
    return OuterSurface(
        vertices=vertices[used],
        triangles=renumbered.reshape(-1, 3).astype(np.int32),
        points=point[seen][chosen].astype(np.float32),
        normals=(directions[owner] * signs[:, None])[seen][chosen].astype(np.float32),
        area=float(doubled_area.sum() / 2 * seen.mean()),
        hidden_share=float(1 - seen.mean()),
    )


class RayScene:
    """A mesh to cast rays at. It is traced in float32: centred and scaled, whose digits then go to the shape."""

    def __init__(self, vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> None:
        import open3d

        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self.center, self.size = (low + high) / 2, float(np.linalg.norm(high - low))
        self.scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self.scene.add_triangles(self._local(vertices), triangles.astype(np.uint32))

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return the distances of points from the mesh."""
        return self.size * self.scene.compute_distance(self._local(points)).numpy()

    def escapes(
        self, points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"], count: int = _RAYS_PER_SIDE
    ) -> Int[np.ndarray, "n 2"]:
        """Count, for points on the mesh and both of its sides, the rays that reach infinity."""
        starts, result = self._local(points), np.zeros((len(points), 2), np.int64)
        for side, sign in enumerate((1.0, -1.0)):
            normals = (sign * directions).astype(np.float32)
            for start in range(0, len(points), 8192):
                rows = slice(start, start + 8192)
                rays = np.empty((len(starts[rows]), count, 6), np.float32)
                rays[..., :3] = (starts[rows] + _LIFT * normals[rows])[:, None]
                rays[..., 3:] = _hemisphere(normals[rows], count)
                result[rows, side] = (~self.scene.test_occlusions(rays).numpy()).sum(axis=1)
        return result

    def _local(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return ((points - self.center) / self.size).astype(np.float32)


def _hemisphere(normals: Float[np.ndarray, "n 3"], count: int) -> Float[np.ndarray, "n r 3"]:
    """Return evenly spread directions around each normal: a Fibonacci hemisphere, mirrored into its half-space."""
    index = np.arange(count) + 0.5
    # From 10 degrees above the surface's plane upwards: flatter rays only graze the face itself.
    height = 1 - (1 - np.sin(np.radians(10))) * index / count
    angle, radius = np.pi * (1 + 5**0.5) * index, np.sqrt(1 - height**2)
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1).astype(np.float32)
    axis = np.where(np.abs(normals[:, 2:]) < 0.9, np.array([[0, 0, 1]], np.float32), np.array([[1, 0, 0]], np.float32))
    first = np.cross(axis, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    return (
        local[:, 0, None] * first[:, None] + local[:, 1, None] * second[:, None] + local[:, 2, None] * normals[:, None]
    )


def _without_degenerate(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "s 3"]]:
    corners = vertices[triangles]
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], corners[:, 2] - corners[:, 1]], 1)
    longest = np.linalg.norm(edges, axis=2).max(axis=1, initial=0.0)
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    real: Bool[np.ndarray, " t"] = area > 1e-9 * np.maximum(longest, np.finfo(float).tiny) ** 2
    kept = triangles[real]
    if len(kept) < 2:
        raise InputError(
            f"the mesh has {len(kept)} triangles with an area (of {len(triangles)}): an object's surface needs more"
        )
    used, renumbered = np.unique(kept, return_inverse=True)
    return vertices[used].astype(np.float64), renumbered.reshape(-1, 3).astype(np.int32)


def _simplify(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "s 3"]]:
    import open3d

    diagonal = float(np.linalg.norm(np.ptp(vertices[triangles.reshape(-1)], axis=0)))
    if not diagonal > 0:
        return vertices, triangles
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(triangles)
    )
    if len(triangles) > 2 * _MAX_TRIANGLES:  # the better method would take too long on millions
        mesh = mesh.simplify_vertex_clustering(diagonal / _CLUSTERS)
    else:
        mesh = mesh.remove_duplicated_vertices()  # files without shared vertices would come apart
    if len(mesh.triangles) > _MAX_TRIANGLES:
        mesh = mesh.simplify_quadric_decimation(_MAX_TRIANGLES)
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


def _on_triangles(generator: np.random.Generator, corners: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    first, second = generator.random((2, len(corners), 1))
    over = first + second > 1
    first, second = np.where(over, 1 - first, first), np.where(over, 1 - second, second)
    return corners[:, 0] + first * (corners[:, 1] - corners[:, 0]) + second * (corners[:, 2] - corners[:, 0])


def _poisson_disk(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], points: Float[np.ndarray, "n 3"], count: int
) -> Int[np.ndarray, " count"]:
    """Return the rows of `count` points that keep their distance from each other (Open3D's sample elimination)."""
    import open3d

    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(triangles)
    )
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    # The colours carry the row numbers through the elimination.
    rows = np.repeat(np.arange(len(points), dtype=np.float64)[:, None], 3, axis=1)
    cloud.colors = open3d.utility.Vector3dVector(rows)
    chosen = mesh.sample_points_poisson_disk(count, pcl=cloud)
    return np.asarray(chosen.colors)[:, 0].astype(np.int64)
