"""What probabilities are fitted to: images whose truth is known, and the parts that are searched in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import count
from pathlib import Path
from threading import Lock
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Float32
from tqdm import tqdm

from experiments.bins import BinImage, TrueImage, WorldImage, bin_images, world_images
from experiments.test_sets import SPLIT
from experiments.training_parts import larger_piece
from kmn_jax.detection import Candidates, DevicePart, Scene, device_part, make_scene
from kmn_jax.errors import InputError
from kmn_jax.io import Scan
from kmn_jax.models import Model
from kmn_jax.objects import Part

Columns = dict[str, np.ndarray]  # what is known of poses, one row each
Form = Literal["image", "cloud", "cut-out"]  # what users may have: depth images, clouds, clouds of what is near copies
_FORMS: tuple[Form, ...] = get_args(Form)
_MARGINS = (0.1, 0.4)  # diameters: so much of what is around copies is left in scans that are cut out
_STRANGERS = 3  # that are searched in each image, of twice as many that are nearest in size, by turns
_MOST = 1000  # families of parts in world bins, or scenes in a folder
SEARCHED = 5, _FORMS, _MARGINS, _STRANGERS  # version of what is searched, and from where, and what decides it


@dataclass(frozen=True)
class Sources:
    """How and in which images is searched."""

    method: Literal["kmn_jax", "FPFH"] = "kmn_jax"
    bins: Path = Path("outputs/validation_bins")  # folder with datasets in BOP format
    worlds: tuple[Path, ...] = ()  # folders of world bins to fit on, too: outputs/worlds/validation and various
    known_worlds: tuple[Path, ...] = ()  # the same, of families of parts that the network, or the verifier, knows
    every: int = 1  # use every so many images of `bins`
    judge_anew: bool = False  # compute what depth images show of stored poses again, as after a change of that code


@dataclass(frozen=True)
class Search:
    """One image and the part that is searched in it. What searching takes is made when it is asked for."""

    image: TrueImage
    part: Part  # the image's own, or a stranger
    make_part: Callable[[], DevicePart]
    make_scene: Callable[[], Scene]  # raises InputError if there is nothing to search, as on an empty table
    row: int  # of all searches
    number: int  # that searches of one object, or of one family of parts, share
    is_known: bool  # whether the network, or the verifier, was trained with such parts
    name: str  # of its own, whatever else is searched

    @cached_property
    def on_device(self) -> DevicePart:
        """The part on the device."""
        return self.make_part()

    @cached_property
    def scene(self) -> Scene:
        """The scan as it is searched. Raises InputError if there is nothing to search."""
        return self.make_scene()

    @cached_property
    def is_empty(self) -> bool:
        """Whether there is nothing to search."""
        try:
            _ = self.scene
        except InputError:
            return True
        return False

    def columns(self, found: Candidates) -> Columns:
        """Return evidence, errors and object of poses."""
        poses = found.T_camera_object[found.usable]
        error = self.errors(poses, self.image.errors)
        is_own = self.part is self.image.part
        return {
            "evidence": found.evidence[found.usable],
            "error": error,
            "largest_error": self.errors(poses, self.image.largest_errors) if is_own else error,
            "object": np.full(len(poses), self.number),
            "search": np.full(len(poses), self.row),
            "narrowed": np.full(len(poses), self.scene.is_narrowed),
            "T_camera_object": poses,  # to judge it by other evidence
        }

    def errors(
        self, T_camera_object: Float32[np.ndarray, "s 4 4"], measure: Callable[[np.ndarray], np.ndarray]
    ) -> Float[np.ndarray, " s"]:
        """Return by how much poses are off the nearest copy: of a part that is not there infinitely.

        It is NaN where such a part hardly differs from the copy that it is found at: neither right nor wrong.
        """
        poses = self.scene.T_scene_camera @ T_camera_object
        if self.part is not self.image.part:
            return np.where(self.image.looks_like(self.part, poses), np.nan, np.inf)
        return measure(poses).min(axis=1, initial=np.inf)


class _Image(NamedTuple):
    """One image, and how its scan may be given."""

    folder: str  # its name
    row: int  # of its images that are used
    number: int  # see `Search`
    image: TrueImage
    scene: Callable[[Form], Scene]  # raises InputError if there is nothing to search, as on an empty table
    is_known: bool


def searches(sources: Sources, network: Model) -> Iterator[Search]:
    """Yield all images with their parts, and with some that are known not to be there, if any are.

    What is searched in vain are the parts that are nearest in size, every second one of them, those that are left out
    in the next image. The scan is given in other forms by turns, where it may be, see `_asked`.
    """
    rows = count()
    parts: dict[tuple[str, str], DevicePart] = {}
    lock = Lock()  # searches may run side by side

    def on_device(folder: str, part: Part) -> DevicePart:
        with lock:
            if (folder, part.name) not in parts:
                parts[folder, part.name] = device_part(network, part)
            return parts[folder, part.name]

    for given in _images(sources, network):
        image = given.image
        for part, form in _asked(image, given.row, given.is_known):
            yield Search(
                image,
                part,
                make_part=partial(on_device, given.folder, part),
                make_scene=partial(given.scene, form),
                row=next(rows),
                number=given.number,
                is_known=given.is_known,
                name=f"{given.folder}-{image.key.scene_id:06d}-{image.key.image_id:06d}-{part.name}-{form}",
            )


def _asked(image: TrueImage, row: int, is_known: bool) -> Iterator[tuple[Part, Form]]:
    """Yield what is searched in an image, one of many in its folder, and in which form of its scan.

    Bins are given as images. Of worlds so are the part and the first stranger, and again the part and other strangers
    in other forms; those of known parts have one form each, and one stranger: of them nothing is judged. Half of the
    cut-outs of the part itself fall on images without it, and are clouds.
    """
    parts = image.part, *image.strangers[row % 2 :: 2][:_STRANGERS]
    if not isinstance(image, WorldImage):
        yield from ((part, "image") for part in parts)
    elif is_known:
        yield from ((part, _FORMS[row % len(_FORMS)]) for part in parts[:2])
    else:
        yield from ((part, "image") for part in parts[:2])
        yield from ((part, _FORMS[(row + turn) % len(_FORMS)]) for turn, part in enumerate(parts[2:]))
        yield image.part, _FORMS[1 + row % 2]


def _images(sources: Sources, network: Model) -> Iterator[_Image]:
    worlds = [(False, world) for world in sources.worlds] + [(True, known) for known in sources.known_worlds]
    named = [_name(world) for _, world in worlds]
    if len(set(named)) < len(named):
        raise InputError(f"worlds are told apart by their folders' names, but these are {', '.join(named)}: rename one")
    folders = sorted(path for path in sources.bins.glob("*") if (path / SPLIT).is_dir())
    if not folders:
        raise InputError(f"{sources.bins} holds no datasets: python -m experiments.build_data validation-bins")
    for number, folder in enumerate(folders, start=1):
        bins = tqdm(bin_images(folder, SPLIT, network, sources.every), unit="image", desc=folder.name)
        for row, image in enumerate(bins):
            yield _Image(_name(folder), row, _MOST * number + image.key.scene_id, image, _scene_of(image), False)
    numbers: dict[str, int] = {}  # of families of parts
    for is_known, world in worlds:
        for row, found in enumerate(tqdm(world_images(world, network), unit="image", desc=f"worlds {world.name}")):
            scene = _scene_of_world(found, row)
            number = numbers.setdefault(larger_piece(found.kind), len(numbers))
            yield _Image(_name(world), row, number, found, scene, is_known)


def _name(folder: Path) -> str:
    return f"{folder.parent.name}-{folder.name}"


def _scene_of(image: BinImage) -> Callable[[Form], Scene]:
    return lambda form: image.scene


def _scene_of_world(image: WorldImage, row: int) -> Callable[[Form], Scene]:
    made: dict[Form, Scene] = {}
    lock = Lock()  # searches may run side by side

    def scene(form: Form) -> Scene:
        with lock:
            if form not in made:
                made[form] = make_scene(as_given(image, form, row), image.part.diameter)
            return made[form]

    return scene


def as_given(image: WorldImage, form: Form, random_seed: int) -> Scan:
    """Return a scan as users may have it; what has no copies to be cut out around is the cloud."""
    if form == "image":
        return image.scan
    cut = None
    if form == "cut-out":
        cut = image.cloud(np.random.default_rng(random_seed).uniform(*_MARGINS))
    return cut if cut is not None and len(cut.points) else image.cloud()
