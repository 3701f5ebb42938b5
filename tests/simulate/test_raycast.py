"""Renderings of scenes with known pictures, against formulas and against one open3d scene of all copies."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera, depth_to_points
from kmn_jax.simulate import Bin, BinScene, RayMesh, render, visible_bin_surfels, visible_surfels
from kmn_jax.simulate._raycast import Rendering, bin_triangles
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
    without_bin,
)


def same(first: Rendering, second: Rendering) -> bool:
    names = ("depth", "instances", "normals", "visible_pixels", "total_pixels", "total_boxes")
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in names)


@pytest.mark.parametrize("unit", [1.0, 1000.0, 0.001])
def test_a_tilted_plane_has_its_exact_depth_and_normal_in_any_unit(unit: float) -> None:
    angle = np.radians(35)
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    vertices, triangles = square(20 * unit)
    found = render(RayMesh(vertices, triangles), camera_scene([pose((0, 0, 5 * unit), R)], CAMERA))
    normal = R[:, 2]
    expected = 5 * unit * normal[2] / (directions(CAMERA) @ normal)
    np.testing.assert_allclose(found.depth, expected, rtol=2e-6)
    np.testing.assert_allclose(found.normals, np.broadcast_to(-normal, found.normals.shape), atol=1e-6)
    # Half a pixel off is a thousand times that.
    shifted = 5 * unit * normal[2] / ((directions(CAMERA) + np.array([0.5 / CAMERA.fx, 0, 0])) @ normal)
    assert np.abs(shifted / expected - 1).min() > 1e-3


def test_pixel_centres_have_integer_coordinates() -> None:
    # The face at depth 4 covers columns 10.25 to 20.75 and rows 30.6 to 35.4.
    camera = Camera(fx=100.0, fy=100.0, cx=0.0, cy=0.0, width=40, height=50)
    extent = (10.5 * 4 / 100, 4.8 * 4 / 100, 0.01)
    center = (15.5 * 4 / 100, 33 * 4 / 100, 4.005)
    found = render(RayMesh(*box(*extent)), camera_scene([pose(center)], camera))
    rows, columns = np.nonzero(found.instances == 0)
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (11, 20, 31, 35)
    assert found.total_boxes.tolist() == [[11, 31, 10, 5]]
    assert found.visible_pixels.tolist() == found.total_pixels.tolist() == [50]
    np.testing.assert_allclose(found.depth[31:36, 11:21], 4, rtol=1e-6)
    assert (found.depth > 0).sum() == 50
    assert (found.instances == -1).sum() == 40 * 50 - 50
    assert not found.normals[found.instances == -1].any()


def test_a_sphere_has_the_depth_and_silhouette_of_one() -> None:
    radius, distance = 0.5, 3.0
    found = render(RayMesh(*sphere(radius, 6)), camera_scene([pose((0, 0, distance))], WIDE))
    along = directions(WIDE)
    square_length = (along**2).sum(axis=-1)
    discriminant = distance**2 - square_length * (distance**2 - radius**2)
    expected = (distance - np.sqrt(np.maximum(discriminant, 0))) / square_length
    # The mesh lies inside the sphere by up to 5e-5 radii, which slant makes larger towards the rim.
    inner = discriminant > 0.1 * distance**2 * radius**2
    np.testing.assert_allclose(found.depth[inner], expected[inner], atol=5e-4 * radius)
    assert abs(found.total_pixels[0] - (discriminant >= 0).sum()) < 0.01 * found.total_pixels[0]
    centre = found.depth[149:151, 199:201]
    np.testing.assert_allclose(centre, distance - radius, rtol=1e-4)


def test_a_copy_half_behind_another_is_half_visible() -> None:
    # A plate of 4 x 2: at depth 10 it covers columns 30 to 69 and rows 40 to 59, at depth 5, moved by -2, columns -30
    # to 49 and rows 30 to 69.
    camera = Camera(fx=100.0, fy=100.0, cx=49.5, cy=49.5, width=100, height=100)
    mesh = RayMesh(*box(4.0, 2.0, 0.002))
    behind, before = pose((0, 0, 10.001)), pose((-2, 0, 5.001))
    for order in ([0, 1], [1, 0]):
        poses = [[behind, before][number] for number in order]
        found = render(mesh, camera_scene(poses, camera))
        first, second = order.index(0), order.index(1)
        assert found.total_pixels[[first, second]].tolist() == [800, 3200]
        assert found.visible_pixels[[first, second]].tolist() == [400, 2000]
        assert found.visible_fraction[[first, second]].tolist() == [0.5, 0.625]
        assert found.total_boxes[[first, second]].tolist() == [[30, 40, 40, 20], [-30, 30, 80, 40]]
        expected = np.full((100, 100), -1)
        expected[40:60, 30:70] = first
        expected[30:70, :50] = second
        np.testing.assert_array_equal(found.instances, expected)
        np.testing.assert_allclose(found.depth[expected == first], 10, rtol=1e-6)
        np.testing.assert_allclose(found.depth[expected == second], 5, rtol=1e-6)


def test_copies_beyond_the_picture_are_not_seen() -> None:
    camera = Camera(fx=100.0, fy=100.0, cx=49.5, cy=39.5, width=100, height=80)
    mesh = RayMesh(*box(1.0, 1.0, 0.002))  # 10 x 10 pixels at depth 10
    beside = [(-8, 0), (8, 0), (0, -7), (0, 7)]
    poses = [pose((x, y, 10.001)) for x, y in beside]
    poses += [pose((0, 0, -10)), pose((40, 0, 10.001)), pose((5, 0, 10.001))]
    found = render(mesh, camera_scene(poses, camera))
    # Those beside it have a silhouette, the one behind the camera and the one far off have none.
    assert found.total_pixels.tolist() == [100, 100, 100, 100, 0, 0, 100]
    assert found.visible_pixels.tolist() == [0, 0, 0, 0, 0, 0, 50]
    assert found.visible_fraction.tolist() == [0, 0, 0, 0, 0, 0, 0.5]
    assert found.total_boxes[4].tolist() == [-1, -1, -1, -1]
    assert found.total_boxes[0].tolist() == [-35, 35, 10, 10]
    np.testing.assert_array_equal(np.unique(found.instances), [-1, 6])


def test_a_camera_inside_of_a_copy_sees_it_all_around() -> None:
    found = render(RayMesh(*box(1.0, 1.0, 1.0)), camera_scene([pose((0, 0, 0))], CAMERA))
    np.testing.assert_array_equal(found.instances, 0)
    np.testing.assert_allclose(found.depth, np.minimum(0.5, 0.5 / np.abs(directions(CAMERA)[..., :2]).max(-1)), 1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_it_equals_one_open3d_scene_of_all_copies(seed: int) -> None:
    scene, mesh = pile(8, WIDE, seed), bracket()
    found = render(RayMesh(*mesh), scene)
    along = directions(scene.camera)
    rays = np.concatenate([np.zeros_like(along), along], axis=-1).astype(np.float32)
    hits = plain_scene(mesh, scene).cast_rays(rays, nthreads=1)
    depth, owner = hits["t_hit"].numpy(), hits["geometry_ids"].numpy().astype(np.int32)
    depth, owner = np.where(np.isfinite(depth), depth, 0), np.where(np.isfinite(depth), owner, -1)
    # Rounding decides single pixels on the outlines.
    assert (found.instances != owner).mean() < 1e-4
    same_owner = found.instances == owner
    np.testing.assert_allclose(found.depth[same_owner], depth[same_owner], rtol=2e-5)
    # At depth 7 the last digit of float32 is 5e-7, and both round several times.
    assert np.quantile(np.abs(found.depth - depth)[same_owner], 0.999) < 5e-6
    counts = np.bincount(owner[owner >= 0], minlength=9)[:8]
    assert np.abs(found.visible_pixels - counts).max() <= 3
    assert set(np.unique(owner)) >= {0, 8}


def test_points_of_a_rendering_lie_on_the_copies() -> None:
    import open3d

    scene, mesh = pile(6, WIDE, seed=4), bracket()
    found = render(RayMesh(*mesh), scene)
    points = np.asarray(depth_to_points(jnp.asarray(found.depth), jnp.asarray(WIDE.matrix, dtype=jnp.float32)))
    caster = open3d.t.geometry.RaycastingScene(nthreads=1)
    caster.add_triangles(mesh[0].astype(np.float32), mesh[1].astype(np.uint32))
    for number, T in enumerate(scene.T_camera_object):
        own = points[found.instances == number].astype(np.float64)
        assert len(own) > 50
        local = ((own - T[:3, 3]) @ T[:3, :3]).astype(np.float32)
        assert caster.compute_distance(local, nthreads=1).numpy().max() < 5e-6


def test_normals_point_to_the_camera_whatever_the_winding() -> None:
    scene, (vertices, triangles) = pile(6, WIDE, seed=1), bracket()
    found = render(RayMesh(vertices, triangles), scene)
    hit = found.instances >= 0
    np.testing.assert_allclose(np.linalg.norm(found.normals[hit], axis=-1), 1, atol=1e-5)
    assert (found.normals * directions(WIDE)).sum(axis=-1)[hit].max() <= 1e-6
    mixed = np.where(np.arange(len(triangles))[:, None] % 2 == 0, triangles[:, ::-1], triangles)
    for wound in (triangles[:, ::-1], mixed):
        other = render(RayMesh(vertices, np.ascontiguousarray(wound)), scene)
        np.testing.assert_array_equal(found.instances, other.instances)
        np.testing.assert_allclose(found.depth, other.depth, rtol=1e-6)
        np.testing.assert_allclose(found.normals, other.normals, atol=1e-5)


def test_the_silhouette_is_what_the_copy_alone_would_show() -> None:
    scene, mesh = pile(6, WIDE, seed=2), RayMesh(*bracket())
    found = render(mesh, scene)
    for number in range(6):
        alone = render(mesh, without_bin(replace(scene, T_bin_object=scene.T_bin_object[number][None])))
        assert alone.visible_pixels[0] == found.total_pixels[number]
        assert alone.visible_fraction[0] == 1
    assert (found.visible_fraction < 1).any()


def test_the_same_input_gives_the_same_bits() -> None:
    scene, mesh = pile(6, WIDE, seed=3), bracket()
    assert same(render(RayMesh(*mesh), scene), render(RayMesh(*mesh), scene))


def test_a_scene_without_copies_shows_the_bin() -> None:
    scene = replace(pile(1, WIDE), T_bin_object=np.zeros((0, 4, 4)))
    found = render(RayMesh(*bracket()), scene)
    assert found.visible_fraction.shape == (0,)
    np.testing.assert_array_equal(np.unique(found.instances[100:200, 150:250]), 0)
    assert not render(RayMesh(*bracket()), without_bin(scene)).depth.any()


def test_the_bin_is_a_closed_box_with_its_floor_at_zero() -> None:
    import trimesh

    bin = Bin(3.0, 2.0, 1.0, 0.1)
    vertices, triangles = bin_triangles(bin)
    made = trimesh.Trimesh(vertices, triangles)
    assert made.is_watertight
    assert made.is_winding_consistent
    assert made.volume == pytest.approx(3.2 * 2.2 * 1.1 - 3 * 2 * 1)
    camera = Camera(fx=100.0, fy=100.0, cx=99.5, cy=99.5, width=200, height=200)
    scene = BinScene(bin, np.zeros((0, 4, 4)), camera, pose((0, 0, 5), TOP))
    found = render(RayMesh(*bracket()), scene)
    # From the inner rim outwards: wall, rim at height 1, nothing. The rim is at 1.5 * 100 / 4 = 37.5 pixels.
    row = found.depth[100]
    np.testing.assert_allclose(row[100:129], 5, rtol=1e-6)
    np.testing.assert_allclose(row[137:139], 4, rtol=1e-6)
    assert ((row[130:137] > 4) & (row[130:137] < 5)).all()
    assert row[141] == 0


def test_a_broken_mesh_is_refused() -> None:
    vertices, triangles = box(1.0, 1.0, 1.0)
    with pytest.raises(InputError, match="no triangles"):
        RayMesh(vertices, np.zeros((0, 3), np.int32))
    with pytest.raises(InputError, match="NaN"):
        RayMesh(np.where(np.arange(24).reshape(8, 3) == 5, np.nan, vertices), triangles)
    with pytest.raises(InputError, match="name vertices from 0 to 8 of 8"):
        RayMesh(vertices, np.concatenate([triangles, [[0, 1, 8]]]).astype(np.int32))
    with pytest.raises(InputError, match="coincide"):
        RayMesh(np.ones((8, 3)), triangles)


def test_a_broken_scene_is_refused() -> None:
    mesh, scene = RayMesh(*bracket()), pile(3, WIDE)
    poses = scene.T_bin_object.copy()
    poses[1, 0, 3] = np.nan
    with pytest.raises(InputError, match=r"T_bin_object\[1\] holds 1 values that are NaN"):
        render(mesh, replace(scene, T_bin_object=poses))
    poses = scene.T_bin_object.copy()
    poses[2, :3, :3] *= 2
    with pytest.raises(InputError, match=r"T_bin_object\[2\] is not a rigid pose"):
        render(mesh, replace(scene, T_bin_object=poses))
    with pytest.raises(InputError, match="T_camera_bin is not a rigid pose"):
        render(mesh, replace(scene, T_camera_bin=np.diag([1.0, 1, -1, 1])))
    below = replace(scene, T_camera_bin=pose((0, 0, -1), TOP))
    points = np.zeros((4, 3))
    for call in (lambda: render(mesh, below), lambda: visible_bin_surfels(mesh, below, points, points)):
        with pytest.raises(InputError, match="1 below the bin's floor"):
            call()
    with pytest.raises(InputError, match="points or normals"):
        visible_surfels(mesh, scene, np.full((4, 3), np.nan), points)
