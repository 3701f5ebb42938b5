"""The estimator: parts prepared once, scans given as files or arrays, poses out as plain records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias, overload

import numpy as np
from jaxtyping import Bool, Float

from kmn_jax.bop import bop_scan, is_bop_image
from kmn_jax.detection._calibrate import Probabilities, load_probabilities
from kmn_jax.detection._detect import DetectConfig, detect
from kmn_jax.detection._evidence import EVIDENCE
from kmn_jax.detection._foreground import ForegroundOptions, foreground
from kmn_jax.detection._frames import into
from kmn_jax.detection._result import Detections
from kmn_jax.detection._scene import Scene, make_scene, nearest_row
from kmn_jax.detection._timing import Clock
from kmn_jax.detection._view import View, view_of
from kmn_jax.errors import InputError, float_array
from kmn_jax.io import Scan, length_doubt, length_problem, read_scan, scene_size
from kmn_jax.models import Model, load_model, released_file
from kmn_jax.objects import (
    ObjectConfig,
    ObjectModel,
    Part,
    load_object,
    load_part,
    make_part,
    model_digest,
    object_from_cloud,
    object_from_mesh,
)
from kmn_jax.units import check_unit

PartSource: TypeAlias = Any  # see PoseEstimator.prepare
ScanSource: TypeAlias = str | Path | np.ndarray | Scan

_UNFITTED = "the probabilities were fitted for other weights: fit them with experiments.calibrate"
_NUM_POINTS = 4096  # on a part's surface
_CARD = ".kmn"
_SEEDS = 2**31 - 2**16  # rounds of a search count on from the seed


@dataclass(frozen=True)
class PoseEstimator:
    """Find copies of parts in scans. Make it by `from_pretrained`."""

    model: Model
    digest: str  # of the model
    probabilities: Probabilities
    config: DetectConfig = field(default_factory=DetectConfig)
    warnings: tuple[str, ...] = ()  # go with every result

    @classmethod
    def from_pretrained(cls, weights: str | Path = "small", config: DetectConfig | None = None) -> PoseEstimator:
        """Load a released network by its name, or one's own by its .safetensors file.

        Probabilities are those of the calibration beside the file (NAME.calibration.json); without one, those of the
        released network `small`, and each result says so. Raises InputError if there is no such network.
        """
        path = Path(weights) if Path(weights).suffix == ".safetensors" else released_file(str(weights))
        model = load_model(path)
        fitted = path.with_suffix(".calibration.json")
        own = fitted.is_file()
        probabilities = load_probabilities(
            fitted if own else released_file("small").with_suffix(".calibration.json"), EVIDENCE
        )
        return cls(model, model_digest(model), probabilities, config or DetectConfig(), () if own else (_UNFITTED,))

    def prepare(self, source: PartSource, unit: str | None = None, name: str | None = None) -> Part:
        """Make a part of a CAD file, a cloud that covers the whole surface, a mesh or an object card.

        `source` is a path (STL, OBJ, PLY, GLB, STEP, PCD, XYZ, or .kmn, a card), an array (n, 3) or (n, 6) of points
        and normals, a pair of vertices (v, 3) and triangles (t, 3), or anything with `vertices` and `faces`. `unit`
        is that of its lengths: by default the file's own, else millimetres. Raises InputError if there is no surface
        in it.
        """
        if isinstance(source, str | Path) and Path(source).suffix.lower() == _CARD:
            part = load_part(source, self.digest)
            if unit is not None and check_unit(unit) != part.unit:
                raise InputError(
                    f"{source} says that its lengths are {part.unit}, not {unit}: make the card again with kmn prepare"
                    " --units"
                )
            return part
        return make_part(_object(source, unit, name), self.model, self.digest)

    def scene(
        self,
        scan: ScanSource,
        part: Part,
        *,
        unit: str | None = None,
        camera: str | Path | None = None,
        sensor: Float[np.ndarray, "3"] | None = None,
        at: Float[np.ndarray, "k 3"] | None = None,
        background: ForegroundOptions | None = None,
    ) -> Scene:
        """Make a scan ready for searches of a part, or of several of about its size.

        `scan` is a file, points (n, 3) in the sensor's frame or a `Scan`; `unit` is that of its lengths, by default
        the part's. An image of a BOP dataset needs neither it nor a camera. `sensor` is where it was measured from, by
        default the origin, and points nearest to places `at` are kept whatever is thinned out, both in the scan's
        frame. Raises InputError if lengths of part and scan cannot belong together, or if nothing of the scan is
        foreground.
        """
        read = _scan(scan, unit or part.unit, camera)
        size = scene_size(read)
        problem = length_problem(part.diameter, part.unit, size)
        if problem is not None:
            raise InputError(problem)
        if sensor is not None and read.camera is not None:
            raise InputError("a depth image is in the frame of its sensor: leave the sensor's place out")
        view = view_of(read, sensor)
        diameter = part.in_unit(read.unit).diameter
        front, warnings = _foreground(read, view, diameter, background or ForegroundOptions())
        places = None if at is None else into(view.T_scene_view, at)
        most = self.config.candidates.most_points
        scene = make_scene(view, read.unit, front, most, places, (*self.warnings, *warnings))
        return replace(scene, doubt=length_doubt(part.diameter, part.unit, size))

    @overload
    def detect(self, part: Part, scan: ScanSource | Scene, **options: Any) -> Detections: ...

    @overload
    def detect(self, part: Sequence[Part], scan: ScanSource | Scene, **options: Any) -> tuple[Detections, ...]: ...

    def detect(
        self,
        part: Part | Sequence[Part],
        scan: ScanSource | Scene,
        *,
        seed: int = 0,
        at: Float[np.ndarray, "*k 3"] | None = None,
        top: int | None = None,
        clock: Clock | None = None,
        **options: Any,
    ) -> Detections | tuple[Detections, ...]:
        """Return the copies of a part in a scan, in pick order; of several parts, one result for each.

        Several parts share the scene, and where their diameters agree the features of its crops. `at` restricts the
        search to places (k, 3) in the scan's frame, `top` the result to the first poses; `options` go to `scene`
        unless the scan is one already. `clock` has timed what came before. The same inputs and `seed` give the same
        bits on one device.
        """
        parts = [part] if isinstance(part, Part) else list(part)
        if not parts:
            return ()
        for one in parts:
            if one.model_digest != self.digest:
                raise InputError(f"the part {one.name} was prepared with other weights: prepare it with this estimator")
        if not 0 <= seed < _SEEDS:
            raise InputError(f"seed is {seed}, but must be between 0 and {_SEEDS - 1}")
        clock = clock or Clock()
        places = None if at is None else np.asarray(float_array(np.atleast_2d(at), "at", (None, 3)), dtype=float)
        if isinstance(scan, Scene):
            scene = scan
        else:
            with clock("scene"):
                smallest, *_, largest = sorted((*parts, parts[0]), key=lambda one: one.in_unit("m").diameter)
                ratio = largest.in_unit("m").diameter / smallest.in_unit("m").diameter
                planes = options.pop("background", None) or ForegroundOptions()
                # Margins are those of the smallest part, but a plane is background only if it is no part's.
                planes = replace(planes, least_extent=planes.least_extent * ratio)
                scene = self.scene(scan, smallest, at=places, background=planes, **options)
        in_view = None if places is None else into(scene.view.T_scene_view, places)
        if in_view is not None:
            reach = max(one.in_unit(scene.unit).diameter for one in parts)
            _check_near(scene, in_view, reach)
        results = []
        for one in parts:
            found = detect(
                self.model,
                self.probabilities,
                one.in_unit(scene.unit),
                scene,
                seed,
                self.config,
                in_view,
                clock=clock,
            )
            results.append(replace(found, poses=found.poses[:top]))
            clock = Clock()
        return results[0] if isinstance(part, Part) else tuple(results)

    def estimate(
        self,
        part: Part,
        crop: Float[np.ndarray, "_ 3"] | Sequence[Float[np.ndarray, "_ 3"]],
        *,
        seed: int = 0,
        unit: str | None = None,
    ) -> Detections | tuple[Detections, ...]:
        """Return the pose of the copy in the middle of a crop, its first point; of several crops, one result each.

        A crop is points (n, 3) in the sensor's frame around a picked point, which is its first row; more than a
        diameter away from it they are not used. There is one pose or none.
        """
        single = isinstance(crop, np.ndarray) and crop.ndim == 2
        crops = [crop] if single else list(crop)
        keep_all = ForegroundOptions(remove_plane="never")
        results = []
        for points in crops:
            points = np.asarray(float_array(points, "crop", (None, 3)), dtype=np.float32)
            if not len(points):
                raise InputError("crop is empty: at least one point is needed")
            results.append(self.detect(part, points, seed=seed, at=points[:1], top=1, unit=unit, background=keep_all))
        return results[0] if single else tuple(results)


def _check_near(scene: Scene, places: Float[np.ndarray, "k 3"], reach: float) -> None:
    """Raise InputError if nothing was measured near to one of the places, which are in the view's frame."""
    for number, place in enumerate(places):
        away = float(np.linalg.norm(scene.points[nearest_row(scene.points, place)] - place))
        if away > reach:
            raise InputError(
                f"place {number + 1} to search at is {away:.4g} {scene.unit} away from the nearest measured point,"
                " farther than the part is large: give a point of the scan"
            )


def _foreground(
    scan: Scan, view: View, diameter: float, options: ForegroundOptions
) -> tuple[Bool[np.ndarray, " n"], tuple[str, ...]]:
    """Return which points of a view are foreground; planes and what is behind them are as its sensor saw them."""
    if len(view.rows) == len(scan.points) and np.array_equal(view.T_scene_view, np.eye(4)):
        return foreground(scan, diameter, options)
    region = replace(options, background=None, remove_plane="never")
    inside, _ = foreground(scan, diameter, region)
    empty = options.background
    if empty is not None:
        empty = replace(empty, points=into(view.T_scene_view, empty.points).astype(np.float32), depth=None)
    rows = np.flatnonzero(inside[view.rows])
    seen = Scan(view.points[rows], None, None, None, scan.unit)
    front, warnings = foreground(seen, diameter, replace(options, roi=None, background=empty))
    result = np.zeros(len(view.points), dtype=bool)
    result[rows[front]] = True
    return result, warnings


def _scan(source: ScanSource, unit: str, camera: str | Path | None) -> Scan:
    if isinstance(source, Scan):
        return source
    if isinstance(source, str | Path):
        if camera is None and is_bop_image(source):
            return bop_scan(source)[0]
        return read_scan(source, unit, camera)
    array = np.asarray(float_array(source, "scan", (None, 3), finite=False), dtype=np.float32)
    real = np.isfinite(array).all(axis=1) & (array != 0).any(axis=1)
    if not real.any():
        raise InputError(f"none of the scan's {len(array)} points was measured: all are NaN, infinite or zero")
    return Scan(array[real], None, None, None, check_unit(unit))


def _object(source: PartSource, unit: str | None, name: str | None) -> ObjectModel:
    config = ObjectConfig(num_points=_NUM_POINTS)
    if isinstance(source, str | Path):
        return load_object(source, unit, config)
    unit, name = check_unit(unit or "mm"), name or "part"
    if not isinstance(source, np.ndarray):
        if hasattr(source, "vertices") and hasattr(source, "faces"):
            source = (source.vertices, source.faces)
        if not isinstance(source, tuple) or len(source) != 2:
            raise InputError(f"a part cannot be made of a {type(source).__name__}: give a file, a cloud or a mesh")
        vertices, triangles = (np.asarray(array) for array in source)
        return object_from_mesh(name, vertices.astype(np.float64), triangles.astype(np.int64), unit, config)
    cloud = np.asarray(source)
    if cloud.ndim != 2 or cloud.shape[1] not in (3, 6):
        raise InputError(f"the part's cloud has shape {cloud.shape}, but must be (n, 3), or (n, 6) with normals")
    normals = cloud[:, 3:].astype(np.float64) if cloud.shape[1] == 6 else None
    return object_from_cloud(name, cloud[:, :3].astype(np.float64), normals, unit, config)
