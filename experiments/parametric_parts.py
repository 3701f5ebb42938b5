"""CAD parts made by parameters: sheets, rings, nuts, bolts, brackets, hollow parts, for the world bins.

Lengths are in millimetres, longest extents from 20 to 120. Validation, `experiments.various_parts`, test and training
(`experiments.training_parts`, with compounds of it) share no family, but each has thin, flat, round, hollow and
many-sided parts, so that what is chosen on one is asked for by the other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments.solids import Solid, bent_tube, box, circle, moved, pierced, prism, rectangle, revolved, union
from experiments.training_parts import COMPOUNDS, TRAINING_FAMILIES
from experiments.various_parts import VARIOUS_FAMILIES
from kmn_jax.files import write_whole


def washer(rng: np.random.Generator) -> Solid:
    """A flat ring."""
    outer = rng.uniform(12, 30)
    return pierced(circle(outer), circle(outer * rng.uniform(0.4, 0.7)), 0, rng.uniform(2, 5))


def stepped_shaft(rng: np.random.Generator) -> Solid:
    """A shaft of four diameters."""
    radii = rng.permutation([1.0, 0.75, 0.6, 0.85]) * rng.uniform(5, 11)
    ends = np.concatenate([[0], np.cumsum(rng.uniform(0.6, 1.5, 4) * rng.uniform(10, 20))])
    profile = [(0.0, 0.0)]
    for radius, low, high in zip(radii, ends[:-1], ends[1:], strict=True):
        profile += [(radius, low), (radius, high)]
    return revolved(np.array([*profile, (0.0, ends[-1])]))


def angle_bracket(rng: np.random.Generator) -> Solid:
    """Two plates at a right angle, each with a hole, and a rib."""
    width, thick = rng.uniform(20, 35), rng.uniform(3, 5)
    foot, wall = rng.uniform(30, 50), rng.uniform(25, 60)
    hole = circle(width * rng.uniform(0.15, 0.25))
    flat = pierced(rectangle(foot, width), hole + np.array([foot * 0.15, 0]), 0, thick)
    plate = pierced(rectangle(wall, width), hole + np.array([wall * 0.15, 0]), 0, thick)
    upright = moved(plate, (0, 0, wall / 2), -np.pi / 2, 1)
    rib = prism(np.array([[0.0, 0.0], [foot * 0.4, 0.0], [0.0, wall * 0.4]]), -thick / 2, thick / 2)
    rib = moved(rib, (0, 0, 0), np.pi / 2, 0)
    return union(moved(flat, (foot / 2, 0, 0)), upright, moved(rib, (thick / 2, 0, thick / 2)))


def perforated_plate(rng: np.random.Generator) -> Solid:
    """A sheet with two or three holes in a row, of different sizes."""
    cell, width, thick = rng.uniform(20, 32), rng.uniform(20, 40), rng.uniform(1.5, 3)
    count = int(rng.integers(2, 4))
    return union(
        *(
            moved(
                pierced(rectangle(cell, width), circle(min(cell, width) * rng.uniform(0.15, 0.4)), 0, thick),
                (number * cell, 0, 0),
            )
            for number in range(count)
        )
    )


def flanged_tube(rng: np.random.Generator) -> Solid:
    """A coupling: a hollow tube with a flange."""
    outer, length = rng.uniform(9, 18), rng.uniform(25, 60)
    inner, flange, thick = outer * rng.uniform(0.6, 0.8), outer * rng.uniform(1.4, 1.9), rng.uniform(3, 7)
    profile = [(inner, 0), (flange, 0), (flange, thick), (outer, thick), (outer, length), (inner, length)]
    return revolved(np.array(profile, dtype=float))


def lever(rng: np.random.Generator) -> Solid:
    """A connecting rod: two eyes of different sizes, and a bar between them."""
    large, length = rng.uniform(10, 16), rng.uniform(45, 80)
    small, height = large * rng.uniform(0.5, 0.8), rng.uniform(5, 9)
    bores = large * rng.uniform(0.5, 0.7), small * rng.uniform(0.4, 0.65)
    begin, end = bores[0] + 0.3 * (large - bores[0]), length - 1.2 * bores[1]
    bar = box((begin, -0.5 * small, 0.2 * height), (end, 0.5 * small, 0.7 * height))
    radii = zip((large, small), bores, strict=True)
    eyes = [pierced(circle(radius), circle(bore), 0, height) for radius, bore in radii]
    return union(eyes[0], moved(eyes[1], (length, 0, 0)), bar)


def hex_nut(rng: np.random.Generator) -> Solid:
    """A nut with a smooth bore."""
    size = rng.uniform(11, 22)
    return pierced(circle(size, 6), circle(size * rng.uniform(0.45, 0.62)), 0, size * rng.uniform(0.6, 1.0))


def hex_bolt(rng: np.random.Generator) -> Solid:
    """A bolt with a hexagonal head and a smooth shank."""
    size = rng.uniform(7, 12)
    shank, length = size * rng.uniform(0.5, 0.6), size * rng.uniform(3, 6)
    return union(prism(circle(size, 6), 0, 0.7 * size), prism(circle(shank), 0.6 * size, length))


def bent_sheet(rng: np.random.Generator) -> Solid:
    """A sheet bent to a Z."""
    width, thick = rng.uniform(18, 35), rng.uniform(1.5, 3)
    low, web, high = rng.uniform(12, 25), rng.uniform(14, 30), rng.uniform(15, 35)
    plates = [
        box((-low, -width / 2, 0), (thick, width / 2, thick)),
        box((0, -width / 2, 0), (thick, width / 2, web)),
        box((0, -width / 2, web - thick), (high, width / 2, web)),
    ]
    return union(*plates)


def elbow(rng: np.random.Generator) -> Solid:
    """A hollow pipe bend with straight ends."""
    outer = rng.uniform(8, 14)
    bend, inner, straight = outer * rng.uniform([1.6, 0.72, 0.8], [2.4, 0.85, 2.0])
    return bent_tube(bend, outer, inner, np.radians(rng.choice([45.0, 60.0, 90.0])), straight)


def mug(rng: np.random.Generator) -> Solid:
    """A cup with a floor and a handle."""
    outer, height = rng.uniform(16, 26), rng.uniform(30, 55)
    wall = rng.uniform(2, 3.5)
    inner = outer - wall
    cup = np.array([(0.0, 0.0), (outer, 0), (outer, height), (inner, height), (inner, wall), (0, wall)])
    grip, reach = rng.uniform(2.5, 4), 0.3 * height
    arc, triangles = bent_tube(reach, grip, 0.4 * grip, np.pi, 0.3 * wall)
    upright = arc[:, [1, 2, 0]], triangles  # it opens towards the cup
    return union(revolved(cup), moved(upright, (outer - wall / 2, 0, height / 2)))


def flange_motor(rng: np.random.Generator) -> Solid:
    """A round body on a square flange with a shaft that is off its axis, and a connector block."""
    body, length = rng.uniform(12, 20), rng.uniform(25, 45)
    flange, thick = body * rng.uniform(2.0, 2.5), rng.uniform(3, 6)
    shaft = body * rng.uniform(0.2, 0.3)
    aside = body * rng.uniform(0.15, 0.4)
    return union(
        prism(rectangle(flange, flange * rng.uniform(0.8, 1.0)), 0, thick),
        prism(circle(body), -length, 0.5 * thick),
        moved(prism(circle(shaft), 0, thick + body * rng.uniform(0.7, 1.2)), (aside, 0, 0)),
        box((0.7 * body, -0.35 * body, -0.9 * length), (1.3 * body, 0.35 * body, -0.5 * length)),
    )


FAMILIES: Mapping[str, Callable[[np.random.Generator], Solid]] = {  # places are seeds: new ones come last
    build.__name__: build
    for build in (
        washer, stepped_shaft, angle_bracket, perforated_plate, flanged_tube, lever,
        hex_nut, hex_bolt, bent_sheet, elbow, mug, flange_motor,
    )
} | dict(TRAINING_FAMILIES) | dict(COMPOUNDS) | dict(VARIOUS_FAMILIES)  # fmt: skip
VALIDATION_FAMILIES = ("washer", "stepped_shaft", "angle_bracket", "perforated_plate", "flanged_tube", "lever")
TEST_FAMILIES = ("hex_nut", "hex_bolt", "bent_sheet", "elbow", "mug", "flange_motor")


def write_parts(folder: Path, families: Sequence[str], count: int, random_seed: int) -> list[Path]:
    """Write `count` parts of each family as binary STL files; the same arguments give the same bytes."""
    import trimesh

    paths = []
    for family in families:
        number_of_family = list(FAMILIES).index(family)
        for number in range(count):
            vertices, triangles = FAMILIES[family](np.random.default_rng((random_seed, number_of_family, number)))
            content = trimesh.Trimesh(vertices, triangles, process=False).export(file_type="stl")
            paths.append(folder / f"{family}_{number}.stl")
            write_whole(paths[-1], content)
    return paths
