"""World bins: scenes of many kinds under physics, to fit probabilities on and to test on, as BOP datasets.

Training (of parts that the network was trained with), verifier (of the same families of parts, but others of each),
compound (of parts that are grown together of two of them), validation, various and test differ in random seeds and in
the families of parts (`experiments.parametric_parts`), the test also in the ranges of containers. Each family of worlds
is one scene of the dataset, `worlds.json` names them; of each scene's images some show no copy of the part that is
asked for, but other parts or nothing. `test_targets_bop19.json` says which part is asked for in which image, with the
number of its copies; other parts have no entries in scene_gt.json.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np

from experiments.parametric_parts import TEST_FAMILIES, VALIDATION_FAMILIES, write_parts
from experiments.test_sets import SPLIT, claim, metric_model, write_scenes
from experiments.training_parts import COMPOUNDS, PARTS_SEED, TRAINING_FAMILIES
from experiments.various_parts import VARIOUS_FAMILIES
from kmn_jax.bop import (
    BopFrame,
    dataset_digest,
    finest_depth_scale,
    write_scene,
)
from kmn_jax.data import rendered_frame
from kmn_jax.errors import InputError
from kmn_jax.files import write_whole
from kmn_jax.objects import ObjectModel
from kmn_jax.simulate import (
    PERFECT,
    Bin,
    BinConfig,
    BinScene,
    CameraConfig,
    CollisionShape,
    Container,
    Fixture,
    RayMesh,
    SensorConfig,
    block_mesh,
    collision_shape,
    container_blocks,
    place_camera,
    rows_of,
    settle_in,
)

NAMES, TARGETS = "worlds.json", "test_targets_bop19.json"
_TURN = 3  # images that one after the other are of one sensor
_ABSENT = 4  # of so many images one shows no copy of the part that is asked for
_KINDS = 3  # of other parts in an image, those of about the size of the one that is asked for
_TRIES = 6  # of an image's container, until parts come to rest in it
_PHYSICS = BinConfig(time_cap=3.0, penetration=0.01, attempts=3)


SensorKind = Literal["perfect", "structured_light", "stereo", "time_of_flight"]


@dataclass(frozen=True)
class Family:
    """One kind of world. Lengths are in diagonals of the part that is asked for."""

    name: str
    half: tuple[float, float] = (0.9, 1.8)  # of the floor's length and width
    height: tuple[float, float] = (0.5, 1.2)  # of the walls; 0: a table
    slope: tuple[float, float] = (0.0, 0.0)
    rim: tuple[float, float] = (0.03, 0.06)
    lift: tuple[float, float] = (0.03, 0.06)
    divider: float = 0.0  # share of the images with one
    neighbour: float = 0.0  # share of the images with a second bin in view
    copies: tuple[int, int] = (3, 14)
    others: tuple[int, int] = (0, 0)  # parts of other kinds
    rows: bool = False  # parts side by side, in a container that just holds them
    distance: tuple[float, float] = (6.0, 10.0)
    tilt: tuple[float, float] = (0.0, 20.0)  # degrees
    fill: tuple[float, float] = (0.75, 0.95)
    sensor: SensorKind = "structured_light"


FAMILIES = (
    Family("plain bin", sensor="perfect"),
    Family("thick rims", rim=(0.15, 0.6), lift=(0.1, 0.3)),
    Family("tilted walls", slope=(0.2, 0.5), height=(0.4, 0.9)),
    Family("oblique camera", tilt=(30.0, 45.0)),
    Family("table", height=(0.0, 0.0), copies=(1, 7)),
    Family("tray", height=(0.08, 0.3), copies=(2, 9), rim=(0.03, 0.2)),
    Family("dividers and neighbours", divider=0.8, neighbour=0.6, half=(1.2, 2.0)),
    Family("mixed parts", others=(3, 9), copies=(2, 6)),
    Family("deep pile", half=(0.6, 0.9), height=(1.2, 2.0), copies=(14, 22)),
    Family("far camera", distance=(15.0, 28.0), fill=(0.6, 0.75)),
    Family("active stereo", sensor="stereo"),
    Family("time of flight", sensor="time_of_flight"),
    Family("touching rows", rows=True, height=(0.1, 0.4), copies=(4, 12)),
    Family("full bin", half=(1.2, 1.8), height=(1.0, 1.6), copies=(30, 70)),
)


@dataclass(frozen=True)
class Recipe:
    """What makes a set of world bins."""

    random_seed: int
    parts: tuple[str, ...]  # families of them
    wider: float  # by which factor the ranges of containers are moved, so that sets differ in them
    parts_a_family: int = 2
    images: int = 24  # of each family of worlds: with fewer, its calibration error is mostly chance
    size: tuple[int, int] = (1280, 960)  # of an image, in pixels
    families: tuple[Family, ...] = FAMILIES  # one scene each
    sensors: tuple[SensorKind, ...] = ()  # that take turns with each family's own, as in real scenes all may meet


# Of parts that the network was trained with (`build_data surfels`), for the pose verifier.
TRAINING = Recipe(PARTS_SEED, tuple(TRAINING_FAMILIES), 1.0, sensors=("stereo", "time_of_flight"))
# The same families of parts by other numbers, for the verifier, which needs more scans than parts, and for the fit of
# poses as they are found, which wants many kinds.
VERIFIER = Recipe(14, tuple(TRAINING_FAMILIES), 1.0, parts_a_family=4, sensors=TRAINING.sensors)
# Of two of these families each, as the verifier wants many kinds of parts, and such as have a piece in common.
COMPOUND = Recipe(15, tuple(COMPOUNDS), 1.0, parts_a_family=1, sensors=TRAINING.sensors)
VALIDATION = Recipe(11, VALIDATION_FAMILIES, 1.0, parts_a_family=4, images=16)
# Of twice as many families, for the fit alone: what holds of six kinds of parts need not hold of others.
VARIOUS = Recipe(16, tuple(VARIOUS_FAMILIES), 1.0, images=8)
TEST = Recipe(12, TEST_FAMILIES, 1.15)


def build_worlds(folder: Path, recipe: Recipe, workers: int | None = None) -> str:
    """Write world bins, but for scenes that exist, and return their digest.

    Raises InputError if the folder cannot be written to or holds bins of another recipe.
    """
    claim(folder, asdict(recipe))
    (folder / ".parts").mkdir(exist_ok=True)
    parts = write_parts(folder / ".parts", recipe.parts, recipe.parts_a_family, recipe.random_seed)
    numbers = range(1, len(recipe.families) + 1)
    write_scenes(folder, _write_family, dict.fromkeys(numbers, (recipe, parts)), parts, workers)
    targets = [
        target
        for number in numbers
        for target in json.loads((folder / f".targets_{number}.json").read_text(encoding="utf-8"))
    ]
    write_whole(folder / TARGETS, (json.dumps(targets, indent=1) + "\n").encode())
    names = {str(number): family.name for number, family in enumerate(recipe.families, start=1)}
    write_whole(folder / NAMES, (json.dumps(names, indent=1) + "\n").encode())
    return dataset_digest(folder)


def kind_of(name: str) -> str:
    """Return the family of a part: parts of one family may be too alike to be called others."""
    return name.rpartition("_")[0]


def sensed(family: Family, recipe: Recipe, image: int) -> Family:
    """Return a family of worlds with the sensor of one of its images."""
    sensors = (family.sensor, *recipe.sensors)
    return replace(family, sensor=sensors[image // _TURN % len(sensors)])


def has_other_parts(family: str, copies: int) -> bool:
    """Tell whether other parts, of about the same size, may lie in an image of so many copies; they have no poses."""
    return copies == 0 or any(one.others[1] for one in FAMILIES if one.name == family)


def _write_family(folder: Path, scene_id: int, recipe: Recipe, paths: list[Path]) -> None:
    """Write the images of a family of worlds, and which part is asked for in each."""
    family = recipe.families[scene_id - 1]
    rng = np.random.default_rng((recipe.random_seed, scene_id - 1))

    def loaded(row: int) -> tuple[ObjectModel, CollisionShape]:
        return _loaded(paths[row])

    frames: list[BopFrame] = []
    targets = []
    rows = rng.permutation(len(paths))
    for image in range(recipe.images):
        row = int(rows[image % len(rows)])
        size = loaded(row)[1].diagonal
        alike = sorted(range(len(paths)), key=lambda other: abs(np.log(loaded(other)[1].diagonal / size)))
        others = [other for other in alike if kind_of(paths[other].stem) != kind_of(paths[row].stem)][:_KINDS]
        absent = image % _ABSENT == _ABSENT - 1
        tries = (_image(sensed(family, recipe, image), recipe, loaded, row, others, absent, rng) for _ in range(_TRIES))
        frame = next(filter(None, tries), None)
        if frame is None:
            raise InputError(f"{family.name}: {paths[row].stem} comes to rest in none of {_TRIES} containers")
        instances = tuple(replace(instance, object_id=row + 1) for instance in frame.instances or ())
        frames.append(replace(frame, instances=instances))
        targets.append({"im_id": image, "inst_count": len(instances), "obj_id": row + 1, "scene_id": scene_id})
    write_whole(folder / f".targets_{scene_id}.json", json.dumps(targets).encode())
    farthest = max(float(frame.depth.max()) for frame in frames)
    write_scene(folder, SPLIT, scene_id, frames, "m", finest_depth_scale(farthest, "m"))


@cache  # a process writes several families of worlds, of the same parts
def _loaded(path: Path) -> tuple[ObjectModel, CollisionShape]:
    model = metric_model(path)
    return model, collision_shape(model.vertices, model.triangles)


def _image(
    family: Family,
    recipe: Recipe,
    loaded: Callable[[int], tuple[ObjectModel, CollisionShape]],
    row: int,
    others: list[int],
    absent: bool,
    rng: np.random.Generator,
) -> BopFrame | None:
    """Return one image of a family of worlds; None if parts did not come to rest."""
    model, shape = loaded(row)
    copies = 0 if absent else int(rng.integers(family.copies[0], family.copies[1] + 1))
    fewest, most = family.others
    if absent and not most:
        most = family.copies[1] // 2
    foreign = [others[k] for k in rng.integers(0, len(others), int(rng.integers(fewest, most + 1)))]
    container, starts = _container(family, recipe, rng), None
    kinds = [row] * copies + foreign
    if family.rows and copies:
        side = round(copies**0.5)
        starts, half = rows_of(shape, (side, copies // side), _PHYSICS, int(rng.integers(1 << 31)))
        container, kinds = container._replace(half=jnp.asarray(half + 0.02, dtype=jnp.float32)), [row] * len(starts)
        copies = len(starts)
    poses, inside = np.zeros((0, 4, 4)), np.zeros(0, dtype=bool)
    if kinds:
        # Lengths of the container are in diagonals of the part that is asked for, of the first one in physics.
        ratio = shape.diagonal / loaded(kinds[0])[1].diagonal
        drop = settle_in(
            [loaded(kind)[1] for kind in kinds],
            _scaled(container, ratio),
            _PHYSICS,
            int(rng.integers(1 << 31)),
            starts,
        )
        if drop.fault:
            return None
        poses, inside = drop.T_world_object, drop.inside
    own = inside[:copies]
    if copies and not own.any():
        return None
    vertices, triangles = block_mesh([block * shape.diagonal for block in container_blocks(container)])
    fixtures = [Fixture(vertices, triangles, np.eye(4)[None])]
    for kind in dict.fromkeys(kinds[copies:]):
        chosen = [number for number in range(copies, len(kinds)) if kinds[number] == kind and inside[number]]
        fixtures.append(Fixture(loaded(kind)[0].vertices, loaded(kind)[0].triangles, poses[chosen].reshape(-1, 4, 4)))
    opening = np.asarray(container.opening if float(container.height) else container.half, dtype=float)
    length, width = (2 * opening * shape.diagonal).tolist()
    bin = Bin(length, width, max(float(container.height), 0.1) * shape.diagonal, float(container.rim) * shape.diagonal)
    cameras = CameraConfig(
        *recipe.size,
        distance=family.distance,
        tilt=family.tilt[1],
        least_tilt=family.tilt[0],
        roll=180.0,
        fill=family.fill,
    )
    camera, T_camera_bin = place_camera(bin, shape.diagonal, cameras, rng)
    scene = BinScene(bin, poses[:copies][own].reshape(-1, 4, 4), camera, T_camera_bin, tuple(fixtures))
    sensor = _sensor(family, shape.diagonal, rng)
    frame = rendered_frame(RayMesh(model.vertices, model.triangles), scene, 1, sensor, rng.spawn(1)[0])
    return replace(frame, bin=None, T_camera_bin=None)


def _container(family: Family, recipe: Recipe, rng: np.random.Generator) -> Container:
    """Draw a container, in diagonals."""

    def draw(low: float, high: float) -> float:
        return float(rng.uniform(low, high)) * recipe.wider

    half = np.array([draw(*family.half), draw(*family.half)])
    height, walls = draw(*family.height), np.zeros(2)
    divided, neighbour = rng.random() < family.divider, rng.random() < family.neighbour
    if divided:
        walls[int(rng.integers(2))] = height * rng.uniform(0.3, 0.8)
    values = {
        "half": half,
        "height": height,
        "slope": draw(*family.slope),
        "rim": draw(*family.rim),
        "lift": draw(*family.lift) if height else 0.0,
        "divider": half * rng.uniform(-0.5, 0.5, 2),
        "divider_height": walls,
        "divider_width": rng.uniform(0.03, 0.12),
        "gap": rng.uniform(0.05, 0.4) if neighbour else np.inf,
    }
    return Container(**{name: jnp.asarray(value, dtype=jnp.float32) for name, value in values.items()})


def _scaled(container: Container, factor: float) -> Container:
    """Return a container whose lengths are multiplied; its slope is none."""
    scaled = Container(*(value * jnp.float32(factor) for value in container))
    return scaled._replace(slope=container.slope)


def _sensor(family: Family, diagonal: float, rng: np.random.Generator) -> SensorConfig:
    """Draw a sensor of the family's kind for a part of a diagonal, in metres."""
    strength = rng.uniform(0.5, 1.5)
    if family.sensor == "perfect":
        return PERFECT
    if family.sensor == "structured_light":
        return replace(SensorConfig.structured_light(), noise=strength * 1.5e-4 / diagonal)
    if family.sensor == "stereo":
        stereo = SensorConfig.stereo()
        return replace(stereo, noise=strength * stereo.noise, shared_noise=strength * stereo.shared_noise)
    flight, millimetres = SensorConfig.time_of_flight(), strength * 0.05 / diagonal
    return replace(flight, noise=millimetres * flight.noise, shared_noise=millimetres * flight.shared_noise)
