"""Solids of known shape, as meshes wound outwards: boxes, prisms over any star-shaped outline, bodies of revolution."""

from __future__ import annotations

import itertools

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray]


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
    """Return a box between two corners."""
    vertices = np.array(list(itertools.product(*zip(low, high, strict=True))), dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return vertices, np.array([[a, *pair] for a, b, c, d in quads for pair in ((b, c), (c, d))])


def joined(*meshes: Mesh) -> Mesh:
    """Return several meshes as one, as assemblies are stored; they may overlap."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    triangles = [triangles + start for (_, triangles), start in zip(meshes, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(triangles)


def prism(outline: np.ndarray, height: float) -> Mesh:
    """Return an upright prism; all of its outline, counter-clockwise, must be seen from the outline's origin."""
    count = len(outline)
    rings = [np.insert(outline, 2, z, axis=1) for z in (-height / 2, height / 2)]
    vertices = np.concatenate([*rings, [[0, 0, -height / 2], [0, 0, height / 2]]])
    i = np.arange(count)
    j = (i + 1) % count
    walls = [np.stack([i, j, j + count], axis=1), np.stack([i, j + count, i + count], axis=1)]
    lids = [
        np.stack([j, i, 0 * i + 2 * count], axis=1),
        np.stack([i + count, j + count, 0 * i + 2 * count + 1], axis=1),
    ]
    return vertices, np.concatenate([*walls, *lids])


def ring(radii: np.ndarray) -> np.ndarray:
    """Return an outline of points at evenly spaced angles, with these distances from the origin."""
    angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
    return np.asarray(radii)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def revolution(profile: list[tuple[float, float]], sections: int = 64) -> Mesh:
    """Return the surface that pairs (radius, z), from the lowest to the highest, sweep about z."""
    radii, heights = np.array(profile, dtype=float).T
    return tube(np.tile(radii[:, None], (1, sections)), heights)


def tube(radii: np.ndarray, heights: np.ndarray) -> Mesh:
    """Return the surface between outlines one above the other: a row of radii at even angles for each height."""
    rows, sections = radii.shape
    rings = [np.insert(ring(radius), 2, z, axis=1) for radius, z in zip(radii, heights, strict=True)]
    vertices = np.concatenate(rings)
    i = np.arange(sections)
    j = (i + 1) % sections
    triangles = []
    for row in range(rows - 1):
        below, above = row * sections, (row + 1) * sections
        if radii[row].any():
            triangles.append(np.stack([i + below, j + below, j + above], axis=1))
        if radii[row + 1].any():
            triangles.append(np.stack([i + below, j + above, i + above], axis=1))
    return vertices, np.concatenate(triangles)


def torus(major: float, minor: float, sections: int, sides: int) -> Mesh:
    """Return a torus about z."""
    around, across = np.meshgrid(np.arange(sections), np.arange(sides), indexing="ij")
    phi, theta = 2 * np.pi * around / sections, 2 * np.pi * across / sides
    radius = major + minor * np.cos(theta)
    vertices = np.stack([radius * np.cos(phi), radius * np.sin(phi), minor * np.sin(theta)], axis=-1).reshape(-1, 3)
    a = around * sides + across
    b = (around + 1) % sections * sides + across
    c = (around + 1) % sections * sides + (across + 1) % sides
    d = around * sides + (across + 1) % sides
    return vertices, np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


def volume(mesh: Mesh) -> float:
    """Return the volume within a closed mesh; negative if it is wound inwards."""
    corners = mesh[0][mesh[1]]
    return float(np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def area(mesh: Mesh) -> float:
    corners = mesh[0][mesh[1]]
    return float(
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    )
