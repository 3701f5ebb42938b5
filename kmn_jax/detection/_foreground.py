"""Which points of a scan may show parts: what is left without the empty bin, outside of a box, a floor and walls.

The steps run in this order: box, empty bin, floor, walls. A floor is the plane that holds most points; it is taken away
with all that lies behind it, seen from the sensor at the origin. For walls see walls.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Float32

from kmn_jax.detection._background import away_from_empty, in_front_of_empty
from kmn_jax.detection._frames import into, placed
from kmn_jax.detection._planes import Plane, dominant_plane, extent
from kmn_jax.detection._walls import Ground, off_walls
from kmn_jax.errors import InputError, finite_numbers
from kmn_jax.io import Scan
from kmn_jax.units import METRES

RemovePlane = Literal["auto", "always", "never"]
Box = tuple[float, float, float, float, float, float]

_BEHIND = 0.15  # share of the points: with more behind it, a plane is no floor, but the tops of parts, or a rim
_LEFT = 0.01  # share of the points in front of a floor without which it may be the parts themselves
_HARDLY = 0.01  # share of the points: an empty bin that takes fewer away is hidden, or that of other scans
_PLANES = 3  # one behind the other, among which a floor is looked for
_HINT = ": if it is the floor, give a region of interest (--roi) or the empty bin (--background)"


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """A box that need not be in line with the scene's axes; lengths are in the scene's unit."""

    T_scene_box: Float[np.ndarray, "4 4"]  # its centre and axes
    size: Float[np.ndarray, "3"]  # along its axes

    def __post_init__(self) -> None:
        rotation, whole = self.T_scene_box[:3, :3], np.isfinite(self.T_scene_box).all() and np.isfinite(self.size).all()
        if not whole or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
            raise InputError("the pose of a region of interest must be a rotation and a place, all numbers finite")
        if not (self.size > 0).all():
            raise InputError(f"the region of interest is {self.size.tolist()} large, but each side must be above zero")

    @classmethod
    def of_numbers(cls, numbers: Sequence[float]) -> OrientedBox:
        """Return the box of nine numbers: centre, size, and rotation vector in degrees."""
        from scipy.spatial.transform import Rotation

        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(numbers[6:], degrees=True).as_matrix()
        pose[:3, 3] = numbers[:3]
        return cls(pose, np.array(numbers[3:6], dtype=np.float64))


@dataclass(frozen=True)
class ForegroundOptions:
    """What is known of the background. Lengths without a unit are shares of the object's diameter.

    `remove_plane` auto takes a floor away if it is large, holds a good share of the points and has nothing much behind
    it, and the walls of a bin, and neither where an empty bin is given; always takes the largest plane away, whatever
    it is, and walls.
    """

    background: Scan | None = None  # the empty bin, in the same frame
    # xmin, ymin, zmin, xmax, ymax, zmax in the scene's frame and unit, or a box: nothing else is searched.
    roi: Box | OrientedBox | None = None
    remove_plane: RemovePlane = "auto"
    background_margin: float = 0.05  # nearer than that to the empty bin is background
    plane_margin: float = 0.03  # nearer than that to the plane belongs to it
    least_share: float = 0.2  # of the points, which a floor holds
    least_extent: float = 1.5  # of a floor, along the longer side of what is seen of it
    random_seed: int = 0

    def __post_init__(self) -> None:
        if self.background is not None and not isinstance(self.background, Scan):
            raise InputError(
                f"background is a {type(self.background).__name__}, but must be a Scan, as PoseEstimator.read makes it"
            )
        if self.remove_plane not in get_args(RemovePlane):
            raise InputError(f"remove_plane is {self.remove_plane!r}, but must be auto, always or never")
        if self.roi is not None and not isinstance(self.roi, OrientedBox):
            box = finite_numbers(self.roi, "roi (xmin ymin zmin xmax ymax zmax)", 6)
            if not (box[:3] < box[3:]).all():
                raise InputError(
                    f"roi is {self.roi}, but must be xmin ymin zmin xmax ymax zmax, each min below its max"
                )
        for name in ("background_margin", "plane_margin", "least_extent"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name} is {getattr(self, name)}, but must be above zero and finite")
        if not 0 < self.least_share < 1:
            raise InputError(f"least_share is {self.least_share}, but must be between 0 and 1")


def foreground(
    scan: Scan,
    diameter: float,
    options: ForegroundOptions | None = None,
    T_scene_camera: Float[np.ndarray, "4 4"] | None = None,
) -> tuple[Bool[np.ndarray, " n"], tuple[str, ...]]:
    """Return which points of a scan may show an object of that diameter, and what the user should know of it.

    The scan is in its sensor's frame; region and empty bin are in the scene's, by default the same. The same scan and
    options give the same mask. Raises InputError if nothing is left, naming the step that took the
    last points away.
    """
    options = options or ForegroundOptions()
    pose = np.eye(4) if T_scene_camera is None else T_scene_camera
    if not 0 < diameter < math.inf:
        raise InputError(f"diameter is {diameter}, but must be above zero and finite")
    kept: Bool[np.ndarray, " n"] = np.ones(len(scan.points), dtype=bool)
    warnings: list[str] = []
    if options.roi is not None:
        points = placed(pose, scan.points)
        if isinstance(options.roi, OrientedBox):
            kept &= (np.abs(into(options.roi.T_scene_box, points)) <= options.roi.size / 2).all(axis=1)
        else:
            low, high = np.array(options.roi[:3]), np.array(options.roi[3:])
            kept &= ((points >= low) & (points <= high)).all(axis=1)
        if not kept.any():
            raise InputError(
                f"the region of interest holds none of the {len(kept)} points: {_box_of(points, scan.unit)}"
            )
    if options.background is not None:
        before = int(kept.sum())
        kept &= _off_background(scan, options.background, pose, diameter, options.background_margin)
        if not kept.any():
            raise InputError(f"all {before} points are those of the empty bin, or too near to it: is it really empty?")
        share = 1 - kept.sum() / before
        if share < _HARDLY and options.roi is None:
            warnings.append(
                f"the scan of the empty bin takes only {share:.1%} of the points away: if parts do not hide all of the"
                " bin, it is not in the frame and unit of this scan"
            )
    wanted = options.remove_plane == "always" or (options.remove_plane == "auto" and options.background is None)
    if wanted:
        chosen, margin = np.flatnonzero(kept), options.plane_margin * diameter
        floor, kept_plane, warning = _floor(scan.points[chosen], diameter, options)
        ground = None if kept_plane is None else Ground(kept_plane, np.zeros((0, 3), dtype=np.float32))
        if floor is not None:
            height = floor.height(scan.points[chosen])
            ground = Ground(floor, scan.points[chosen][np.abs(height) <= margin])
            kept[chosen] = height < -margin
            if not kept.any():
                raise InputError(
                    f"all {len(chosen)} points lie in one plane or behind it: if they show objects, keep the plane"
                )
        warnings += [warning] if warning else []
        chosen = np.flatnonzero(kept)
        least_extent = options.least_extent * diameter
        kept[chosen] = off_walls(
            scan.points[chosen], ground, floor is not None, margin, least_extent, options.random_seed
        )
    return kept, tuple(warnings)


def _box_of(points: Float[np.ndarray, "n 3"], unit: str) -> str:
    low, high = points.min(axis=0), points.max(axis=0)
    ranges = (f"{axis} from {a:.7g} to {b:.7g}" for axis, a, b in zip("xyz", low, high, strict=True))
    return f"the scan has {', '.join(ranges)} {unit}"


def _off_background(
    scan: Scan, empty: Scan, T_scene_camera: Float[np.ndarray, "4 4"], diameter: float, margin: float
) -> Bool[np.ndarray, " n"]:
    if METRES[empty.unit] != METRES[scan.unit]:
        empty = empty.in_unit(scan.unit)
    if scan.depth is not None and empty.depth is not None and scan.camera == empty.camera:
        return np.asarray(in_front_of_empty(scan.depth, empty.depth, diameter, margin))[scan.depth > 0]
    return away_from_empty(scan.points, into(T_scene_camera, empty.points).astype(np.float32), diameter, margin)


def _floor(
    points: Float32[np.ndarray, "n 3"], diameter: float, options: ForegroundOptions
) -> tuple[Plane | None, Plane | None, str | None]:
    """Return the plane to take away, or none, the first that was kept, and what may make a user wonder.

    The largest plane may be the tops of a layer of parts. Then the floor is the largest plane behind it.
    """
    margin = options.plane_margin * diameter
    searched, kept = points, None
    kept_text: str | None = None
    for _ in range(_PLANES):
        plane = dominant_plane(searched, margin, options.random_seed)
        if plane is None:
            break
        height = plane.height(points)
        within = np.abs(height) <= margin
        share, behind, before = (float(part.mean()) for part in (within, height > margin, height < -margin))
        if options.remove_plane == "always":
            weak = f"the largest plane was taken away as asked, though it holds only {share:.0%} of the points"
            return plane, None, weak if share < options.least_share else None
        if share < options.least_share or extent(points[within]) <= options.least_extent * diameter:
            break
        if behind <= _BEHIND and before < _LEFT:
            text = f"a plane with {share:.0%} of the points was kept, as only {before:.1%} lie in front of it: if it"
            return None, plane, f"{text} is the floor, say --plane always"
        if behind <= _BEHIND:
            return plane, kept, kept_text and f"{kept_text} was kept, in front of the one that was taken away{_HINT}"
        kept = kept or plane
        kept_text = kept_text or (f"a plane with {share:.0%} of the points" if share > behind else None)
        searched = points[height > margin]
    if options.remove_plane == "always":
        return None, None, "no plane was taken away, as none was found"
    return None, kept, kept_text and f"{kept_text} was kept, as many lie behind it{_HINT}"
