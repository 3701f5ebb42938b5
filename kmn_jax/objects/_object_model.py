"""Object models: from a mesh file or a cloud to everything that the rest needs to know of an object."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import DTypeLike

from kmn_jax.errors import InputError
from kmn_jax.io import check_triangles, far_origin, object_origin, read_mesh
from kmn_jax.objects._surface import OuterSurface, RayScene, outer_surface
from kmn_jax.objects._symmetry import Distance, Symmetries, find_symmetries
from kmn_jax.units import METRES, check_unit

_MAX_HULL = 3000  # vertices whose distances are all taken
_MAX_CLOUD = 40_000  # points from which normals are estimated: dense enough for edges, sparse enough for noise


@dataclass(frozen=True)
class ObjectConfig:
    """How an object model is made."""

    num_points: int = 2048  # Poisson-disk points on the outer surface; 4,096 to 16,384 for training packs
    symmetry_tolerance: float = 0.02  # share of the diameter
    random_seed: int = 0

    def __post_init__(self) -> None:
        if self.num_points < 64:
            raise InputError(f"num_points = {self.num_points} cannot stand for a surface: take 64 or more")
        if not 0 < self.symmetry_tolerance <= 0.2:
            raise InputError(f"symmetry_tolerance = {self.symmetry_tolerance} must be above 0 and at most 0.2")
        if self.random_seed < 0:
            raise InputError(f"random_seed = {self.random_seed} must be 0 or more")


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """A rigid object, in the frame of its file. All lengths are in `unit`.

    `points` are float32, or float64 if the object lies too far from the origin of its frame: see `origin`.
    `vertices` and `triangles` are the outer surface, wound outwards; an object given as a cloud has no triangles.
    `points` are spread evenly over it, with outward unit `normals`, in farthest-point order: any first part of them
    covers the object evenly, and the first K are its keypoints.
    """

    name: str
    unit: str
    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    minimum: Float[np.ndarray, "3"]  # of the axis-aligned box around it
    maximum: Float[np.ndarray, "3"]
    diameter: float  # largest distance between two of its points
    area: float  # of the outer surface
    hidden_share: float  # of the file's area that lies inside and was left out
    symmetries: Symmetries
    digest: str  # SHA-256 of the file, or of the arrays where there was none

    @property
    def extents(self) -> Float[np.ndarray, "3"]:
        """The sides of the axis-aligned box around the object."""
        return self.maximum - self.minimum

    @property
    def origin(self) -> Float[np.ndarray, "3"]:
        """The middle of the object if it lies too far from its frame's origin for float32, else zero."""
        return far_origin(self.minimum, self.maximum)

    def centred(self) -> ObjectModel:
        """Return the same object in a frame with its `origin`."""
        return self if not self.origin.any() else _moved(self, -self.origin, np.float32)

    def near(self) -> ObjectModel:
        """Return the object itself, or raise InputError if it lies too far from its frame's origin for float32."""
        if self.origin.any():
            raise InputError(
                f"{self.name} lies {np.abs(self.origin).max():.3g} {self.unit} from the origin of its frame, too far"
                " for float32: move it there"
            )
        return self

    @property
    def diagonal(self) -> float:
        """The diagonal of that box: the object's size as published results take it."""
        return float(np.linalg.norm(self.extents))

    def in_unit(self, unit: str) -> ObjectModel:
        """Return the same object with its lengths in another unit."""
        factor = METRES[self.unit] / METRES[check_unit(unit)]
        return replace(
            self,
            unit=unit,
            vertices=self.vertices * factor,
            points=(self.points * factor).astype(self.points.dtype),
            minimum=self.minimum * factor,
            maximum=self.maximum * factor,
            diameter=self.diameter * factor,
            area=self.area * factor**2,
            symmetries=replace(self.symmetries, center=self.symmetries.center * factor),
        )


def load_object(path: str | Path, unit: str | None = None, config: ObjectConfig | None = None) -> ObjectModel:
    """Make an object model of a mesh or cloud file; see `read_mesh` for formats and `unit`.

    The same file, config and library versions give the same bits. Raises InputError if the file is broken or holds
    no part's surface.
    """
    path = Path(path)
    mesh = read_mesh(path, unit)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    try:
        if len(mesh.triangles):
            return object_from_mesh(path.stem, mesh.vertices, mesh.triangles, mesh.unit, config, digest)
        return object_from_cloud(path.stem, mesh.vertices, mesh.normals, mesh.unit, config, digest)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def object_from_mesh(
    name: str,
    vertices: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    unit: str,
    config: ObjectConfig | None = None,
    digest: str | None = None,
) -> ObjectModel:
    """Make an object model of a mesh, watertight or not. Raises InputError if it has no surface to see, or is flat."""
    config = config or ObjectConfig()
    check_triangles(vertices, triangles)
    digest = digest or _digest(vertices, triangles)
    origin = object_origin(vertices[triangles.reshape(-1)] if len(triangles) else vertices)
    if origin.any():
        return _moved(object_from_mesh(name, vertices - origin, triangles, unit, config, digest), origin, np.float64)
    outer = outer_surface(vertices, triangles, config.num_points, config.random_seed)
    _refuse_flat(outer.vertices)
    corners = outer.vertices[outer.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    center = (area[:, None] * corners.mean(axis=1)).sum(axis=0) / area.sum()
    offsets = corners - center
    # The second moments of a triangle: its corners' and their sum's outer products, by the exact formula.
    sums = offsets.sum(axis=1)
    moments = np.einsum("t,tci,tcj->ij", area, offsets, offsets) + np.einsum("t,ti,tj->ij", area, sums, sums)
    shape = (center, moments / (12 * area.sum()), RayScene(outer.vertices, outer.triangles).distance)
    return _model(name, unit, outer, shape, config.symmetry_tolerance, digest)


def object_from_cloud(
    name: str,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"] | None,
    unit: str,
    config: ObjectConfig | None = None,
    digest: str | None = None,
) -> ObjectModel:
    """Make an object model of a cloud that covers the whole surface, such as a merged scan.

    Without normals they are estimated and oriented consistently, outwards. Symmetries are found to the tolerance
    plus the spacing of the points. Raises InputError for fewer points than the config asks for, since a sparse
    cloud cannot stand for a surface, and for points in one plane.
    """
    import open3d
    from scipy.spatial import cKDTree

    config = config or ObjectConfig()
    check_triangles(points, np.zeros((0, 3), np.int32))
    digest, origin = digest or _digest(points), object_origin(points)
    if origin.any():
        return _moved(object_from_cloud(name, points - origin, normals, unit, config, digest), origin, np.float64)
    distinct = np.sort(np.unique(points, axis=0, return_index=True)[1])
    if len(distinct) < config.num_points:
        raise InputError(
            f"the cloud has {len(distinct)} different points, but {config.num_points} are needed: scan it more densely"
        )
    _refuse_flat(points[distinct])
    generator = np.random.default_rng(config.random_seed)
    if len(distinct) > _MAX_CLOUD:
        distinct = np.sort(generator.choice(distinct, _MAX_CLOUD, replace=False))
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[distinct].astype(np.float64)))
    if normals is not None and not (np.isfinite(normals).all() and np.any(normals, axis=1).all()):
        normals = None
    if normals is not None:
        cloud.normals = open3d.utility.Vector3dVector(normals[distinct].astype(np.float64))
        cloud.normalize_normals()
    else:
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(30))
    if len(distinct) > 5 * config.num_points:
        cloud = cloud.select_by_index(np.sort(generator.choice(len(distinct), 5 * config.num_points, replace=False)))
    if normals is None:
        cloud.orient_normals_consistent_tangent_plane(30)
    thinned = cloud.farthest_point_down_sample(config.num_points)
    kept, directions = np.asarray(thinned.points), np.asarray(thinned.normals)
    center = kept.mean(axis=0)
    if normals is None and ((kept - center) * directions).sum() < 0:
        directions = -directions
    size = float(np.linalg.norm(np.ptp(kept, axis=0)))
    tree, spacing = cKDTree(points[distinct]), float(np.median(cKDTree(kept).query(kept, k=2)[0][:, 1]))
    outer = OuterSurface(
        vertices=points.astype(np.float64),
        triangles=np.zeros((0, 3), np.int32),
        points=kept.astype(np.float32),
        normals=directions.astype(np.float32),
        area=_covered_area(np.asarray(cloud.points)),
        hidden_share=0.0,
    )
    tolerance = min(config.symmetry_tolerance + spacing / size, 0.2)
    shape = (center, np.cov(kept.T, bias=True), lambda moved: tree.query(moved)[0])
    return _model(name, unit, outer, shape, tolerance, digest)


def _model(
    name: str,
    unit: str,
    outer: OuterSurface,
    shape: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"], Distance],  # centre, moments, distance from it
    tolerance: float,
    digest: str,
) -> ObjectModel:
    import jax.numpy as jnp
    from scipy.spatial.distance import cdist

    from kmn_jax.geometry import farthest_point_indices

    extremes = _extremes(outer.vertices)
    diameter = float(cdist(extremes, extremes).max())
    center, moments, distance = shape
    # Centred and of unit size: float32 then has digits to tell the distances apart.
    scaled = jnp.asarray((outer.points - center) / diameter, jnp.float32)
    order = np.asarray(farthest_point_indices(scaled, len(scaled)))
    points = outer.points[order]
    # Corners are where a wrong rotation shows most, but no random point hits one; a cloud's outermost points are noise.
    probes = (
        np.concatenate([points.astype(np.float64), extremes]) if len(outer.triangles) else points.astype(np.float64)
    )
    return ObjectModel(
        name=name,
        unit=check_unit(unit),
        vertices=outer.vertices,
        triangles=outer.triangles,
        points=points,
        normals=outer.normals[order],
        minimum=outer.vertices.min(axis=0),
        maximum=outer.vertices.max(axis=0),
        diameter=diameter,
        area=outer.area,
        hidden_share=outer.hidden_share,
        symmetries=find_symmetries(probes, center, moments, distance, diameter, tolerance),
        digest=digest,
    )


def _moved(model: ObjectModel, offset: Float[np.ndarray, "3"], dtype: DTypeLike) -> ObjectModel:
    return replace(
        model,
        vertices=model.vertices + offset,
        points=(model.points + offset).astype(dtype),
        minimum=model.minimum + offset,
        maximum=model.maximum + offset,
        symmetries=replace(model.symmetries, center=model.symmetries.center + offset),
    )


def _refuse_flat(points: Float[np.ndarray, "n 3"]) -> None:
    offsets = points - points.mean(axis=0)
    if np.linalg.matrix_rank(offsets, tol=1e-6 * float(np.linalg.norm(offsets))) < 3:
        raise InputError("all points lie in one plane or on a line: that is not an object's surface")


def _covered_area(points: Float[np.ndarray, "n 3"]) -> float:
    """Estimate the area of the surface that points lie on, however densely: each stands for its neighbours' share."""
    from scipy.spatial import cKDTree

    radius = cKDTree(points).query(points, k=17)[0][:, -1]
    return float(np.pi / 16 * (radius**2).sum())


def _extremes(vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "h 3"]:
    """Return the vertices of the convex hull, or of large ones about 3,000 that leave out 0.1% of its size at most."""
    from scipy.spatial import ConvexHull

    center = vertices.mean(axis=0)
    hull = (vertices - center)[ConvexHull(vertices - center).vertices]
    if len(hull) > _MAX_HULL:
        directions = np.random.default_rng(0).normal(size=(_MAX_HULL, 3))
        hull = hull[np.unique((directions @ hull.T).argmax(axis=1))]
    return hull + center


def _digest(*arrays: np.ndarray) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()
