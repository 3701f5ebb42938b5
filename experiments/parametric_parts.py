"""CAD parts made by parameters: sheets, rings, nuts, bolts, brackets, hollow parts, for the world bins.

A part is a union of closed solids that may overlap, as CAD exports often are; `kmn_jax.objects.load_object` keeps the
outer surface. Lengths are in millimetres, longest extents from 20 to 120. Validation and test share no family, but each
has thin, flat, round, hollow and many-sided parts, so that what is chosen on one is asked for by the other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Int

from kmn_jax.files import write_whole

Solid: TypeAlias = tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]]

_AROUND = 48  # corners of a circle; a multiple of 4 and of 6


def box(low: Sequence[float], high: Sequence[float]) -> Solid:
    """Return a box."""
    (x, y, z), (u, v, w) = low, high
    return prism(np.array([[x, y], [u, y], [u, v], [x, v]]), z, w)


def prism(outline: Float[np.ndarray, "n 2"], low: float, high: float) -> Solid:
    """Return an upright prism; its counterclockwise outline is seen whole from the mean of its corners."""
    count = len(outline)
    middle = outline.mean(axis=0)
    vertices = np.concatenate(
        [np.column_stack([np.vstack([outline, middle]), np.full(count + 1, z)]) for z in (low, high)]
    )
    here = np.arange(count)
    after = (here + 1) % count
    up = count + 1
    sides = np.concatenate([np.column_stack([here, after, up + after]), np.column_stack([here, up + after, up + here])])
    caps = [
        np.column_stack([after, here, np.full(count, count)]),
        np.column_stack([up + here, up + after, np.full(count, up + count)]),
    ]
    return vertices, np.concatenate([sides, *caps])


def pierced(outline: Float[np.ndarray, "n 2"], hole: Float[np.ndarray, "n 2"], low: float, high: float) -> Solid:
    """Return an upright prism with a hole through it; corners of both outlines belong together in pairs."""
    profile = [(outline, low), (outline, high), (hole, high), (hole, low)]
    rings = [np.column_stack([ring, np.full(len(ring), z)]) for ring, z in profile]
    return _around(np.stack(rings, axis=1))


def revolved(profile: Float[np.ndarray, "k 2"]) -> Solid:
    """Return what a closed profile of radii and heights, counterclockwise, sweeps around the z axis."""
    angles = 2 * np.pi * np.arange(_AROUND) / _AROUND
    radius, height = profile.T
    rings = np.stack(
        [
            np.outer(np.cos(angles), radius),
            np.outer(np.sin(angles), radius),
            np.broadcast_to(height, (_AROUND, len(height))),
        ],
        axis=2,
    )
    return _around(rings)


def bent_tube(bend: float, outer: float, inner: float, angle: float, straight: float) -> Solid:
    """Return a hollow tube, straight, bent by an angle around a radius, and straight again."""
    profile = _circle(outer)[::2], _circle(inner)[::2]
    stations = [(0.0, -straight), *((turn, 0.0) for turn in np.linspace(0, angle, 17)), (angle, straight)]

    def ring(circle: Float[np.ndarray, "n 2"], turn: float, along: float) -> Float[np.ndarray, "n 3"]:
        across, up = circle[:, 0] + bend, circle[:, 1]
        direction = np.array([-np.sin(turn), np.cos(turn)])
        places = np.outer(across, [np.cos(turn), np.sin(turn)]) + along * direction
        return np.column_stack([places, up])

    outside = [ring(profile[0], *station) for station in stations]
    inside = [ring(profile[1], *station) for station in reversed(stations)]
    vertices, triangles = _around(np.stack([*outside, *inside], axis=1))
    return vertices, triangles[:, ::-1]


def moved(solid: Solid, offset: Sequence[float], turn: float = 0.0, axis: int = 2) -> Solid:
    """Return a solid turned about an axis of its frame, then moved."""
    rotation = np.eye(3)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    rotation[[a, a, b, b], [a, b, a, b]] = [np.cos(turn), -np.sin(turn), np.sin(turn), np.cos(turn)]
    return solid[0] @ rotation.T + offset, solid[1]


def union(*solids: Solid) -> Solid:
    """Return solids as one mesh."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in solids)])
    triangles = [faces + start for (_, faces), start in zip(solids, starts[:-1], strict=True)]
    return np.concatenate([vertices for vertices, _ in solids]), np.concatenate(triangles)


def _circle(radius: float, corners: int = _AROUND) -> Float[np.ndarray, "n 2"]:
    """Return a circle; with fewer corners a regular polygon, as points at the same angles as those of the circle."""
    angles = 2 * np.pi * np.arange(_AROUND) / _AROUND
    half = np.pi / corners
    reach = radius * np.cos(half) / np.cos((angles + half) % (2 * half) - half) if corners < _AROUND else radius
    return (reach * np.stack([np.cos(angles), np.sin(angles)])).T


def _rectangle(length: float, width: float) -> Float[np.ndarray, "n 2"]:
    """Return a rectangle as points at the angles of those of a circle, its corners among them."""
    quarter = np.linspace(-1, 1, _AROUND // 4, endpoint=False)
    ones = np.ones_like(quarter)
    sides = [(ones, quarter), (-quarter, ones), (-ones, -quarter), (quarter, -ones)]
    corners = np.concatenate([np.column_stack(side) for side in sides]) * [length / 2, width / 2]
    return np.roll(corners, -_AROUND // 8, axis=0)


def _around(rings: Float[np.ndarray, "n k 3"]) -> Solid:
    """Return the surface over a grid of n x k points that closes up in both directions; equal points become one."""
    count, around = rings.shape[:2]
    index = np.arange(count * around).reshape(count, around)
    right = np.roll(index, -1, axis=0)
    quads = np.stack([index, right, np.roll(right, -1, axis=1), np.roll(index, -1, axis=1)], axis=2).reshape(-1, 4)
    vertices, rows = np.unique(np.round(rings.reshape(-1, 3), 9), axis=0, return_inverse=True)
    triangles = rows.reshape(-1)[np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])]
    proper = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return vertices, triangles[proper]


def washer(rng: np.random.Generator) -> Solid:
    """A flat ring."""
    outer = rng.uniform(12, 30)
    return pierced(_circle(outer), _circle(outer * rng.uniform(0.4, 0.7)), 0, rng.uniform(2, 5))


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
    hole = _circle(width * rng.uniform(0.15, 0.25))
    flat = pierced(_rectangle(foot, width), hole + np.array([foot * 0.15, 0]), 0, thick)
    plate = pierced(_rectangle(wall, width), hole + np.array([wall * 0.15, 0]), 0, thick)
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
                pierced(_rectangle(cell, width), _circle(min(cell, width) * rng.uniform(0.15, 0.4)), 0, thick),
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
    eyes = [pierced(_circle(radius), _circle(bore), 0, height) for radius, bore in radii]
    return union(eyes[0], moved(eyes[1], (length, 0, 0)), bar)


def hex_nut(rng: np.random.Generator) -> Solid:
    """A nut with a smooth bore."""
    size = rng.uniform(11, 22)
    return pierced(_circle(size, 6), _circle(size * rng.uniform(0.45, 0.62)), 0, size * rng.uniform(0.6, 1.0))


def hex_bolt(rng: np.random.Generator) -> Solid:
    """A bolt with a hexagonal head and a smooth shank."""
    size = rng.uniform(7, 12)
    shank, length = size * rng.uniform(0.5, 0.6), size * rng.uniform(3, 6)
    return union(prism(_circle(size, 6), 0, 0.7 * size), prism(_circle(shank), 0.6 * size, length))


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
        prism(_rectangle(flange, flange * rng.uniform(0.8, 1.0)), 0, thick),
        prism(_circle(body), -length, 0.5 * thick),
        moved(prism(_circle(shaft), 0, thick + body * rng.uniform(0.7, 1.2)), (aside, 0, 0)),
        box((0.7 * body, -0.35 * body, -0.9 * length), (1.3 * body, 0.35 * body, -0.5 * length)),
    )


FAMILIES: Mapping[str, Callable[[np.random.Generator], Solid]] = {
    build.__name__: build
    for build in (
        washer, stepped_shaft, angle_bracket, perforated_plate, flanged_tube, lever,
        hex_nut, hex_bolt, bent_sheet, elbow, mug, flange_motor,
    )
}  # fmt: skip
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
