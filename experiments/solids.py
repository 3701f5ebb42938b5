"""Simple closed solids and their unions, which the parts made by parameters are of.

A union's solids may overlap, as in CAD exports: `kmn_jax.objects.load_object` keeps the outer surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Int

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
    profile = circle(outer)[::2], circle(inner)[::2]
    stations = [(0.0, -straight), *((turn, 0.0) for turn in np.linspace(0, angle, 17)), (angle, straight)]

    def ring(outline: Float[np.ndarray, "n 2"], turn: float, along: float) -> Float[np.ndarray, "n 3"]:
        across, up = outline[:, 0] + bend, outline[:, 1]
        direction = np.array([-np.sin(turn), np.cos(turn)])
        places = np.outer(across, [np.cos(turn), np.sin(turn)]) + along * direction
        return np.column_stack([places, up])

    outside = [ring(profile[0], *station) for station in stations]
    inside = [ring(profile[1], *station) for station in reversed(stations)]
    vertices, triangles = _around(np.stack([*outside, *inside], axis=1))
    return vertices, triangles[:, ::-1]


def arc(radius: float, broad: float, thick: float, begin: float, end: float) -> Solid:
    """Return a piece of a flat ring, of which the middle of its breadth has the radius, from one angle to another."""
    inner, outer = radius - broad / 2, radius + broad / 2
    section = np.array([[inner, 0], [outer, 0], [outer, thick], [inner, thick]])
    turns = np.linspace(begin, end, _AROUND // 2)
    sides = [np.column_stack([np.outer(section[:, 0], [np.cos(turn), np.sin(turn)]), section[:, 1]]) for turn in turns]
    return swept(np.stack(sides))


def swept(sections: Float[np.ndarray, "n k 3"]) -> Solid:
    """Return what flat outlines span, each with the one after it; the first and the last are closed from their middles.

    They are counterclockwise as seen from where they begin.
    """
    first, last = (np.broadcast_to(sections[row].mean(axis=0), sections[:1].shape) for row in (0, -1))
    return _around(np.concatenate([first, sections, last]))


def torus(radius: float, around: float) -> Solid:
    """Return a ring: what a circle of the radius `around` sweeps, whose middle goes around the z axis."""
    return revolved(circle(around)[::4] + np.array([radius, 0.0]))


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


def circle(radius: float, corners: int = _AROUND) -> Float[np.ndarray, "n 2"]:
    """Return a circle; with fewer corners a regular polygon, as points at the same angles as those of the circle."""
    angles = 2 * np.pi * np.arange(_AROUND) / _AROUND
    half = np.pi / corners
    reach = radius * np.cos(half) / np.cos((angles + half) % (2 * half) - half) if corners < _AROUND else radius
    return (reach * np.stack([np.cos(angles), np.sin(angles)])).T


def rectangle(length: float, width: float) -> Float[np.ndarray, "n 2"]:
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
