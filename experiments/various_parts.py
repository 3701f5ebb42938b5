"""More kinds of CAD parts made by parameters, that probabilities are fitted to: what few kinds teach holds for these.

No family is one of those that are trained with or tested on, and hardly any has the shape of one. Lengths are in
millimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from experiments.solids import Solid, arc, box, circle, moved, pierced, prism, rectangle, revolved, torus, union

_TO_MINUS_X = (-np.pi / 2, 1)  # turn and axis that take the z axis there
_TO_MINUS_Y = (np.pi / 2, 0)


def handle(rng: np.random.Generator) -> Solid:
    """A bar on two posts, each on a foot."""
    length, width, height, thick = rng.uniform([40, 7, 12, 3], [90, 14, 30, 8])
    reach = length * rng.uniform(0.3, 0.45)
    foot = union(
        prism(circle(0.3 * width), 0, height + 0.5 * thick),
        prism(circle(width * rng.uniform(0.5, 1.0)), 0, rng.uniform(1.5, 4)),
    )
    bar = box((-length / 2, -width / 2, height), (length / 2, width / 2, height + thick))
    return union(bar, moved(foot, (-reach, 0, 0)), moved(foot, (reach, 0, 0)))


def bearing_block(rng: np.random.Generator) -> Solid:
    """A foot with two holes, and a bored cylinder that lies on it."""
    radius, cell, thick = rng.uniform([9, 12, 3], [18, 22, 7])
    width = radius * rng.uniform(0.8, 1.6)
    bore = radius * rng.uniform(0.4, 0.75)
    ear = pierced(rectangle(cell, width), circle(min(cell, width) * rng.uniform(0.15, 0.3)), 0, thick)
    ring = moved(pierced(circle(radius), circle(bore), -width / 2, width / 2), (0, 0, 0), *_TO_MINUS_Y)
    body = box((-radius - 0.1, -width / 2, 0), (radius + 0.1, width / 2, thick))
    place = radius + cell / 2
    return union(body, moved(ear, (-place, 0, 0)), moved(ear, (place, 0, 0)), moved(ring, (0, 0, radius + 0.2)))


def handwheel(rng: np.random.Generator) -> Solid:
    """A rim on spokes around a hub, perhaps with a grip."""
    radius, rim, hub = rng.uniform([16, 2, 4], [40, 4.5, 8])
    spokes = int(rng.integers(2, 6))
    bar = box((0, -0.6 * rim, -0.5 * rim), (radius, 0.6 * rim, 0.5 * rim))
    parts = [
        torus(radius, rim),
        prism(circle(hub), -rim, rng.uniform(2, 5) * rim),
        *(moved(bar, (0, 0, 0), 2 * np.pi * number / spokes) for number in range(spokes)),
    ]
    if rng.random() < 0.6:
        parts.append(moved(prism(circle(0.9 * rim), 0, radius * rng.uniform(0.5, 1.0)), (radius, 0, 0)))
    return union(*parts)


def hose_fitting(rng: np.random.Generator) -> Solid:
    """A tube with barbs at one end, and a collar of six sides."""
    radius, bore, wide = rng.uniform([5, 0.4, 1.5], [10, 0.75, 2.2])
    step, collar = radius * rng.uniform([0.5, 0.6], [0.9, 1.2])
    count = int(rng.integers(2, 5))
    profile = [(bore * radius, 0.0), (radius, 0.0)]
    for number in range(count):
        low = radius * 2 + number * step
        profile += [(radius, low), (1.25 * radius, low + 0.1 * step)]
    profile += [(radius, radius * 2 + count * step), (bore * radius, radius * 2 + count * step)]
    hexagon = pierced(circle(wide * radius, 6), circle(0.9 * radius), 0.4 * radius, 0.4 * radius + collar)
    return union(revolved(np.array(profile)), hexagon)


def eye_bolt(rng: np.random.Generator) -> Solid:
    """A ring on a shank with a collar."""
    ring, thick, length = rng.uniform([9, 2, 18], [18, 5, 55])
    shank = thick * rng.uniform(0.7, 1.3)
    upright = moved(torus(ring, thick), (0, 0, 0), *_TO_MINUS_Y)
    collar = prism(circle(shank * rng.uniform(1.5, 2.2)), -ring - 1.6 * thick, -ring - 0.3 * thick)
    return union(upright, prism(circle(shank), -ring - length, -ring), collar)


def cover(rng: np.random.Generator) -> Solid:
    """A flat lid with an edge and a boss that is off its middle."""
    length, width, thick = rng.uniform([25, 18, 1.2], [65, 45, 3])
    edge, boss = rng.uniform([4, 3], [12, 8])
    rim = pierced(rectangle(length, width), rectangle(length - 2 * thick, width - 2 * thick), 0, edge)
    plate = box((-length / 2, -width / 2, 0), (length / 2, width / 2, thick))
    bored = pierced(circle(boss), circle(boss * rng.uniform(0.4, 0.7)), -rng.uniform(2, 10), 0.5 * thick)
    return union(rim, plate, moved(bored, (length * rng.uniform(0.1, 0.3), width * rng.uniform(-0.2, 0.2), 0)))


def impeller(rng: np.random.Generator) -> Solid:
    """A disc with upright blades that do not point to its middle."""
    radius, bore, thick = rng.uniform([14, 0.15, 1.5], [32, 0.35, 4])
    count, turn = int(rng.integers(4, 9)), rng.uniform(0.2, 0.9)
    blade = box((0, -0.05 * radius, 0), (radius * rng.uniform(0.45, 0.6), 0.05 * radius, rng.uniform(5, 16)))
    blade = moved(moved(blade, (0, 0, 0), turn), (1.3 * bore * radius, 0, 0.5 * thick))
    disc = pierced(circle(radius), circle(bore * radius), 0, thick)
    return union(disc, *(moved(blade, (0, 0, 0), 2 * np.pi * number / count) for number in range(count)))


def corner_joint(rng: np.random.Generator) -> Solid:
    """Two to four square or round bars of different lengths that meet in a cube."""
    half = rng.uniform(5, 10)
    bar = rng.uniform(0.55, 0.95) * half
    outline = circle(bar) if rng.random() < 0.5 else circle(bar * np.sqrt(2), 4)
    parts = [box((-half, -half, -half), (half, half, half))]
    turns = [(0.0, 0), _TO_MINUS_X, _TO_MINUS_Y, (np.pi, 0)]
    for row in rng.permutation(4)[: int(rng.integers(2, 5))]:
        parts.append(moved(prism(outline, 0, half * rng.uniform(1.8, 4.5)), (0, 0, 0), *turns[row]))
    return union(*parts)


def cam_shaft(rng: np.random.Generator) -> Solid:
    """A shaft with two or three discs that are off its axis."""
    radius, length = rng.uniform([3, 35], [7, 90])
    parts = [prism(circle(radius), 0, length)]
    for place in np.sort(rng.uniform(0.1, 0.9, int(rng.integers(2, 4)))):
        disc = radius * rng.uniform(1.5, 2.4)
        aside = rng.uniform(0.2, 0.9) * (disc - radius) * np.array([1.0, 0.0, 0.0])
        cam = moved(prism(circle(disc), 0, length * rng.uniform(0.06, 0.14)), aside)
        parts.append(moved(cam, (0, 0, place * 0.85 * length), rng.uniform(0, 2 * np.pi)))
    return union(*parts)


def saddle(rng: np.random.Generator) -> Solid:
    """A clamp for pipes: half a ring of sheet with two ears, one of them longer at times."""
    radius, width, thick = rng.uniform([8, 8, 1.2], [20, 25, 3])
    ears = radius * rng.uniform(0.7, 1.6) * np.array([1.0, rng.choice([1.0, 0.6])])
    bow = arc(radius + thick / 2, thick, width, 0, np.pi)
    first = box((-radius - ears[0], 0, 0), (-radius, thick, width))
    return union(bow, first, box((radius, 0, 0), (radius + ears[1], thick, width)))


def retaining_ring(rng: np.random.Generator) -> Solid:
    """An open flat ring with two lugs."""
    radius, broad, thick = rng.uniform([12, 2.5, 1.2], [28, 6, 3.5])
    gap = rng.uniform(0.15, 0.7)
    lug = circle(broad * rng.uniform(0.7, 1.1), 24)
    parts = [arc(radius, broad, thick, gap, 2 * np.pi - gap)]
    for turn in (gap, -gap):
        parts.append(moved(prism(lug, 0, thick), (radius * np.cos(turn), radius * np.sin(turn), 0)))
    return union(*parts)


def valve(rng: np.random.Generator) -> Solid:
    """A bored body with a flange, a port at its side, and a stem with a disc at the other."""
    radius, length, bore = rng.uniform([8, 28, 0.5], [16, 60, 0.8])
    body = pierced(circle(radius), circle(bore * radius), 0, length)
    flange = pierced(circle(radius * rng.uniform(1.2, 1.7)), circle(0.9 * radius), 0, rng.uniform(3, 6))
    reach, narrow = radius * rng.uniform(1.4, 2.4), radius * rng.uniform(0.4, 0.7)
    port = pierced(circle(narrow), circle(0.7 * narrow), 0.9 * radius, reach)
    stem = union(
        prism(circle(0.4 * narrow), 0.9 * radius, 1.1 * reach),
        prism(circle(narrow * rng.uniform(0.8, 1.8)), 0.95 * reach, 1.15 * reach),
    )
    places = length * rng.uniform(0.35, 0.75, 2)
    return union(
        body,
        flange,
        moved(port, (0, 0, places[0]), *_TO_MINUS_X),
        moved(stem, (0, 0, places[1]), -_TO_MINUS_X[0], 1),
    )


VARIOUS_FAMILIES: Mapping[str, Callable[[np.random.Generator], Solid]] = {
    build.__name__: build
    for build in (
        handle, bearing_block, handwheel, hose_fitting, eye_bolt, cover,
        impeller, corner_joint, cam_shaft, saddle, retaining_ring, valve,
    )
}  # fmt: skip
