"""Poses found the wrong way round are turned to what the depth image shows, and refined."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from experiments.solids import box, union
from kmn_jax.detection import DepthAgreementConfig, DevicePart, Scene, make_scene, symmetry_transforms
from kmn_jax.detection._look_alikes import MOST, look_alikes
from kmn_jax.detection._polish import _polish_many, polish, polish_one, polished
from kmn_jax.detection._refinement import refined_forms
from kmn_jax.geometry import Camera, SmoothConfig, crop_around, measured_points
from kmn_jax.io import Scan
from kmn_jax.objects import ObjectConfig, Part, PartArrays, object_from_mesh
from kmn_jax.objects._symmetry import rotation_about
from kmn_jax.pose import mssd
from kmn_jax.simulate import RayMesh, Surfels, render, visible_by_splatting
from tests.reference.meshes import Mesh, camera_scene, notched_box, pose, random_rotations, tube
from tests.reference.parts import box_part, part_of

CAMERA = Camera(500.0, 500.0, 159.5, 119.5, 320, 240)
TRUE = pose((0.05, -0.02, 3.0), random_rotations(1, 5)[0])
FORMS = jax.jit(refined_forms, static_argnames=("smooth", "agreement", "margin"))
CROP = jax.jit(crop_around, static_argnums=(4, 5))
SEEN = jax.jit(visible_by_splatting)
NO_RIVALS = np.zeros(MOST, dtype=bool)
HALF_TURNS = np.tile(np.diag(np.float32([1, -1, -1, 1])), (MOST, 1, 1))


@pytest.fixture(scope="module")
def part() -> Part:
    return of_mesh(notched_box())


def of_mesh(mesh: Mesh) -> Part:
    return part_of(object_from_mesh("part", *mesh, "m", ObjectConfig(num_points=2048)))


def turns_of(part: Part) -> tuple[np.ndarray, np.ndarray]:
    return look_alikes(part, symmetry_transforms(part.symmetries))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return view_of(notched_box(), TRUE)


def view_of(mesh: Mesh, T_camera_object: np.ndarray) -> Scene:
    depth = render(RayMesh(*mesh), camera_scene([T_camera_object], CAMERA)).depth.astype(np.float32)
    points = measured_points(depth, CAMERA)
    return make_scene(Scan(points, None, depth, CAMERA, "m"), 1.0, inside=np.ones(len(points), dtype=bool))


@pytest.mark.usefixtures("all_optimisations")  # it runs for long
def test_look_alikes_lie_on_the_part_and_differ(part: Part) -> None:
    turns, is_real = turns_of(part)
    assert turns.shape == (MOST, 4, 4)
    np.testing.assert_allclose(np.linalg.det(turns[:, :3, :3]), 1, atol=1e-5)
    found = np.concatenate([np.eye(4, dtype=np.float32)[None], turns[is_real]])
    surface = cKDTree(part.points)
    for row, turn in enumerate(found):
        moved = part.points[:300] @ turn[:3, :3].T + turn[:3, 3]
        assert surface.query(moved)[0].mean() < 0.1 * part.diameter
        for other in found[:row]:
            assert float(mssd(turn, other, part.points[:300])) > 0.08 * part.diameter


@pytest.mark.usefixtures("all_optimisations")
def test_look_alikes_of_a_part_are_found_once(part: Part) -> None:
    (turns, is_real), (again, _) = turns_of(part), turns_of(replace(part, name="of another scan"))
    assert again is turns
    with pytest.raises(ValueError, match="read-only"):
        turns[0] = 0
    whole = symmetry_transforms(part.symmetries)
    others, _ = look_alikes(part, np.concatenate([whole, turns[:1]]))  # as if the most similar one was a symmetry
    assert float(mssd(turns[0], others[0], part.points[:300])) > 0.08 * part.diameter
    larger, _ = turns_of(replace(part, points=2 * part.points, diameter=2 * part.diameter))
    np.testing.assert_allclose(larger[is_real][:, :3, 3], 2 * turns[is_real][:, :3, 3], atol=1e-4 * part.diameter)


def test_a_box_with_a_notch_is_mistaken_for_its_half_turns(part: Part) -> None:
    turns, is_real = turns_of(part)
    center = part.points.mean(axis=0)
    for axis in np.eye(3):
        half = np.eye(4, dtype=np.float32)
        half[:3, :3] = rotation_about(axis, np.pi)
        half[:3, 3] = center - half[:3, :3] @ center
        apart = [float(mssd(turn, half, part.points[:300])) for turn in turns[is_real]]
        assert min(apart) < 0.15 * part.diameter


@pytest.mark.usefixtures("all_optimisations")
def test_a_bracket_is_mistaken_for_itself_with_its_legs_exchanged() -> None:
    part = of_mesh(union(box((0, 0, 0), (1.0, 0.6, 0.1)), box((0, 0, 0), (0.1, 0.6, 0.8))))
    turns, is_real = turns_of(part)
    exchanged = np.array([[0, 0, 1], [0, -1, 0], [1, 0, 0]], dtype=np.float32)
    turned = turns[is_real]
    cosine = (np.trace(np.swapaxes(turned[:, :3, :3], 1, 2) @ exchanged, axis1=1, axis2=2) - 1) / 2
    row = int(np.argmax(cosine))
    assert cosine[row] > np.cos(np.radians(10))
    np.testing.assert_allclose(turned[row] @ [0, 0.3, 0, 1], [0, 0.3, 0, 1], atol=0.1)  # the corner stays


@pytest.mark.usefixtures("all_optimisations")
def test_a_symmetry_is_no_look_alike() -> None:
    symmetries = np.stack([np.eye(3), *(rotation_about(axis, np.pi) for axis in np.eye(3))])
    part = box_part(2000, rotations=symmetries)
    turns, is_real = turns_of(part)
    halves = (np.abs(np.diagonal(turns[:, :3, :3], axis1=1, axis2=2)) > 0.99).all(axis=1)
    assert not (halves & is_real & (np.abs(turns[:, :3, 3]).max(axis=1) < 0.05 * part.diameter)).any()


def device_of(part: Part, is_rival: np.ndarray = NO_RIVALS) -> DevicePart:
    turns = turns_of(part)[0] if is_rival.any() else HALF_TURNS  # which are not to be looked at then
    surfels = Surfels(jnp.asarray(part.points), jnp.asarray(part.normals), jnp.float32(part.area))
    arrays = PartArrays(surfels.points, surfels.normals, jnp.zeros((8, 4)), jnp.float32(part.diameter))
    return DevicePart(arrays, surfels, jnp.eye(4)[None], jnp.float32(0), jnp.asarray(turns), jnp.asarray(is_rival))


def forms_of(part: Part, scene: Scene, starts: np.ndarray, is_rival: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the refined forms of each start, and which of them there are."""
    seed, on_device = np.int32(len(scene.points) // 2), device_of(part, is_rival)
    crop = CROP(jax.random.key(0), scene.cloud, seed, on_device.arrays.diameter, 2048, 1)
    settings = {"smooth": SmoothConfig(), "agreement": DepthAgreementConfig(), "margin": 2.0}
    results = [FORMS(start, crop, on_device, scene.image, **settings) for start in starts]
    found, there = (np.stack(leaves) for leaves in zip(*results, strict=True))
    return found, there


def test_turned_poses_come_back(part: Part, scene: Scene) -> None:
    turns, is_rival = turns_of(part)
    shift = np.eye(4, dtype=np.float32)
    shift[:3, 3] = 0.03
    starts = np.stack([TRUE @ shift, *(TRUE @ turn @ shift for turn in turns[is_rival])]).astype(np.float32)
    found, there = forms_of(part, scene, starts, is_rival)
    errors = np.array([[float(mssd(T, TRUE.astype(np.float32), part.points[:300])) for T in row] for row in found])
    assert errors[0, 0] < 0.02 * part.diameter  # the right one stays, refined
    best = np.where(there, errors, np.inf).min(axis=1)
    assert (best < 0.05 * part.diameter).mean() >= 0.75
    assert np.isfinite(found).all()


def test_a_pipe_is_not_drawn_to_its_bore() -> None:
    wall = 0.03
    mesh = tube(0.25, wall, 0.8)
    pipe, lying = of_mesh(mesh), pose((0.05, -0.02, 3.0), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    inwards = (pipe.points[:, :2] * pipe.normals[:, :2]).sum(axis=1) < -0.1
    assert inwards[:512].mean() > 0.3  # there is a bore that points may be drawn to
    starts = np.tile(lying.astype(np.float32), (3, 1, 1))
    starts[:, 2, 3] += [-0.02, 0.02, 0.04]
    found, _ = forms_of(pipe, view_of(mesh, lying), starts, NO_RIVALS)
    assert np.abs(found[:, 0, 2, 3] - lying[2, 3]).max() < wall / 6


def moved(T: np.ndarray, seed: int, degrees: float, shift: float) -> np.ndarray:
    """Return a pose turned about the part's centre, and shifted."""
    axis, way = np.random.default_rng(seed).normal(size=(2, 3))
    step = np.eye(4)
    step[:3, :3] = rotation_about(axis / np.linalg.norm(axis), np.radians(degrees))
    step[:3, 3] = shift * way / np.linalg.norm(way)
    return (T @ step).astype(np.float32)


@pytest.mark.parametrize(
    ("noise", "hidden", "bound"), [(0.0, False, 0.001), (0.005, False, 0.004), (0.0, True, 0.015), (0.005, True, 0.015)]
)
def test_polished_poses_are_those_of_the_image(
    part: Part, scene: Scene, noise: float, hidden: bool, bound: float
) -> None:
    on_device, diameter = device_of(part), part.diameter
    rng = np.random.default_rng(0)
    depth = np.asarray(scene.image.depth)
    depth = np.where(depth > 0, depth + noise * diameter * rng.normal(size=depth.shape), 0).astype(np.float32)
    if hidden:  # a third by something in front, and in pixels without a measurement
        columns = np.flatnonzero((depth > 0).any(axis=0))
        depth[:, columns[: len(columns) // 3]] = 0.8 * TRUE[2, 3]
        depth[rng.uniform(size=depth.shape) < 0.3] = 0
    image = scene.image._replace(depth=jnp.asarray(depth))
    for seed in range(3):
        found = polish_one(moved(TRUE, seed, 2.0, 0.015 * diameter), on_device, image)
        assert float(mssd(found, TRUE.astype(np.float32), part.points[:300])) < bound * diameter


def test_a_part_that_shows_most_of_its_surface_is_polished_by_a_share_of_it() -> None:
    corners = np.array([(-0.5, -0.3, 0), (0.5, -0.4, 0), (0.4, 0.3, 0), (-0.5, 0.5, 0), (0.1, 0.05, -0.8)])
    pyramid = corners, np.array([(0, 2, 1), (0, 3, 2), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)])[:, ::-1]
    of_pyramid, apex_first = of_mesh(pyramid), pose((0.05, -0.02, 3.0))
    image = view_of(pyramid, apex_first).image
    on_device = device_of(of_pyramid)
    seen = SEEN(on_device.surfels, apex_first[None].astype(np.float32), np.ones(1, dtype=bool), image.camera)
    assert np.mean(seen.mask) > 0.6
    start = moved(apex_first, 0, 2.0, 0.015 * of_pyramid.diameter)
    found = polish_one(start, on_device, image)
    before, after = (float(mssd(at, apex_first.astype(np.float32), of_pyramid.points[:300])) for at in (start, found))
    assert after < 0.002 * of_pyramid.diameter < 0.1 * before


def test_polishing_leaves_what_nothing_was_measured_of(part: Part, scene: Scene) -> None:
    on_device, start = device_of(part), moved(TRUE, 0, 2.0, 0.01)
    behind, elsewhere = start.copy(), start.copy()
    behind[2, 3] *= -1
    elsewhere[0, 3] += 3 * part.diameter
    for pose_, depth in (
        (start, np.zeros_like(scene.image.depth)),
        (behind, scene.image.depth),
        (elsewhere, scene.image.depth),
    ):
        found = polish_one(pose_, on_device, scene.image._replace(depth=depth))
        np.testing.assert_array_equal(found, pose_)


def test_many_are_polished_as_each_is(part: Part, scene: Scene) -> None:
    on_device = device_of(part)
    starts = np.stack([moved(TRUE, seed, 2.0, 0.015 * part.diameter) for seed in range(3)])
    found, many = polish(starts, on_device, scene.image), _polish_many(starts, on_device, scene.image)
    alone = jax.jit(polished)
    wanted = [alone(start, on_device, scene.image) for start in starts]
    for result in (found, many):
        np.testing.assert_allclose(result, wanted, atol=1e-4 * part.diameter)
    assert polish(starts[:0], on_device, scene.image).shape == (0, 4, 4)


def test_polishing_does_not_slide_a_plate_along_itself() -> None:
    mesh = box((0, 0, 0), (1.0, 0.6, 0.02))
    plate, flat = of_mesh(mesh), pose((0.05, -0.02, 3.0), np.diag([1.0, -1.0, -1.0]))
    start = flat.astype(np.float32)
    start[:3, 3] += [0.01, -0.01, 0.02]
    found = np.asarray(polish_one(start, device_of(plate), view_of(mesh, flat).image))
    np.testing.assert_allclose(found[2, 3], flat[2, 3], atol=1e-3)
    assert (np.abs(found[:2, 3] - flat[:2, 3]) <= np.abs(start[:2, 3] - flat[:2, 3]) + 1e-3).all()
