"""Containers as blocks: solid, wound outwards, and the same surface as the surfels that training sees."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.simulate import Container, RayMesh, block_mesh, container_blocks, container_surfels


def container(**other: object) -> Container:
    values = {
        "half": [1.0, 0.8],
        "height": 0.7,
        "slope": 0.2,
        "rim": 0.1,
        "lift": 0.05,
        "divider": [0.2, 0.0],
        "divider_height": [0.4, 0.0],
        "divider_width": 0.08,
        "gap": 0.3,
    }
    return Container(*(jnp.asarray(value, dtype=jnp.float32) for value in (values | other).values()))


@pytest.mark.parametrize("other", [{}, {"gap": np.inf, "slope": 0.0}, {"height": 0.0}], ids=["all", "bin", "table"])
def test_blocks_are_closed_and_wound_outwards(other: dict[str, object]) -> None:
    for block in container_blocks(container(**other)):
        vertices, triangles = block_mesh([block])
        corners = vertices[triangles]
        outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (((corners.mean(axis=1) - vertices.mean(axis=0)) * outwards).sum(axis=1) > 0).all()
        edges = [tuple(triangle[[a, (a + 1) % 3]]) for triangle in triangles for a in range(3)]
        assert len(set(edges)) == len(edges) == 36
        assert {(b, a) for a, b in edges} == set(edges)


@pytest.mark.parametrize("other", [{}, {"slope": 0.0, "gap": np.inf}, {"height": 0.0}], ids=["all", "bin", "table"])
def test_surfels_lie_on_the_blocks(other: dict[str, object]) -> None:
    drawn = container(**other)
    points, normals, real, _ = container_surfels(drawn, jnp.array([0.3, 0.1, 0.3]), 1.5, 2000)
    mesh = RayMesh(*block_mesh(container_blocks(drawn)))
    # From a little above each surfel a ray straight down onto it meets the blocks there.
    above = np.asarray(points)[np.asarray(real)]
    out = np.asarray(normals)[np.asarray(real)]
    away = np.eye(4)
    met = []
    for point, normal in zip(above[::20], out[::20], strict=True):
        side = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0])
        side /= np.linalg.norm(side)
        away[:3, :3] = [side, np.cross(-normal, side), -normal]
        away[:3, 3] = -away[:3, :3] @ (point + 1e-3 * normal)
        depth, _ = mesh.cast(away, np.zeros(1), np.zeros(1))
        met.append(abs(float(depth[0, 0]) - 1e-3) < 5e-4)
    assert len(met) > 30
    assert np.mean(met) > 0.97  # rims of walls that lean cross at the corners
