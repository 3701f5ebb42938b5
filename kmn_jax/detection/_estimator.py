"""The estimator: parts prepared once, scans given as files or arrays, poses out as plain records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, overload

import numpy as np
from jaxtyping import Float

from kmn_jax.bop import is_bop_image
from kmn_jax.detection._calibration import Probabilities, calibration_beside, load_probabilities
from kmn_jax.detection._config import DetectConfig
from kmn_jax.detection._coverage import unexplained
from kmn_jax.detection._detect import detect
from kmn_jax.detection._evidence import EVIDENCE
from kmn_jax.detection._exclusion import apart
from kmn_jax.detection._foreground import ForegroundOptions
from kmn_jax.detection._frames import into, placed
from kmn_jax.detection._grasps import with_grasps
from kmn_jax.detection._result import Detection, Detections
from kmn_jax.detection._scan_frame import base_from_scene, in_base, scan_frame
from kmn_jax.detection._scene import Scene, make_scene, nearest_row
from kmn_jax.detection._sources import (
    GraspSource,
    PartSource,
    ScanSource,
    arranged,
    grasps_of,
    is_unit_assumed,
    object_of,
    parts_of,
    places_of,
    read_source,
    unit_words,
)
from kmn_jax.detection._timing import Clock
from kmn_jax.errors import InputError, check_type, check_whole, float_array
from kmn_jax.io import (
    CameraMatrix,
    Scan,
    camera_question,
    length_doubt,
    length_problem,
    scene_size,
    size_question,
)
from kmn_jax.models import Model, load_model, released_file
from kmn_jax.objects import (
    CARD_SUFFIX,
    ObjectConfig,
    Part,
    load_part,
    make_part,
    model_digest,
)
from kmn_jax.programs import read_kept
from kmn_jax.released import RELEASED
from kmn_jax.typing import ArrayInput
from kmn_jax.units import Unit

_UNFITTED = "the probabilities were fitted for other weights: fit them with experiments.calibrate"
_OBJECT = ObjectConfig(num_points=4096)
_MOST_SEED = 2**32 - 1


@dataclass(frozen=True)
class PoseEstimator:
    """Find copies of parts in scans. Make it by `from_pretrained`."""

    model: Model
    digest: str  # of the model
    probabilities: Probabilities
    config: DetectConfig = field(default_factory=DetectConfig)
    warnings: tuple[str, ...] = ()  # go with every result
    weights: str | None = None  # the name or file that the model was loaded by

    @classmethod
    def from_pretrained(cls, weights: str | Path = RELEASED, config: DetectConfig | None = None) -> PoseEstimator:
        """Load a released network by its name, or one's own by its .safetensors file.

        Probabilities are those of the calibration beside the file (NAME.calibration.json); without one, those of the
        released network, and each result says so. Raises InputError if there is no such network.
        """
        config = DetectConfig() if config is None else config
        check_type(config, DetectConfig, "config")
        read_kept()
        path = Path(weights) if Path(weights).suffix == ".safetensors" else released_file(str(weights))
        model = load_model(path)
        own = calibration_beside(path).is_file()
        probabilities = load_probabilities(calibration_beside(path if own else released_file()), EVIDENCE)
        warnings = () if own else (_UNFITTED,)
        return cls(model, model_digest(model), probabilities, config, warnings, str(weights))

    def prepare(self, source: PartSource, unit: Unit | None = None, name: str | None = None) -> Part:
        """Make a part of a CAD file, a cloud that covers the whole surface, a mesh or an object card.

        `source` is a path (STL, OBJ, PLY, GLB, STEP, PCD, XYZ, or .kmn, a card), an array (n, 3) or (n, 6) of points
        and normals, a pair of vertices (v, 3) and triangles (t, 3), or anything with `vertices` and `faces`. `unit`
        is that of its numbers; without it millimetres are assumed, which the part remembers. Cards, STEP and GLB files
        state theirs: they are converted to `unit`, if it is given. Raises InputError if there is no surface in it.
        """
        if isinstance(source, str | Path) and Path(source).suffix.lower() == CARD_SUFFIX:
            part = load_part(source, self.digest)
            if part.num_keypoints != self.model.config.num_keypoints:
                raise InputError(
                    f"{source} has {part.num_keypoints} keypoints, not {self.model.config.num_keypoints}: make it again"
                    " with kmn prepare"
                )
            return part if unit is None else part.in_unit(unit)
        part = make_part(object_of(source, unit, name, _OBJECT), self.model, self.digest)
        return replace(part, is_unit_assumed=is_unit_assumed(source, unit))

    def scene(
        self,
        scan: ScanSource,
        part: Part | Sequence[Part],
        *,
        unit: Unit | Literal["auto"] | None = None,
        camera: str | Path | None = None,
        K: CameraMatrix | None = None,
        depth_unit: Unit | float | None = None,
        sensor: Float[np.ndarray, "3"] | None = None,
        T_scene_camera: ArrayInput | None = None,
        at: Float[np.ndarray, "*k 3"] | None = None,
        background: ForegroundOptions | None = None,
    ) -> Scene:
        """Make a scan ready for searches of a part, or of several: `detect` does so itself, this is for many calls.

        See `detect` for the arguments.
        """
        parts = sorted(parts_of(part), key=lambda one: one.in_unit("m").diameter)
        if not parts:
            raise InputError("no object is given to make the scene for")
        smallest, ratio = parts[0], parts[-1].in_unit("m").diameter / parts[0].in_unit("m").diameter
        options = ForegroundOptions() if background is None else background
        if not isinstance(options, ForegroundOptions):
            raise InputError(
                f"background is a {type(options).__name__}, but must be ForegroundOptions: an empty bin is theirs"
            )
        if sensor is not None:
            float_array(sensor, "sensor", (3,))
            sensor = np.asarray(sensor, dtype=np.float64)
        given = arranged(scan, K, depth_unit, camera, unit)
        read, truth, bop_ids = read_source(given, unit, camera, smallest)
        frame = scan_frame(read, sensor, T_scene_camera)
        size = scene_size(read)
        words = unit_words(scan, K, unit)
        problem = length_problem(smallest.diameter, smallest.unit, size, words)
        if problem is not None:
            raise InputError(problem)
        is_stated = camera is None and isinstance(scan, str | Path) and is_bop_image(scan)
        question = size_question(smallest.diameter, smallest.unit, words.object)
        # Margins are those of the smallest part, but a plane is background only if it is no part's.
        options = replace(options, least_extent=options.least_extent * ratio)
        diameter = smallest.in_unit(read.unit).diameter
        scene = make_scene(read, diameter, sensor=frame.sensor, background=options, keep=places_of(at))
        return replace(
            scene,
            warnings=(*self.warnings, *filter(None, (question,)), *frame.warnings, *scene.warnings),
            doubt=None if is_stated else length_doubt(smallest.diameter, smallest.unit, size),
            size=size,
            has_unit_of_part=not is_stated and unit in (None, "auto") and not isinstance(given, Scan),
            truth=truth,
            bop_ids=bop_ids,
            T_scene_sensor=frame.T_scene_sensor,
            is_opengl=frame.is_opengl,
            source=str(scan) if isinstance(scan, str | Path) else None,
            empty=None if options.background is None else _points_of(options.background, scene),
        )

    def read(
        self,
        scan: ScanSource,
        part: Part,
        unit: Unit | Literal["auto"] | None = None,
        camera: str | Path | None = None,
        *,
        K: CameraMatrix | None = None,
        depth_unit: Unit | float | None = None,
    ) -> Scan:
        """Read a scan as `scene` does, such as that of an empty bin."""
        return read_source(arranged(scan, K, depth_unit, camera, unit), unit, camera, part)[0]

    @overload
    def detect(
        self,
        part: Part,
        scan: ScanSource | Scene,
        camera: str | Path | None = None,
        unit: Unit | Literal["auto"] | None = None,
        at: Float[np.ndarray, "*k 3"] | None = None,
        *,
        K: CameraMatrix | None = None,
        depth_unit: Unit | float | None = None,
        sensor: Float[np.ndarray, "3"] | None = None,
        T_scene_camera: ArrayInput | None = None,
        T_base_camera: ArrayInput | None = None,
        grasps: GraspSource | Sequence[GraspSource | None] | None = None,
        background: ForegroundOptions | None = None,
        random_seed: int = 0,
        top: int | None = None,
        clock: Clock | None = None,
    ) -> Detections: ...

    @overload
    def detect(
        self,
        part: Sequence[Part],
        scan: ScanSource | Scene,
        camera: str | Path | None = None,
        unit: Unit | Literal["auto"] | None = None,
        at: Float[np.ndarray, "*k 3"] | None = None,
        *,
        K: CameraMatrix | None = None,
        depth_unit: Unit | float | None = None,
        sensor: Float[np.ndarray, "3"] | None = None,
        T_scene_camera: ArrayInput | None = None,
        T_base_camera: ArrayInput | None = None,
        grasps: GraspSource | Sequence[GraspSource | None] | None = None,
        background: ForegroundOptions | None = None,
        random_seed: int = 0,
        top: int | None = None,
        clock: Clock | None = None,
    ) -> tuple[Detections, ...]: ...

    def detect(
        self,
        part: Part | Sequence[Part],
        scan: ScanSource | Scene,
        camera: str | Path | None = None,
        unit: Unit | Literal["auto"] | None = None,
        at: Float[np.ndarray, "*k 3"] | None = None,
        *,
        K: CameraMatrix | None = None,
        depth_unit: Unit | float | None = None,
        sensor: Float[np.ndarray, "3"] | None = None,
        T_scene_camera: ArrayInput | None = None,
        T_base_camera: ArrayInput | None = None,
        grasps: GraspSource | Sequence[GraspSource | None] | None = None,
        background: ForegroundOptions | None = None,
        random_seed: int = 0,
        top: int | None = None,
        clock: Clock | None = None,
    ) -> Detections | tuple[Detections, ...]:
        """Return the copies of a part in a scan, in pick order; of several parts, one result for each.

        `scan` is a file, points (n, 3) or (h, w, 3), a depth image (h, w) with `K`, a `Scan`, or a `Scene` that was
        made of one; then what says how to read it is not given again. Points are in the camera's frame, unless
        `T_scene_camera` is its pose in theirs, z forward, or `sensor` its place. `K` are intrinsics (3, 3), or fx, fy,
        cx, cy, and `depth_unit` is the unit of a depth image and of its result: mm of whole numbers and m of fractions
        unless given, or how many metres one step is. `unit` is that of all other scans' lengths, by default what the
        format states, else the part's; an image of a BOP dataset needs neither it nor `camera`, a file of intrinsics.

        `T_base_camera`, in the result's unit, is the camera's pose in a robot's frame: each copy then has a
        `T_base_object`. `grasps`, a file or one for each part, gives each copy those of them that are free (see
        docs/grasps.md). `at` restricts the search to places (k, 3) in the scan's frame: each has one pose or none.
        `background` says what is no part; `top` keeps the first poses only; `clock` has timed what came before. Where
        poses of several parts would stand in one place, the more probable one stays. The same inputs and `random_seed`
        give the same bits on one device.

        Raises InputError if lengths of part and scan cannot belong together, if nothing of the scan is foreground, or
        if nothing was measured near to one of the places.
        """
        parts = parts_of(part)
        if not parts:
            return ()
        for one in parts:
            if one.model_digest != self.digest:
                raise InputError(
                    f"the object {one.name} was prepared with other weights: prepare it with this estimator"
                )
        check_whole(random_seed, "random_seed", 0, _MOST_SEED)
        if top is not None:
            check_whole(top, "top", 1)
        clock = clock or Clock()
        places, ways = places_of(at), grasps_of(grasps, len(parts))
        if isinstance(scan, Scene):
            given = (camera, unit, K, depth_unit, sensor, T_scene_camera, background)
            if any(value is not None for value in given):
                raise InputError(
                    "camera, unit, K, depth_unit, sensor, T_scene_camera and background were settled when the scene was"
                    " made"
                )
            scene = scan
        else:
            with clock("scene"):
                scene = self.scene(
                    scan,
                    parts,
                    unit=unit,
                    camera=camera,
                    K=K,
                    depth_unit=depth_unit,
                    sensor=sensor,
                    T_scene_camera=T_scene_camera,
                    at=places,
                    background=background,
                )
        T_base_scene = base_from_scene(T_base_camera, scene.T_scene_sensor, scene.is_opengl)
        parts = [one.in_unit(scene.unit) for one in parts]
        centred = [one.centred() for one in parts]
        if places is not None:
            places = into(scene.T_scene_camera, places)
            _check_near(scene, places, max(one.diameter for one in parts))
        settings = {"scene": scene.source, "seed": random_seed, "weights": self.weights, "model": self.digest}
        results = []
        for one in centred:
            found = detect(self.model, self.probabilities, one, scene, random_seed, self.config, places, clock)
            results.append(replace(found, settings=settings))
            clock = Clock()
        if len(parts) > 1:
            results = [
                _told_anew(found, one, scene, self.config.accepted)
                for found, one in zip(apart(results, centred), centred, strict=True)
            ]
        for number, found in enumerate(results):
            poses = tuple(_of_own_frame(pose, parts[number].origin) for pose in found.poses[:top])
            found = replace(found, poses=poses)
            way, clock = ways[number], Clock()
            if way is not None:
                with clock("grasps"):
                    found = with_grasps(found, way, parts[number], scene, T_base_scene)
                found = replace(found, timing=found.timing.and_then(clock.timing))
            if T_base_scene is not None:
                away = float(np.linalg.norm(np.asarray(T_base_camera, dtype=np.float64)[:3, 3]))
                found = in_base(found, T_base_scene, camera_question(away, scene.unit, parts[number].diameter))
            results[number] = found
        return results[0] if isinstance(part, Part) else tuple(results)


def _of_own_frame(pose: Detection, origin: Float[np.ndarray, "3"]) -> Detection:
    """Return the pose of a part's own frame for that of a frame with its `origin`, which is zero for most."""
    if not origin.any():
        return pose
    T = pose.T_scene_object.copy()
    T[:3, 3] -= T[:3, :3] @ origin
    return replace(pose, T_scene_object=T)


def _told_anew(found: Detections, part: Part, scene: Scene, accepted: float) -> Detections:
    """Return a result, some of whose poses were left out, with what the others leave unexplained."""
    if found.unexplained is None:
        return found
    T_camera_scene = np.linalg.inv(scene.T_scene_camera)
    kept = [T_camera_scene @ pose.T_scene_object for pose in found.poses if pose.probability >= accepted]
    left = unexplained(scene.foreground, scene, part, np.array(kept).reshape(-1, 4, 4))
    points = placed(scene.T_scene_camera, scene.points[left])
    return replace(found, unexplained=float(left.sum() / scene.foreground.sum()), unexplained_points=points)


def _points_of(empty: Scan, scene: Scene) -> Float[np.ndarray, "e 3"]:
    """Return the points of an empty bin in the camera's frame and the scene's unit."""
    return into(scene.T_scene_camera, empty.in_unit(scene.unit).points).astype(np.float32)


def _check_near(scene: Scene, places: Float[np.ndarray, "k 3"], reach: float) -> None:
    """Raise InputError if nothing was measured near to one of the places, which are in the camera's frame."""
    for number, place in enumerate(places):
        away = float(np.linalg.norm(scene.points[nearest_row(scene.points, place)] - place))
        if away > reach:
            raise InputError(
                f"place {number + 1} to search at is {away:.4g} {scene.unit} away from the nearest measured point,"
                " farther than the object is large: give a point of the scan"
            )
