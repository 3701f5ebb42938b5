"""CAD parts made by parameters, to train on beside the electronic components, which are hardly ever thin or hollow.

Compounds of two of them are for the pose verifier alone, see `experiments.worlds`.

No family is one of those that world bins for validation or test are made of (`experiments.parametric_parts`). Lengths
are in millimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from experiments.solids import Solid, bent_tube, box, circle, moved, pierced, prism, rectangle, revolved, union

_UP_TO_X = (-np.pi / 2, 1)  # turns the z axis to -x
_UP_TO_Y = (np.pi / 2, 0)


def channel(rng: np.random.Generator) -> Solid:
    """A U profile."""
    length, width, height, thick = rng.uniform([25, 12, 10, 1.2], [80, 35, 30, 3.5])
    wall = box((0, 0, 0), (length, thick, height))
    return union(box((0, 0, 0), (length, width, thick)), wall, moved(wall, (0, width - thick, 0)))


def tee_profile(rng: np.random.Generator) -> Solid:
    """A piece of a T or an I profile."""
    length, width, height, thick = rng.uniform([15, 15, 12, 1.5], [60, 40, 35, 5])
    parts = [
        box((0, -width / 2, 0), (length, width / 2, thick)),
        box((0, -thick / 2, 0), (length, thick / 2, height)),
    ]
    if rng.random() < 0.5:
        upper = width * rng.uniform(0.5, 1.0)
        parts.append(box((0, -upper / 2, height - thick), (length, upper / 2, height)))
    return union(*parts)


def gear_wheel(rng: np.random.Generator) -> Solid:
    """A wheel with teeth, a bore and perhaps a hub."""
    teeth, radius, thick = int(rng.integers(10, 25)), rng.uniform(12, 30), rng.uniform(4, 10)
    bore = radius * rng.uniform(0.15, 0.45)
    angles = np.arange(4 * teeth) * (np.pi / 2 / teeth)
    lengths = radius * np.tile([1.0, 1.0, 0.84, 0.84], teeth)
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    wheel = pierced(lengths[:, None] * directions, bore * directions, 0, thick)
    if rng.random() < 0.5:
        return wheel
    hub = bore + (radius - bore) * rng.uniform(0.2, 0.5)
    return union(wheel, pierced(circle(hub), circle(bore), 0, thick * rng.uniform(1.4, 2.5)))


def pulley(rng: np.random.Generator) -> Solid:
    """A wheel with a groove around it."""
    radius, thick = rng.uniform(12, 30), rng.uniform(8, 18)
    bore, depth, edge = radius * rng.uniform(0.15, 0.5), radius * rng.uniform(0.1, 0.3), thick * rng.uniform(0.1, 0.25)
    inside = thick * rng.uniform(0.3, 0.45)
    profile = [
        (bore, 0), (radius, 0), (radius, edge), (radius - depth, inside), (radius - depth, thick - inside),
        (radius, thick - edge), (radius, thick), (bore, thick),
    ]  # fmt: skip
    return revolved(np.array(profile, dtype=float))


def cup(rng: np.random.Generator) -> Solid:
    """A cap or a beaker, narrower below, perhaps with a rim."""
    outer, height, wall = rng.uniform(10, 28), rng.uniform(8, 50), rng.uniform(1.2, 3.5)
    foot, rim = outer * rng.uniform(0.6, 1.0), outer + rng.choice([0.0, rng.uniform(2, 7)])
    profile = [
        (0, 0), (foot, 0), (outer, height - wall), (rim, height - wall), (rim, height),
        (outer - wall, height), (foot - wall, wall), (0, wall),
    ]  # fmt: skip
    return revolved(np.array(profile, dtype=float))


def pipe_tee(rng: np.random.Generator) -> Solid:
    """A pipe with a branch, square or upright, both with bores."""
    outer, length, branch = rng.uniform([6, 35, 14], [13, 75, 35])
    bore, narrower = outer * rng.uniform(0.65, 0.85), rng.uniform(0.6, 1.0)
    pipe = moved(pierced(circle(outer), circle(bore), -length / 2, length / 2), (0, 0, 0), *_UP_TO_X)
    stub = pierced(circle(outer * narrower), circle(bore * narrower), 0, outer + branch)
    return union(pipe, moved(stub, (length * rng.uniform(-0.25, 0.25), 0, 0)))


def hook(rng: np.random.Generator) -> Solid:
    """A bent rod with a block at one end."""
    bend, rod, leg = rng.uniform([7, 1.8, 5], [16, 4, 45])
    rod = min(rod, 0.6 * bend)
    arc = bent_tube(bend, rod, 0.3 * rod, rng.uniform(0.6, 1.0) * np.pi, leg)
    knob = rng.uniform(1.1, 1.8) * rod
    return union(arc, moved(box((-knob, -knob, -knob), (knob, knob, knob)), (bend, -leg, 0)))


def hinge_leaf(rng: np.random.Generator) -> Solid:
    """A plate with two knuckles along an edge."""
    length, width, thick = rng.uniform([25, 15, 1.2], [60, 35, 3])
    outer = rng.uniform(1.6, 3) * thick
    knuckle = moved(
        pierced(circle(outer), circle(0.55 * outer), 0, length * rng.uniform(0.2, 0.3)), (0, 0, 0), *_UP_TO_Y
    )
    plate = box((0.5 * outer, -length, -outer), (width, 0, thick - outer))
    return union(plate, knuckle, moved(knuckle, (0, -0.6 * length, 0)))


def clip(rng: np.random.Generator) -> Solid:
    """A sheet bent several times, each time by a right angle."""
    width, thick = rng.uniform(8, 30), rng.uniform(0.8, 2.2)
    place, along, plates = np.zeros(2), np.array([1.0, 0.0]), []
    for turn in rng.choice([-1, 1], int(rng.integers(3, 6))):
        end = place + along * rng.uniform(20, 32)
        low, high = np.minimum(place, end) - thick / 2, np.maximum(place, end) + thick / 2
        plates.append(box((low[0], -width / 2, low[1]), (high[0], width / 2, high[1])))
        place, along = end, turn * np.array([-along[1], along[0]])
    return union(*plates)


def spool(rng: np.random.Generator) -> Solid:
    """A roller between flanges of different sizes, perhaps hollow."""
    core, length, thick = rng.uniform([6, 20, 2], [14, 55, 6])
    first, second = core * rng.uniform(1.2, 2.2, 2)
    bore = core * rng.choice([0.0, rng.uniform(0.3, 0.8)])
    profile = [
        (bore, 0), (first, 0), (first, thick), (core, thick), (core, length - thick),
        (second, length - thick), (second, length), (bore, length),
    ]  # fmt: skip
    return revolved(np.array(profile, dtype=float))


def clevis(rng: np.random.Generator) -> Solid:
    """A fork: two eyes on a block, with a shank."""
    radius, reach, thick, gap = rng.uniform([7, 14, 3, 6], [14, 30, 7, 14])
    eye = moved(pierced(circle(radius), circle(radius * rng.uniform(0.4, 0.65)), 0, thick), (reach, 0, 0))
    arm = box((0, -0.8 * radius, 0), (reach - 0.7 * radius, 0.8 * radius, thick))
    block = box((-thick, -0.8 * radius, 0), (0.1, 0.8 * radius, 2 * thick + gap))
    shank = prism(circle(0.4 * (2 * thick + gap)), 0, rng.uniform(15, 45))
    shank = moved(moved(shank, (0, 0, 0), *_UP_TO_X), (-0.5 * thick, 0, thick + gap / 2))
    lift = (0, 0, thick + gap)
    return union(eye, arm, moved(eye, lift), moved(arm, lift), block, shank)


def standoff(rng: np.random.Generator) -> Solid:
    """A post of three to eight sides with a pin at one end and perhaps a bore at the other."""
    sides, radius, length = int(rng.choice([3, 4, 6, 8])), rng.uniform(5, 12), rng.uniform(12, 50)
    pin = prism(circle(radius * rng.uniform(0.35, 0.6), 24), 0.9 * length, length * rng.uniform(1.2, 1.6))
    if rng.random() < 0.5:
        return union(prism(circle(radius, sides), 0, length), pin)
    deep = length * rng.uniform(0.3, 0.7)
    bored = pierced(circle(radius, 24), circle(radius * rng.uniform(0.4, 0.75), 24), 0, deep)
    return union(bored, prism(circle(radius, 24), 0.95 * deep, length), pin)


def slotted_plate(rng: np.random.Generator) -> Solid:
    """A sheet with a rectangular window, and at times a tab that stands up."""
    length, width, thick = rng.uniform([25, 18, 1], [70, 45, 3.5])
    window = rectangle(length * rng.uniform(0.2, 0.6), width * rng.uniform(0.2, 0.6))
    aside = np.array([length, width]) * rng.uniform(-0.12, 0.12, 2)
    plate = pierced(rectangle(length, width), window + aside, 0, thick)
    if rng.random() < 0.4:
        return plate
    tab = width * rng.uniform(0.3, 0.9)
    return union(plate, box((length / 2 - thick, -tab / 2, 0), (length / 2, tab / 2, rng.uniform(6, 25))))


def housing(rng: np.random.Generator) -> Solid:
    """An open box, perhaps with feet."""
    length, width, height, wall = rng.uniform([20, 15, 8, 1.2], [70, 45, 35, 4])
    walls = pierced(rectangle(length, width), rectangle(length - 2 * wall, width - 2 * wall), 0, height)
    floor = box((-length / 2, -width / 2, 0), (length / 2, width / 2, wall))
    foot = rng.uniform(4, 12)
    feet = [
        box((x, -foot / 2, 0), (x + foot, foot / 2, wall))
        for x in (-length / 2 - foot + 0.1, length / 2 - 0.1)
        if rng.random() < 0.6
    ]
    return union(walls, floor, *feet)


def knob(rng: np.random.Generator) -> Solid:
    """A star grip on a hub, or a wing on one."""
    radius, thick, hub = rng.uniform([10, 5, 5], [24, 14, 9])
    centre = prism(circle(hub), -rng.uniform(3, 12), thick)
    count = int(rng.integers(2, 7))
    bar = box((0, -0.3 * hub, 0), (radius, 0.3 * hub, thick * rng.uniform(0.5, 1.0)))
    return union(centre, *(moved(bar, (0, 0, 0), 2 * np.pi * number / count) for number in range(count)))


def dowel(rng: np.random.Generator) -> Solid:
    """A pin with a cone at one end and a collar somewhere."""
    radius, length = rng.uniform(4, 10), rng.uniform(20, 70)
    collar, begin = radius * rng.uniform(1.0, 1.9), length * rng.uniform(0.1, 0.6)
    end, tip = begin + length * rng.uniform(0.05, 0.2), radius * rng.uniform(0.2, 0.9)
    profile = [(0, 0), (radius, 0), (radius, begin), (collar, begin), (collar, end), (radius, end)]
    profile += [(radius, 0.85 * length), (tip, length), (0, length)]
    return revolved(np.array(profile, dtype=float))


PARTS_SEED = 13  # of the parts to train on
TRAINING_FAMILIES: Mapping[str, Callable[[np.random.Generator], Solid]] = {
    build.__name__: build
    for build in (
        channel, tee_profile, gear_wheel, pulley, cup, pipe_tee, hook, hinge_leaf,
        clip, spool, clevis, standoff, slotted_plate, housing, knob, dowel,
    )
}  # fmt: skip


_SECONDS = (1, 3, 6, 10)  # of which families solids are grown onto those of one, by their distance in the list


def compound(first: str, second: str, rng: np.random.Generator) -> Solid:
    """A part of one family, always the same one, with a smaller one of another grown onto its side.

    Parts with one `first` share most of their surface, so that only what is beyond it tells one from the other.
    """
    base = TRAINING_FAMILIES[first](np.random.default_rng((PARTS_SEED, list(TRAINING_FAMILIES).index(first))))
    size = _diagonal(base[0])
    vertices, triangles = TRAINING_FAMILIES[second](rng)
    vertices = vertices * rng.uniform(0.35, 0.8) * size / _diagonal(vertices)
    place, outwards = _place_on(base, rng)
    turns = rng.permutation(np.array(list(np.ndindex(4, 4, 4))))
    root, along = _place_on((vertices, triangles), rng)
    cosines = [round(float(_turned(along[None], turn)[0] @ outwards), 6) for turn in turns]
    turn = turns[int(np.argmin(cosines))]  # of those that lay it onto the side the first
    sunk = place - 0.04 * size * outwards
    joined, faces = union(base, (_turned(vertices - root, turn) + sunk, triangles))
    return joined * rng.uniform(30, 110) / np.ptp(joined, axis=0).max(), faces


def _diagonal(vertices: Float[np.ndarray, "v 3"]) -> float:
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))


def _place_on(solid: Solid, rng: np.random.Generator) -> Float[np.ndarray, "2 3"]:
    """Return a point on the surface of a solid, and the normal there."""
    corners = solid[0][solid[1]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    row = rng.choice(len(areas), p=areas / areas.sum())
    return np.stack([rng.dirichlet(np.ones(3)) @ corners[row], normals[row] / areas[row]])


def _turned(points: Float[np.ndarray, "v 3"], quarters: Int[np.ndarray, " 3"]) -> Float[np.ndarray, "v 3"]:
    """Return points after so many quarters of a turn about each axis."""
    for axis, count in enumerate(quarters):
        points = moved((points, np.zeros((0, 3), dtype=int)), (0, 0, 0), count * np.pi / 2, axis)[0]
    return points


_WITH = "_with_"


def larger_piece(family: str) -> str:
    """Return of a family of compounds that of its larger piece, of another family itself."""
    return family.partition(_WITH)[0]


COMPOUNDS: Mapping[str, Callable[[np.random.Generator], Solid]] = {
    f"{first}{_WITH}{second}": partial(compound, first, second)
    for row, first in enumerate(TRAINING_FAMILIES)
    for second in (list(TRAINING_FAMILIES)[(row + step) % len(TRAINING_FAMILIES)] for step in _SECONDS)
}
