"""What our poses are compared with. Every length is a share of the object's diameter, stated in `settings`.

All rivals get the same crops as we do, thinned to voxels, and the same refinement. Where an author recommends settings
they are taken, scaled by the object's size; the published baseline's (arXiv 2303.16102: FPFH of 10 mm, gate of 5 mm,
100,000 iterations, for parts of about 8 cm) are of that scale, too.
Those that were chosen on validation bins are in `tuned`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from importlib import import_module
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from experiments.evaluation.best_of import SeveralPoses
from experiments.evaluation.cases import Case, Solver
from kmn_jax.geometry import pad_cloud, smoothed
from kmn_jax.objects import ObjectModel
from kmn_jax.pose import Matches

_LEAST_POINTS = 10  # of a thinned crop
_SMOOTHED_BY = 4096  # points of a crop
_SMOOTHED = (1024, 2048, 4096, 8192)  # points of a padded thinned crop


@dataclass(frozen=True)
class FeatureSettings:
    """Voxels and FPFH features as Open3D's registration tutorial scales them."""

    voxel: float = 0.04
    normal_voxels: float = 2.0  # radius, at most 30 neighbours
    feature_voxels: float = 5.0  # radius, at most 100 neighbours
    smooth: bool = False  # points and normals of a scan as our network gets them, see `kmn_jax.geometry._smoothing`


class Described(NamedTuple):
    """An Open3D cloud and the FPFH features of its points."""

    cloud: Any
    features: Any


@dataclass(frozen=True)
class Fpfh:
    """FPFH features, RANSAC over mutual nearest ones (Open3D)."""

    name: str = "FPFH + RANSAC"
    features: FeatureSettings = FeatureSettings()
    gate_voxels: float = 1.5
    edge_similarity: float = 0.9
    iterations: int = 100_000
    confidence: float = 0.999

    @property
    def settings(self) -> Mapping[str, Any]:
        """All of them."""
        return asdict(self)

    def prepare(self, model: ObjectModel) -> Solver:
        """Return a solver that describes each crop anew."""
        return first_of(self.prepare_several(model))

    def prepare_several(self, model: ObjectModel) -> SeveralPoses:
        """Return what searches a crop, which it describes once, with several random seeds."""
        return _poses_of_described(
            model, self.features, lambda source, target: self.registered(source, target, model.diameter)
        )

    def registered(self, source: Described, target: Described, diameter: float) -> Any:
        """Return Open3D's result of moving a described cloud onto another one, None without any pair that agrees."""
        import open3d

        registration = open3d.pipelines.registration
        gate = self.gate_voxels * self.features.voxel * diameter
        found = registration.registration_ransac_based_on_feature_matching(
            *(source.cloud, target.cloud, source.features, target.features),
            True,
            gate,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(self.edge_similarity),
                registration.CorrespondenceCheckerBasedOnDistance(gate),
            ],
            registration.RANSACConvergenceCriteria(self.iterations, self.confidence),
        )
        return found if len(found.correspondence_set) else None


@dataclass(frozen=True)
class FastGlobal:
    """FPFH features, Fast Global Registration (Open3D), with the options that its authors ship.

    Open3D's own defaults leave graduated non-convexity out (`decrease_mu`), and with it the gate.
    """

    name: str = "FPFH + FGR"
    features: FeatureSettings = FeatureSettings()
    decrease_mu: bool = True
    gate: float = 0.025  # of the larger cloud's radius, by which both are scaled
    tuples: int = 1000
    tuple_scale: float = 0.95

    @property
    def settings(self) -> Mapping[str, Any]:
        """All of them."""
        return asdict(self)

    def prepare(self, model: ObjectModel) -> Solver:
        """Return a solver that describes each crop anew."""
        registration = quiet_open3d().pipelines.registration
        option = registration.FastGlobalRegistrationOption(
            decrease_mu=self.decrease_mu,
            maximum_correspondence_distance=self.gate,
            maximum_tuple_count=self.tuples,
            tuple_scale=self.tuple_scale,
        )

        def registered(source: Described, target: Described) -> Any:
            return registration.registration_fgr_based_on_feature_matching(
                source.cloud, target.cloud, source.features, target.features, option
            )

        return first_of(_poses_of_described(model, self.features, registered))


@dataclass(frozen=True)
class PointPairs:
    """Point pair features and voting (OpenCV's ppf_match_3d); the pose with the most votes is taken.

    The package thins a scan by shares of its bounding box; here it is thinned to voxels before, and only what is
    nearer than half of that is merged.
    """

    name: str = "PPF"
    sampling: float = 0.07  # of model and votes' distances
    scene_share: float = 0.2  # of the scene's points are reference points
    features: FeatureSettings = FeatureSettings(voxel=0.05)
    library: ClassVar[str] = "opencv-contrib-python-headless"

    @property
    def settings(self) -> Mapping[str, Any]:
        """All of them."""
        return asdict(self)

    def prepare(self, model: ObjectModel) -> Solver:
        """Hash the model's pairs, once for all noises and settings of the search; solving samples and votes."""
        return first_of(self.prepare_several(model))

    def prepare_several(self, model: ObjectModel) -> SeveralPoses:
        """Return what gives the poses with the most votes, poses alike taken together."""
        detector = _hashed(model, self.sampling)
        compile_smoothing(self.features)

        def solve(case: Case, count: int) -> list[Float[np.ndarray, "4 4"]]:
            target = thinned_cloud(case.points, None, self.features, model.diameter)
            # Relative to the seed: floats of millimetres far from the sensor would lose digits.
            offsets = np.asarray(target.points) - case.points[0]
            if len(offsets) < _LEAST_POINTS:
                return []
            cloud = np.concatenate([offsets, np.asarray(target.normals)], axis=1).astype(np.float32)
            merged = self.features.voxel * model.diameter / 2
            found = detector.match(cloud, self.scene_share, merged / float(np.ptp(offsets, axis=0).max()))
            poses = np.array([one.pose for one in found[:count]], dtype=np.float64).reshape(-1, 4, 4)
            poses[:, :3, 3] += case.points[0]
            return [pose for pose in poses if np.isfinite(pose).all()]

        return solve


_last_hashed: dict[tuple[str, float], Any] = {}  # of one object, as one after another is evaluated


def _hashed(model: ObjectModel, sampling: float) -> Any:
    import cv2

    name = model.digest, sampling
    if all(digest != model.digest for digest, _ in _last_hashed):
        _last_hashed.clear()
    if name not in _last_hashed:
        detector = cv2.ppf_match_3d.PPF3DDetector(sampling, sampling)
        detector.trainModel(np.concatenate([model.points, model.normals], axis=1).astype(np.float32))
        _last_hashed[name] = detector
    return _last_hashed[name]


@dataclass(frozen=True)
class Kiss:
    """KISS-Matcher: FPFH of its own, pruning by maximum cliques, graduated non-convexity."""

    name: str = "KISS-Matcher"
    voxel: float = 0.025
    features: FeatureSettings | None = None  # to smooth the crop first, if given
    library: ClassVar[str] = "kiss-matcher"

    @property
    def settings(self) -> Mapping[str, Any]:
        """All of them; the rest are the package's defaults, multiples of the voxel."""
        return asdict(self)

    def prepare(self, model: ObjectModel) -> Solver:
        """Return a solver that describes both clouds each time: the package keeps nothing."""
        import kiss_matcher

        # In diameters: the package takes bounds on noise above 1 for mistakes.
        settings = kiss_matcher.KISSMatcherConfig(self.voxel)
        compile_smoothing(self.features)
        source = (model.points / model.diameter).astype(np.float32)

        def solve(case: Case) -> Float[np.ndarray, "4 4"] | None:
            matcher = kiss_matcher.KISSMatcher(settings)
            points = case.points.astype(np.float64)
            if self.features is not None:
                points = np.asarray(thinned_cloud(points, None, self.features, model.diameter).points)
            if len(points) < _LEAST_POINTS:
                return None
            target = ((points - case.points[0]) / model.diameter).astype(np.float32)
            found = matcher.estimate(source, target)
            pose = np.eye(4)
            pose[:3, :3] = np.array(found.rotation)
            pose[:3, 3] = np.array(found.translation).reshape(3) * model.diameter + case.points[0]
            return pose if np.isfinite(pose).all() else None

        return solve


@dataclass(frozen=True)
class OverMatches:
    """Open3D's RANSAC over our network's matches, as published for CPUs but for its own ICP."""

    iterations: int = 5000
    gate: float = 0.06  # published: 5 mm for parts of about 8 cm
    confidence: float = 0.999

    @property
    def settings(self) -> Mapping[str, Any]:
        """All of them."""
        return {"library": "open3d", **asdict(self)}

    def __call__(self, matches: Matches, diameter: float, random_seed: int) -> Float[np.ndarray, "4 4"] | None:
        """Return the best pose; None if there are too few matches."""
        open3d = quiet_open3d()
        registration = open3d.pipelines.registration
        open3d.utility.random.seed(random_seed % 2**31)
        rows = np.flatnonzero(matches.mask)
        if len(rows) < 3:
            return None
        clouds = (np.asarray(points)[rows] for points in (matches.object_points, matches.scene_points))
        source, target = (open3d.geometry.PointCloud(_vectors(points)) for points in clouds)
        pairs = open3d.utility.Vector2iVector(np.stack([np.arange(len(rows))] * 2, axis=1).astype(np.int32))
        found = registration.registration_ransac_based_on_correspondence(
            source,
            target,
            pairs,
            self.gate * diameter,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [],
            registration.RANSACConvergenceCriteria(self.iterations, self.confidence),
        )
        return np.array(found.transformation) if len(found.correspondence_set) else None


def quiet_open3d() -> Any:
    """Return the package, which otherwise warns at every crop that has few mutual matches."""
    import open3d

    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


def missing(module: str) -> str | None:
    """Return why a package cannot be used, in one line; None if it can."""
    try:
        import_module(module)
    except Exception as error:  # an extension module may fail in any way
        return f"{module} cannot be imported ({str(error).splitlines()[0] if str(error) else type(error).__name__})"
    return None


def _vectors(points: Float[np.ndarray, "n 3"]) -> Any:
    import open3d

    return open3d.utility.Vector3dVector(points.astype(np.float64))


def thinned_cloud(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"] | None,
    settings: FeatureSettings,
    diameter: float,
) -> Any:
    """Return a thinned cloud with normals; those of a scan are estimated after thinning and look at the camera."""
    import open3d

    voxel = settings.voxel * diameter
    cloud = open3d.geometry.PointCloud(_vectors(points))
    if normals is not None:
        cloud.normals = _vectors(normals)
        return cloud.voxel_down_sample(voxel)
    thinned = cloud.voxel_down_sample(voxel)
    if settings.smooth:
        return _smoothed(np.asarray(thinned.points), points, diameter)
    cloud = thinned
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(radius=settings.normal_voxels * voxel, max_nn=30))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    return cloud


def _smoothed(thinned: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "p 3"], diameter: float) -> Any:
    """Return a thinned cloud on the planes through all points of the scan around it, with their normals."""
    import open3d

    origin = points[0].astype(np.float64)
    rows = np.random.default_rng(0).choice(len(points), min(_SMOOTHED_BY, len(points)), replace=False)
    few, mask = pad_cloud((thinned - origin).astype(np.float32), _SMOOTHED[0])
    many, there = pad_cloud((points[rows] - origin).astype(np.float32), _SMOOTHED_BY)
    moved, normals, known, _ = jax.device_get(_smooth(few, mask, many, there, np.float32(diameter)))
    real = np.asarray(mask) & known
    cloud = open3d.geometry.PointCloud(_vectors(moved[real] + origin))
    cloud.normals = _vectors(normals[real])
    if real.any():
        cloud.orient_normals_towards_camera_location(np.zeros(3))
    return cloud


_smooth = jax.jit(smoothed)


def compile_smoothing(settings: FeatureSettings | None) -> None:
    """Compile for all sizes of a thinned crop, if it is to be smoothed, before a solver's time is taken."""
    if settings is None or not settings.smooth:
        return
    many, there = pad_cloud(np.zeros((1, 3), np.float32), _SMOOTHED_BY)
    for size in _SMOOTHED:
        few, mask = pad_cloud(np.zeros((1, 3), np.float32), size)
        jax.block_until_ready(_smooth(few, mask, many, there, np.float32(1)))


def described(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"] | None,
    settings: FeatureSettings,
    diameter: float,
) -> Described | None:
    """Return a thinned cloud and its features, None if too few points are left."""
    import open3d

    cloud = thinned_cloud(points, normals, settings, diameter)
    if len(cloud.points) < _LEAST_POINTS:
        return None
    radius = settings.feature_voxels * settings.voxel * diameter
    near = open3d.geometry.KDTreeSearchParamHybrid(radius=radius, max_nn=100)
    return Described(cloud, open3d.pipelines.registration.compute_fpfh_feature(cloud, near))


def _poses_of_described(
    model: ObjectModel, settings: FeatureSettings, registered: Callable[[Described, Described], Any]
) -> SeveralPoses:
    """Return what describes a crop and registers the object, which is described once, with several random seeds."""
    open3d = quiet_open3d()
    source = described(model.points, model.normals, settings, model.diameter)
    compile_smoothing(settings)

    def solve(case: Case, count: int) -> list[Float[np.ndarray, "4 4"]]:
        target = described(case.points, None, settings, model.diameter)
        if source is None or target is None:
            return []
        poses = []
        for number in range(count):
            open3d.utility.random.seed((case.random_seed + number) % 2**31)
            if (found := registered(source, target)) is not None:
                poses.append(np.array(found.transformation))
        return poses

    return solve


def first_of(several: SeveralPoses) -> Solver:
    """Return a solver that gives the first pose alone."""
    return lambda case: next(iter(several(case, 1)), None)
