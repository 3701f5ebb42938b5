"""Which surfels are visible: against formulas, the rendering, and rays through one open3d scene of all copies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kmn_jax.geometry import Camera
from kmn_jax.simulate import Bin, BinScene, RayMesh, pack_bits, render, visible_bin_surfels, visible_surfels
from kmn_jax.simulate._raycast import hidden_from
from tests.reference.meshes import (
    CAMERA,
    TOP,
    WIDE,
    box,
    bracket,
    camera_scene,
    directions,
    pile,
    plain_scene,
    pose,
    sphere,
    square,
    surface_points,
    without_bin,
)


def test_surfels_of_a_sphere_are_visible_up_to_the_horizon() -> None:
    mesh, distance = sphere(0.5, 4), 4.0
    points, normals = surface_points(mesh, 4000)
    found = visible_surfels(RayMesh(*mesh), camera_scene([pose((0, 0, distance))], WIDE), points, normals)
    # Triangles are 0.04 wide: those whose corners lie on both sides of the horizon may fall to either.
    horizon = -(0.5**2) / distance
    assert found[0][points[:, 2] < horizon - 0.04].all()
    assert not found[0][points[:, 2] > horizon + 0.04].any()


@pytest.mark.parametrize("degrees", [45.0, 80.0, 88.0, 89.5])
@pytest.mark.parametrize("bits", [None, 16])
def test_no_surfel_hides_behind_its_own_surface(degrees: float, bits: int | None) -> None:
    # Three faces of a cube look at the camera, two of them nearly edge-on, with coordinates as a pack rounds them.
    mesh = box(0.6, 0.6, 0.6)
    points, normals = surface_points(mesh, 3000)
    if bits:
        points = np.round(points / (1.04 / 2**bits)) * (1.04 / 2**bits)
    angle = np.radians(degrees)
    R = np.array([[np.sin(angle), 0, np.cos(angle)], [0, 1, 0], [-np.cos(angle), 0, np.sin(angle)]])
    scene = camera_scene([pose((0, 0, 8), R)], WIDE)
    found = visible_surfels(RayMesh(*mesh), scene, points, normals)[0]
    at = points @ R.T + [0, 0, 8]
    facing = (at * (normals @ R.T)).sum(axis=1) < 0
    np.testing.assert_array_equal(found, facing)


@pytest.mark.parametrize("seed", range(2))
def test_surfels_agree_with_the_rendering_away_from_edges(seed: int) -> None:
    from scipy.ndimage import maximum_filter, minimum_filter

    scene, mesh = pile(8, WIDE, seed), bracket()
    ready = RayMesh(*mesh)
    picture = render(ready, scene)
    points, normals = surface_points(mesh, 3000, seed)
    found = visible_surfels(ready, scene, points, normals)
    even = maximum_filter(picture.instances, 3) == minimum_filter(picture.instances, 3)
    spread = [
        maximum_filter(part, 3) - minimum_filter(part, 3)
        for part in (picture.depth, *np.moveaxis(picture.normals, -1, 0))
    ]
    even &= (spread[0] < 0.05) & (np.max(spread[1:], axis=0) < 1e-4)
    cloud = directions(WIDE) * picture.depth[..., None]
    compared = 0
    for number, T in enumerate(scene.T_camera_object):
        at = points @ T[:3, :3].T + T[:3, 3]
        cosine = -(at * (normals @ T[:3, :3].T)).sum(axis=1) / np.linalg.norm(at, axis=1)
        facing = cosine > 0
        column, row = (np.round(WIDE.fx * at[:, :2] / at[:, 2:] + [WIDE.cx, WIDE.cy])).astype(int).T
        inside = (column >= 0) & (column < WIDE.width) & (row >= 0) & (row < WIDE.height)
        assert not found[number][~inside | ~facing].any()
        rows = np.flatnonzero(inside & (cosine > 0.2))  # what is slanted more may be a sliver between pixel centres
        rows = rows[even[row[rows], column[rows]]]
        # What the picture shows there is the surfel's own face if it lies in the surfel's plane.
        off_plane = ((cloud[row[rows], column[rows]] - at[rows]) * (normals[rows] @ T[:3, :3].T)).sum(axis=1)
        seen = (picture.instances[row[rows], column[rows]] == number) & (np.abs(off_plane) < 1e-4)
        np.testing.assert_array_equal(found[number][rows], seen)
        compared += len(rows)
    assert compared > 4000


@pytest.mark.parametrize("seed", range(2))
def test_surfels_agree_with_rays_through_one_open3d_scene(seed: int) -> None:
    scene, mesh = pile(8, WIDE, seed), bracket()
    caster = plain_scene(mesh, scene)
    points, normals = surface_points(mesh, 3000, seed)
    found = visible_surfels(RayMesh(*mesh), scene, points, normals)
    for number, T in enumerate(scene.T_camera_object):
        at = points @ T[:3, :3].T + T[:3, 3]
        cosine = -(at * (normals @ T[:3, :3].T)).sum(axis=1) / np.linalg.norm(at, axis=1)
        pixels = WIDE.fx * at[:, :2] / at[:, 2:] + [WIDE.cx, WIDE.cy]
        seen = (cosine > 0) & (pixels > -0.5).all(axis=1) & (pixels < np.array([399.5, 299.5])).all(axis=1)
        rays = np.concatenate([np.zeros_like(at), at], axis=1).astype(np.float32)
        shortened = 1 - 2e-4 * np.linalg.norm(np.ptp(mesh[0], axis=0)) / (np.abs(cosine) * np.linalg.norm(at, axis=1))
        seen &= caster.cast_rays(rays, nthreads=1)["t_hit"].numpy() > shortened
        np.testing.assert_array_equal(found[number], seen)
        assert 0.02 < seen.mean() < 0.7


def test_surfels_out_of_the_picture_or_behind_the_bin_are_not_visible() -> None:
    mesh = square(1.0)
    points, _ = surface_points(mesh, 2000)
    normals = np.broadcast_to([0.0, 0, 1], points.shape)
    ready, camera = RayMesh(*mesh), Camera(fx=100.0, fy=100.0, cx=49.5, cy=49.5, width=100, height=100)
    scene = BinScene(Bin(40.0, 40.0, 1.0, 0.1), pose((2.5, 0, 1))[None], camera, pose((0, 0, 6), TOP))
    # At depth 5 the picture ends 2.5 to the right of its centre.
    np.testing.assert_array_equal(visible_surfels(ready, scene, points, normals)[0], points[:, 0] < 0)
    below = replace(scene, T_bin_object=pose((0, 0, -0.5))[None])
    assert not visible_surfels(ready, below, points, normals).any()
    assert visible_surfels(ready, without_bin(below), points, normals).all()
    assert not visible_surfels(ready, scene, points, -normals).any()


def test_a_wall_hides_as_much_of_the_floor_as_trigonometry_says() -> None:
    # From 45 degrees a wall of height 1 hides what lies less than 1 behind it, but for the perspective.
    bin = Bin(4.0, 4.0, 1.0, 0.1)
    half = np.sqrt(0.5)
    R = np.array([[0, 1, 0], [half, 0, -half], [-half, 0, -half]])  # camera at (+c, 0, +c) looks at the origin
    camera = Camera(fx=100.0, fy=100.0, cx=99.5, cy=99.5, width=200, height=200)
    scene = BinScene(bin, np.zeros((0, 4, 4)), camera, pose((0, 0, 20), R))
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2, 2, (2000, 2)), np.zeros(2000)])
    normals = np.broadcast_to([0.0, 0, 1], points.shape)
    found = visible_bin_surfels(RayMesh(*bracket()), scene, points, normals)
    eye = 20 * half
    # The line from the eye over the inner rim (2, 1) meets the floor here:
    limit = 2 - (eye - 2) / (eye - 1)
    np.testing.assert_array_equal(found, points[:, 0] < limit)


def test_what_is_hidden_from_another_eye() -> None:
    # A box of side 1 before the camera; an eye beside it sees past the box where the camera does not.
    mesh, scene = RayMesh(*box(1.0, 1.0, 1.0)), camera_scene([pose((0, 0, 5))], CAMERA)
    facing = np.broadcast_to([0.0, 0, -1], (4, 3))

    def hidden(points: list[list[float]], eye: list[float]) -> list[bool]:
        return hidden_from(mesh, scene, np.array(points), facing, np.array(eye)).tolist()

    assert hidden([[0, 0, 10], [0, 0, 3], [4, 0, 10], [1.2, 0, 10]], [0.0, 0, 0]) == [True, False, False, False]
    # From (5, 0, 0) the ray to (0, 0, 10) passes the box at x = 2.5, that to (-5, 0, 10) goes through it.
    others = [[0, 0, 10.0], [-5, 0, 10], [-4, 0, 10], [-2, 0, 10]]
    assert hidden(others, [5.0, 0, 0]) == [False, True, True, False]
    assert hidden(others, [5.0, 0, 20]) == [True] * 4  # it is behind the points, which face the camera
    assert hidden(others, [0.0, 0, 5]) == [True] * 4  # it is shut in by the box


def test_bits_are_in_little_order() -> None:
    flags = np.zeros((2, 12), dtype=bool)
    flags[0, 0] = flags[0, 9] = flags[1, 7] = True
    assert pack_bits(flags).tolist() == [[1, 2], [128, 0]]
    back = np.unpackbits(pack_bits(flags), axis=-1, count=12, bitorder="little").astype(bool)
    np.testing.assert_array_equal(back, flags)
