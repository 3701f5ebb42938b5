"""Cases: crops of scans of known poses, each around a measured point of a copy, with noise added if asked for.

A source yields the scans of one object at a time, in millimetres; `draw_cases` makes crops of them. Crops hold all that
was measured within a diameter of the seed, without the background that is known, and are the same for all methods.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from kmn_jax.detection import MOST_POINTS
from kmn_jax.errors import InputError
from kmn_jax.geometry import PaddedCloud, pad_cloud
from kmn_jax.objects import ObjectModel

UNIT: Final = "mm"
_SEED_DRAWS = 5000  # points of a scan whose copy is looked for
_LABEL_TOLERANCE = 0.02  # of the diameter: a point belongs to the copy whose surface is so near
_LEAST_VISIBLE = 0.1  # of a copy, where it is known
_LEAST_POINTS = 50  # of a crop
_LEAST_PADDED = 16_384  # of a padded crop; more than a scene has are thinned out at random, as there


@dataclass(frozen=True)
class Image:
    """One scan of copies of one object, in the camera's frame."""

    name: str
    points: Float32[np.ndarray, "n 3"]
    foreground: Bool[np.ndarray, " n"]
    T_camera_object: Float[np.ndarray, "i 4 4"]
    visible: Float[np.ndarray, " i"]  # share of each copy that is seen; NaN where it is not known


class Images(Protocol):
    """The scans of an object, each read when it is asked for."""

    def __len__(self) -> int:
        """Return how many there are, readable or not."""

    def __getitem__(self, row: int, /) -> Image:
        """Read a scan. Raises InputError if it cannot be used."""


@dataclass(frozen=True)
class ObjectImages:
    """An object and its scans."""

    name: str
    model: ObjectModel
    images: Images


@dataclass(frozen=True)
class Case:
    """A crop around a point of a copy, which is its first point, in the camera's frame."""

    name: str
    points: Float32[np.ndarray, "n 3"]
    T_camera_object: Float[np.ndarray, "i 4 4"]  # of all copies in the scan
    copy: int  # that the point is on
    visible: float

    @property
    def random_seed(self) -> int:
        """A number that is the same whenever the case is drawn."""
        return zlib.crc32(self.name.encode())


Solver: TypeAlias = Callable[[Case], Float[np.ndarray, "4 4"] | None]


class Method(Protocol):
    """What is compared: prepared once for an object, untimed, it solves case after case.

    It gets what a camera gives: the points of the crop, in the camera's frame, the seed first; and the object's points
    with their normals.
    """

    @property
    def name(self) -> str:
        """What it is called in tables."""

    @property
    def settings(self) -> Mapping[str, Any]:
        """All that decides its poses, for the record."""

    def prepare(self, model: ObjectModel) -> Solver:
        """Return what solves cases of an object whose lengths are in the cases' unit."""


def draw_cases(
    found: ObjectImages, crops: int, noise: float, random_seed: int = 0, report: Callable[[str], None] | None = None
) -> Iterator[Case]:
    """Yield so many crops of an object, evenly many of each scan, with Gaussian noise of a share of its longest side.

    The same arguments give the same cases, and the same seeds at every noise. Scans that cannot be read, or on which no
    copy can be seen, give fewer, which is reported. One scan is kept at a time.
    """
    images = found.images
    sigma = noise * float((found.model.maximum - found.model.minimum).max())
    for row in range(len(images)):
        count = crops * (row + 1) // len(images) - crops * row // len(images)
        if count == 0:
            continue
        try:
            image = images[row]
        except InputError as error:
            if report is not None:
                report(str(error))
            continue
        generator = np.random.default_rng([random_seed, zlib.crc32(image.name.encode())])
        rows, copies = _seeds(image, found.model, count, generator)
        made = 0
        for draw, (place, copy) in enumerate(zip(rows.tolist(), copies.tolist(), strict=True)):
            offsets = image.points - image.points[place]
            near = image.foreground & (np.einsum("ij,ij->i", offsets, offsets) <= found.model.diameter**2)
            near[place] = False
            points = image.points[np.concatenate([[place], np.flatnonzero(near)])]
            if len(points) < _LEAST_POINTS:
                continue
            deviation = np.random.default_rng([random_seed, draw, zlib.crc32(image.name.encode())])
            noisy = points + sigma * deviation.standard_normal(points.shape, dtype=np.float32)
            name = f"{image.name}/{draw}"
            made += 1
            yield Case(name, noisy.astype(np.float32), image.T_camera_object, copy, float(image.visible[copy]))
        if made < count and report is not None:
            why = "not enough was measured on copies that are seen (are units and poses right?)"
            report(f"{found.name}, scan {image.name}: {made} of {count} crops: {why}")


def _seeds(
    image: Image, model: ObjectModel, count: int, generator: np.random.Generator
) -> tuple[Int[np.ndarray, " s"], Int[np.ndarray, " s"]]:
    """Return rows of points on random copies of which enough is seen, and the copies."""
    open_rows = np.flatnonzero(image.foreground)
    if len(open_rows) == 0 or len(image.T_camera_object) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    drawn = generator.choice(open_rows, min(_SEED_DRAWS, len(open_rows)), replace=False)
    owner = _owners(image.points[drawn], image.T_camera_object, model)
    usable = [
        copy
        for copy in range(len(image.T_camera_object))
        if not image.visible[copy] < _LEAST_VISIBLE and (owner == copy).any()
    ]
    if not usable:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    copies = generator.permutation(np.resize(generator.permutation(usable), count))
    rows = np.array([drawn[generator.choice(np.flatnonzero(owner == copy))] for copy in copies], dtype=np.int64)
    return rows, copies


def _owners(
    points: Float32[np.ndarray, "n 3"], poses: Float[np.ndarray, "i 4 4"], model: ObjectModel
) -> Int[np.ndarray, " n"]:
    """Return the copy that each point is on, -1 if it is on none."""
    from scipy.spatial import cKDTree

    surfaces = np.concatenate([model.points @ pose[:3, :3].T + pose[:3, 3] for pose in poses])
    reach = _LABEL_TOLERANCE * model.diameter + float(np.sqrt(model.area / len(model.points)))
    distance, row = cKDTree(surfaces).query(points, distance_upper_bound=reach)
    return np.where(np.isfinite(distance), row // len(model.points), -1)


def limited(objects: Sequence[ObjectImages], names: Sequence[str]) -> list[ObjectImages]:
    """Return the objects of these names; all if none is given. Raises InputError if one is not there."""
    known = [found.name for found in objects]
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(f"no object that can be evaluated is named {', '.join(unknown)}: there are {', '.join(known)}")
    return [found for found in objects if not names or found.name in names]


def padded(points: Float32[np.ndarray, "n 3"]) -> PaddedCloud:
    """Return a crop in a capacity of few possible ones, its first point still the first."""
    if len(points) > MOST_POINTS:
        rows = 1 + np.random.default_rng(0).choice(len(points) - 1, MOST_POINTS - 1, replace=False)
        points = points[np.concatenate([[0], np.sort(rows)])]
    return pad_cloud(points, _LEAST_PADDED)
