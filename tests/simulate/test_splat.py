"""Visible points: from bits against plain NumPy, by splatting against ray casting and against formulas."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera, Intrinsics, intrinsics
from kmn_jax.objects._surface import outer_surface
from kmn_jax.simulate import (
    BIN,
    Bin,
    BinInView,
    BinScene,
    RayMesh,
    SplatConfig,
    Surfels,
    VisiblePoints,
    bin_surfels,
    pack_bits,
    render,
    visible_bin_surfels,
    visible_by_splatting,
    visible_from_bits,
    visible_surfels,
)
from tests.reference.meshes import box, bracket, camera_scene, pile, pose, random_rotations, sphere, square

C = 20  # of copies, so that few programs are compiled
WIDE = Camera(fx=900.0, fy=880.0, cx=399.5, cy=299.5, width=800, height=600)
M = 4096
MESHES = {"box": box(0.8, 0.5, 0.33), "bracket": bracket(), "sphere": sphere(0.5)}
splat = jax.jit(visible_by_splatting, static_argnames="config")
from_bits = jax.jit(visible_from_bits)


@cache
def surfels_of(name: str) -> Surfels:
    found = outer_surface(*MESHES[name], M)
    return Surfels(jnp.asarray(found.points), jnp.asarray(found.normals), jnp.float32(found.area))


def padded(scene: BinScene) -> tuple[jax.Array, jax.Array]:
    """Return the poses with NaN for the copies that are missing, and which are real."""
    poses = np.full((C, 4, 4), np.nan, dtype=np.float32)
    poses[: len(scene.T_camera_object)] = scene.T_camera_object
    return jnp.asarray(poses), jnp.asarray(np.arange(C) < len(scene.T_camera_object))


def copies_of(rows: np.ndarray | jax.Array) -> np.ndarray:
    """Return the rows of the copies, apart from those of the bin, one copy after the other."""
    return np.asarray(rows)[: C * M].reshape(C, M, *np.shape(rows)[1:])


def in_view(scene: BinScene) -> BinInView:
    size = jnp.array([scene.bin.length, scene.bin.width, scene.bin.height], dtype=jnp.float32)
    return BinInView(size, jnp.asarray(scene.T_camera_bin, dtype=jnp.float32))


def stack(count: int, seed: int) -> BinScene:
    """Return copies of an object of diameter 1 turned at random, in layers of six that do not touch, in a bin."""
    rng = np.random.default_rng(seed)
    order = np.arange(count)
    places = np.stack([order % 3 - 1.0, order // 3 % 2 - 0.5, order // 6 + 0.5], axis=1) * [1.06, 1.06, 0.9]
    places[:, :2] += np.where(order // 6 % 2, 0.25, -0.25)[:, None]
    poses = np.stack([pose(tuple(place), R) for place, R in zip(places, random_rotations(count, seed), strict=True)])
    tilt, side = np.radians(rng.uniform(0, 20)), rng.uniform(0, 2 * np.pi)
    back = np.array([np.sin(tilt) * np.cos(side), np.sin(tilt) * np.sin(side), np.cos(tilt)])
    right = np.cross([0.0, 1, 0], back) / np.linalg.norm(np.cross([0.0, 1, 0], back))
    turned = np.stack([right, np.cross(-back, right), -back])
    return BinScene(Bin(4.0, 3.0, 1.2, 0.05), poses, WIDE, pose(tuple(turned @ (-8 * back)), turned))


def all_finite(visible: VisiblePoints) -> bool:
    return all(np.isfinite(part).all() for part in visible)


class Agreement(NamedTuple):
    """Shares of points: wrongly visible among those called visible, missed among those that are."""

    false: float
    missed: float


def agreement(found: np.ndarray, truth: np.ndarray) -> Agreement:
    return Agreement((found & ~truth).sum() / found.sum(), (truth & ~found).sum() / truth.sum())


# From bits


@pytest.mark.parametrize("with_bin", [False, True])
def test_bits_give_exactly_the_points_they_name(with_bin: bool) -> None:
    rng = np.random.default_rng(0)
    surfels, scene = surfels_of("box"), pile(5, WIDE)
    poses, copies = padded(scene)
    marked = rng.random((C, M)) < 0.3
    bin_marked = rng.random(512) < 0.3
    extra = (in_view(scene), jnp.asarray(pack_bits(bin_marked))) if with_bin else ()
    found = from_bits(surfels, poses, copies, jnp.asarray(pack_bits(marked)), *extra)

    marked[5:] = False
    mask, instance = marked.ravel(), np.repeat(np.arange(C), M)
    points, normals = np.zeros((C, M, 3)), np.zeros((C, M, 3))
    for i, matrix in enumerate(scene.T_camera_object):
        points[i] = np.asarray(surfels.points) @ matrix[:3, :3].T + matrix[:3, 3]
        normals[i] = np.asarray(surfels.normals) @ matrix[:3, :3].T
    points, normals = points.reshape(-1, 3), normals.reshape(-1, 3)
    areas = np.full(C * M, float(surfels.area) / M)
    if with_bin:
        on_bin, matrix = bin_surfels(in_view(scene).size, 512), scene.T_camera_bin
        points = np.concatenate([points, np.asarray(on_bin.points) @ matrix[:3, :3].T + matrix[:3, 3]])
        normals = np.concatenate([normals, np.asarray(on_bin.normals) @ matrix[:3, :3].T])
        areas = np.concatenate([areas, np.full(512, float(on_bin.area) / 512)])
        mask, instance = np.concatenate([mask, bin_marked]), np.concatenate([instance, np.full(512, BIN)])
    np.testing.assert_array_equal(found.mask, mask)
    np.testing.assert_array_equal(found.instance, instance)
    assert all_finite(found)
    real = (instance < 5) | (instance == BIN)
    np.testing.assert_allclose(np.asarray(found.points)[real], points[real], atol=3e-6)
    np.testing.assert_allclose(np.asarray(found.normals)[real], normals[real], atol=1e-6)
    # Solid angle by the cosine cubed of the angle to the axis: what a pixel of a pinhole camera sees.
    distance = np.linalg.norm(points[real], axis=1)
    cosine = np.maximum(-(points[real] * normals[real]).sum(axis=1) / distance, 0)
    expected = areas[real] * cosine / distance**2 / (points[real][:, 2] / distance) ** 3
    np.testing.assert_allclose(np.asarray(found.picture_area)[real], expected, rtol=1e-4, atol=1e-10)
    assert not np.asarray(found.picture_area)[~real].any()
    areas = copies_of(found.picture_area)
    seen = np.where(copies_of(mask), areas, 0).sum(axis=1)
    np.testing.assert_allclose(np.asarray(found.visible_fraction)[:5], seen[:5] / areas[:5].sum(axis=1), rtol=1e-4)
    assert not np.asarray(found.visible_fraction)[5:].any()


def test_picture_area_counts_the_pixels_of_a_rendering() -> None:
    surfels, scene = surfels_of("bracket"), pile(6, WIDE, seed=1)
    mesh = RayMesh(*MESHES["bracket"])
    marked = np.zeros((C, M), dtype=bool)
    marked[:6] = visible_surfels(mesh, scene, np.asarray(surfels.points), np.asarray(surfels.normals))
    poses, copies = padded(scene)
    found = from_bits(surfels, poses, copies, jnp.asarray(pack_bits(marked)))
    pixels = WIDE.fx * WIDE.fy * np.where(found.mask, found.picture_area, 0).reshape(C, M)[:6].sum(axis=1)
    counted = render(mesh, scene).visible_pixels
    assert counted.min() > 500
    # A surfel stands for about 3 pixels here; those on an outline are right only on average.
    np.testing.assert_allclose(pixels, counted, rtol=0.06)


def test_bits_that_do_not_fit_are_refused() -> None:
    surfels, poses, copies = surfels_of("box"), jnp.eye(4)[None], jnp.array([True])
    with pytest.raises(InputError, match="do not fit 4096"):
        from_bits(surfels, poses, copies, jnp.zeros((1, 100), dtype=jnp.uint8))
    bits, view = jnp.zeros((1, M // 8), dtype=jnp.uint8), BinInView(jnp.ones(3), jnp.eye(4))
    with pytest.raises(InputError, match="both or none"):
        from_bits(surfels, poses, copies, bits, view)
    with pytest.raises(InputError, match="both or none"):
        from_bits(surfels, poses, copies, bits, None, bits[0])


# The bin


def test_bin_surfels_lie_on_floor_and_walls_with_normals_into_the_bin_in_proportion_to_their_areas() -> None:
    size = np.array([3.4, 2.4, 1.2])
    points, normals, area = (np.asarray(part) for part in bin_surfels(jnp.asarray(size, dtype=jnp.float32), 8192))
    faces = {
        (0, 0, 1): (2, 0.0),
        (-1, 0, 0): (0, 1.7),
        (1, 0, 0): (0, -1.7),
        (0, -1, 0): (1, 1.2),
        (0, 1, 0): (1, -1.2),
    }
    sizes = np.array([3.4 * 2.4, 2.4 * 1.2, 2.4 * 1.2, 3.4 * 1.2, 3.4 * 1.2])
    np.testing.assert_allclose(area, sizes.sum(), rtol=1e-6)
    total = 0
    for (normal, (axis, place)), face_area in zip(faces.items(), sizes, strict=True):
        on_face = (normals == normal).all(axis=1)
        total += on_face.sum()
        np.testing.assert_allclose(points[on_face, axis], place, atol=1e-6)
        # Far more even than random points, whose count would be off by 2 to 3%.
        np.testing.assert_allclose(on_face.sum(), 8192 * face_area / sizes.sum(), atol=8)
    assert total == 8192
    assert (np.abs(points[:, :2]) <= size[:2] / 2 + 1e-6).all()
    assert (points[:, 2] >= 0).all()
    assert (points[:, 2] <= 1.2).all()


def test_bin_surfels_leave_no_hole_and_no_cluster() -> None:
    points = np.asarray(bin_surfels(jnp.array([3.0, 2.0, 1.0]), 8192).points)
    floor = points[points[:, 2] == 0]
    counts, *_ = np.histogram2d(floor[:, 0], floor[:, 1], [15, 10], [[-1.5, 1.5], [-1, 1]])
    mean = len(floor) / 150
    assert counts.min() > 0.75 * mean
    assert counts.max() < 1.25 * mean
    corner = points[(points[:, 0] > 1.2) & (points[:, 1] > 0.7)]  # floor and two walls: each corner is filled
    assert len(np.unique((corner[:, 2] == 0) * 1 + (corner[:, 0] > 1.4999) * 2)) == 3


def test_an_empty_bin_looks_as_ray_casting_says() -> None:
    angle = np.radians(35)
    turned = np.array([[1, 0, 0], [0, -np.cos(angle), np.sin(angle)], [0, -np.sin(angle), -np.cos(angle)]])
    for bin, camera_offset in (
        (Bin(3.4, 2.4, 1.2, 0.05), (0.2, 0.1, 6.0)),
        (Bin(1.0, 1.5, 2.0, 0.05), (0.1, 0.3, 5.0)),
    ):
        scene = BinScene(bin, np.zeros((0, 4, 4)), WIDE, pose(camera_offset, turned))
        view = in_view(scene)
        found = splat(surfels_of("box"), *padded(scene), intrinsics(WIDE), view)
        on_bin = bin_surfels(view.size, SplatConfig().num_bin_surfels)
        truth = visible_bin_surfels(
            RayMesh(*box(1.0, 1.0, 1.0)), scene, np.asarray(on_bin.points), np.asarray(on_bin.normals)
        )
        mask = np.asarray(found.mask)[C * M :]
        assert 0.05 < truth.mean() < 0.95
        assert (mask != truth).mean() < 1e-3  # rounding decides at the rim's shadow
        assert not copies_of(found.mask).any()


def test_walls_hide_what_lies_behind_them_and_nothing_above_the_rim() -> None:
    # Looking down at 45 degrees over the wall at y = -0.5 of a bin one unit high.
    turned = np.array([[1, 0, 0], [0, -np.sqrt(0.5), -np.sqrt(0.5)], [0, np.sqrt(0.5), -np.sqrt(0.5)]])
    T_camera_bin = pose((0, 0, 8.0), turned)
    ball = Surfels(surfels_of("sphere").points * 0.2, surfels_of("sphere").normals, surfels_of("sphere").area * 0.04)
    view = BinInView(jnp.array([2.0, 1.0, 1.0]), jnp.asarray(T_camera_bin, dtype=jnp.float32))
    shares = []
    for place in ((0, -0.3, 0.2), (0, -0.3, 1.2)):
        found = splat(ball, *padded(camera_scene([T_camera_bin @ pose(place)], WIDE)), intrinsics(WIDE), view)
        shares.append(np.asarray(found.visible_fraction)[0])
    assert shares[0] == 0
    assert shares[1] > 0.99


def test_objects_hide_the_floor_below_them() -> None:
    scene = pile(6, WIDE, seed=3)
    mesh, surfels = RayMesh(*MESHES["bracket"]), surfels_of("bracket")
    view = in_view(scene)
    found = splat(surfels, *padded(scene), intrinsics(WIDE), view)
    on_bin = bin_surfels(view.size, SplatConfig().num_bin_surfels)
    truth = visible_bin_surfels(mesh, scene, np.asarray(on_bin.points), np.asarray(on_bin.normals))
    empty = splat(
        surfels,
        *padded(BinScene(scene.bin, scene.T_bin_object[:0], WIDE, scene.T_camera_bin)),
        intrinsics(WIDE),
        view,
    )
    mask = np.asarray(found.mask)[C * M :]
    assert truth.sum() < 0.9 * np.asarray(empty.mask)[C * M :].sum()
    result = agreement(mask, truth)
    assert result.false < 0.01
    assert result.missed < 0.03


# Splatting


def test_a_box_before_another_hides_its_shadow() -> None:
    surfels = surfels_of("box")
    scene = camera_scene([pose((0, 0, 6.0)), pose((0.3, 0.1, 7.0))], WIDE)
    found = splat(surfels, *padded(scene), intrinsics(WIDE))
    points, facing = copies_of(found.points), copies_of(found.picture_area) > 0
    mask = copies_of(found.mask)
    near_face = 6 - 0.33 / 2
    np.testing.assert_array_equal(mask[0], facing[0])
    # The front box's outline is that of its near face, pushed back along the lines of sight.
    scaled = points[1, :, :2] * (near_face / points[1, :, 2:])
    depth_inside = np.minimum(0.4 - np.abs(scaled[:, 0]), 0.25 - np.abs(scaled[:, 1]))
    spacing = float(np.sqrt(surfels.area / M))
    # Gaps between Poisson-disk points reach a radius of one spacing, the discs 0.9: single points shine through.
    assert mask[1][facing[1] & (depth_inside > spacing / 2)].mean() < 0.02
    assert mask[1][facing[1] & (depth_inside < -1.5 * spacing)].all()
    assert (facing[1] & (depth_inside > spacing)).sum() > 300


def test_a_sphere_hides_a_disc_of_the_plane_behind_it() -> None:
    half = M // 2
    plane, ball = outer_surface(*square(4.0), half), outer_surface(*MESHES["sphere"], half)
    # One object of two parts: a sphere one unit before a square. The square is sampled more coarsely, so its spacing
    # is the one to be given.
    points = np.concatenate([plane.points, ball.points - np.float32([0, 0, 1])])
    normals = np.concatenate([np.tile(np.float32([0, 0, -1]), (half, 1)), ball.normals])
    spacing = np.sqrt(16 / half)
    surfels = Surfels(jnp.asarray(points), jnp.asarray(normals), jnp.float32(spacing**2 * M))
    found = splat(surfels, *padded(camera_scene([pose((0, 0, 5.0))], WIDE)), intrinsics(WIDE))
    mask, seen = copies_of(found.mask)[0], copies_of(found.points)[0]
    # The shadow of a sphere of radius 1/2 at distance 4 on the plane at 5, from the tangent cone.
    shadow = 5 * np.tan(np.arcsin(0.5 / 4))
    x, y = plane.points[:, :2].T
    inside_image, radius = (np.abs(x) < 2.2) & (np.abs(y) < 1.69), np.hypot(x, y)
    assert not mask[:half][radius < shadow - 0.5 * spacing].any()
    assert mask[:half][inside_image & (radius > shadow + 1.5 * spacing)].all()
    assert (radius < shadow - 0.5 * spacing).sum() > 100
    np.testing.assert_array_equal(mask[half:], (seen[half:] * copies_of(found.normals)[0, half:]).sum(axis=1) < 0)


@pytest.mark.parametrize("name", MESHES)
def test_splatting_agrees_with_ray_casting(name: str, record_property: Callable[[str, object], None]) -> None:
    mesh, surfels = RayMesh(*MESHES[name]), surfels_of(name)
    found, truth = [], []
    for seed, count in enumerate((1, 7, 14, 20)):
        scene = stack(count, seed)
        poses, copies = padded(scene)
        result = splat(surfels, poses, copies, intrinsics(WIDE), in_view(scene))
        assert all_finite(result)
        mask = copies_of(result.mask)
        assert not mask[count:].any()
        found.append(mask[:count].ravel())
        truth.append(visible_surfels(mesh, scene, np.asarray(surfels.points), np.asarray(surfels.normals)).ravel())
    result = agreement(np.concatenate(found), np.concatenate(truth))
    record_property("false", f"{result.false:.2%}")
    record_property("missed", f"{result.missed:.2%}")
    assert result.false <= 0.03
    assert result.missed <= 0.10


def test_points_outside_the_image_or_behind_the_camera_are_not_visible() -> None:
    camera = Camera(fx=100.0, fy=100.0, cx=20.0, cy=20.0, width=50, height=30)
    scene = camera_scene([pose((0.5, 0, 3.0)), pose((0, 0, -3.0)), pose((-3.0, 0, 3.0))], camera)
    found = splat(surfels_of("sphere"), *padded(scene), intrinsics(camera))
    x, y, z = np.moveaxis(copies_of(found.points), -1, 0)
    column, row = 100 * x / z + 20, 100 * y / z + 20
    inside = (z > 0) & (column >= -0.5) & (column < 49.5) & (row >= -0.5) & (row < 29.5)
    mask, facing = copies_of(found.mask), copies_of(found.picture_area) > 0
    assert 0 < mask.sum() < facing[0].sum()
    np.testing.assert_array_equal(mask[0], (facing & inside)[0])
    assert not mask[1:].any()
    assert all_finite(found)


@pytest.mark.parametrize("with_bin", [False, True])
def test_no_copy_at_all_is_an_empty_scene(with_bin: bool) -> None:
    view, scene = in_view(pile(1, WIDE)), camera_scene([], WIDE)
    found = splat(surfels_of("box"), *padded(scene), intrinsics(WIDE), view if with_bin else None)
    assert all_finite(found)
    assert not copies_of(found.mask).any()
    assert not np.asarray(found.visible_fraction).any()
    assert np.asarray(found.mask)[C * M :].any() == with_bin


def test_the_unit_does_not_matter() -> None:
    surfels, scene = surfels_of("bracket"), pile(8, WIDE, seed=2)
    poses, copies = padded(scene)
    metres = splat(surfels, poses, copies, intrinsics(WIDE), in_view(scene))
    scale = jnp.ones((4, 4)).at[:3, 3].set(1000.0)
    view = in_view(scene)
    millimetres = splat(
        Surfels(surfels.points * 1000, surfels.normals, surfels.area * 1e6),
        poses * scale[None],
        copies,
        intrinsics(WIDE),
        BinInView(view.size * 1000, view.T_camera_bin * scale),
    )
    assert (np.asarray(metres.mask) != np.asarray(millimetres.mask)).mean() < 1e-3
    np.testing.assert_allclose(metres.picture_area, millimetres.picture_area, rtol=1e-3, atol=1e-9)


def test_vmap_equals_single_scenes() -> None:
    surfels = surfels_of("bracket")
    scenes = [pile(count, WIDE, seed=count) for count in (2, 5)]
    stacked = [np.stack(parts) for parts in zip(*(padded(scene) for scene in scenes), strict=True)]
    views = jax.tree.map(lambda *leaves: np.stack(leaves), *map(in_view, scenes))
    camera: Intrinsics = intrinsics(WIDE)

    def one(poses: jax.Array, copies: jax.Array, view: BinInView) -> VisiblePoints:
        return visible_by_splatting(surfels, poses, copies, camera, view)

    batched = jax.device_get(jax.jit(jax.vmap(one))(*stacked, views))
    for i, scene in enumerate(scenes):
        alone = splat(surfels, *padded(scene), camera, in_view(scene))
        for part, expected in zip(batched, alone, strict=True):
            if part.dtype == bool:
                assert (part[i] != np.asarray(expected)).mean() < 1e-4
            else:
                np.testing.assert_allclose(part[i], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("wrong", [{"resolution": 1}, {"num_bin_surfels": 0}])
def test_a_config_that_makes_no_sense_is_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        SplatConfig(**wrong)


def test_a_sphere_is_as_visible_from_all_sides_as_it_must_be() -> None:
    counts = []
    for rotation in random_rotations(4, 0):
        scene = camera_scene([pose((0, 0, 5.0), rotation)], WIDE)
        counts.append(copies_of(splat(surfels_of("sphere"), *padded(scene), intrinsics(WIDE)).mask).sum())
    # What is seen of a sphere from distance d is the share (1 - r / d) / 2.
    np.testing.assert_allclose(np.array(counts) / M, (1 - 0.5 / 5) / 2, atol=0.01)
