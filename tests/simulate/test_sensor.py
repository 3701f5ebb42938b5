"""Each fault of the sensor on its own, measured on pictures where its amount is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera
from kmn_jax.simulate import Bin, BinScene, RayMesh, SensorConfig, render, sense
from kmn_jax.simulate._raycast import Rendering
from tests.reference.meshes import box, bracket, camera_scene, pile, pose, sphere, square, without_bin

CAMERA = Camera(fx=8000.0, fy=8000.0, cx=99.5, cy=99.5, width=200, height=200)  # narrow: its rays are near parallel
PLANE = RayMesh(*square(1 / 2**0.5))  # of unit diagonal
TOP = np.diag([1.0, -1, -1])


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def plane(distance: float, slant: float = 0.0) -> tuple[RayMesh, BinScene, Rendering]:
    """Return a plane that fills the picture, slanted by so many degrees."""
    angle = np.radians(slant)
    R = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    scene = camera_scene([pose((0, 0, distance), R)], CAMERA)
    rendering = render(PLANE, scene)
    assert (rendering.depth > 0).all()
    return PLANE, scene, rendering


def two_plates(step: float) -> tuple[RayMesh, BinScene, Rendering]:
    """Return two plates side by side: columns 0 to 99 are `step` nearer than columns 100 to 199."""
    mesh = RayMesh(*square(1 / 2**0.5))
    camera = replace(CAMERA, fx=2000.0, fy=2000.0)
    half = 0.5 / 2**0.5
    near = pose((-half, 0, 8))
    far = pose((half * (8 + step) / 8 - 0.02, 0, 8 + step))
    scene = camera_scene([near, far], camera)
    rendering = render(mesh, scene)
    # Both plates reach beyond rows and columns 30 to 170; the nearer one ends between columns 99 and 100.
    window = rendering.instances[40:160, 40:160]
    np.testing.assert_array_equal(window, np.broadcast_to(np.arange(40, 160) > 99, window.shape).astype(int))
    return mesh, scene, rendering


def test_the_default_sensor_is_perfect() -> None:
    mesh, camera = RayMesh(*sphere(0.5, 3)), Camera(500.0, 500.0, 199.5, 149.5, 400, 300)
    scene = pile(6, camera)
    rendering = render(mesh, scene)
    np.testing.assert_array_equal(sense(mesh, scene, rendering, SensorConfig(), generator()), rendering.depth)


@pytest.mark.parametrize("distance", [8.0, 16.0, 4.0])
def test_noise_grows_with_the_depth_squared(distance: float) -> None:
    case = plane(distance)
    noise = sense(*case, SensorConfig(noise=0.001), generator()) - case[2].depth
    expected = 0.001 * (distance / 8) ** 2
    # 40,000 pixels: the deviation is known to 0.35%, the mean to 0.5% of it.
    assert noise.std() == pytest.approx(expected, rel=0.015)
    assert abs(noise.mean()) < 0.02 * expected
    assert abs(np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1]) < 0.02


@pytest.mark.parametrize(("share", "factor"), [(0.0, 1.0), (1.0, 2.0), (0.5, 1.5)])
def test_noise_grows_with_slant(share: float, factor: float) -> None:
    case = plane(8.0, slant=60)  # 1 / cos = 2
    found = sense(*case, SensorConfig(noise=0.001, slant_noise=share), generator())
    scale = (case[2].depth / 8) ** 2
    assert ((found - case[2].depth) / scale).std() == pytest.approx(0.001 * factor, rel=0.03)


def test_noise_is_relative_to_the_object() -> None:
    scene = camera_scene([pose((0, 0, 8000))], CAMERA)
    mesh = RayMesh(*square(1000 / 2**0.5))
    rendering = render(mesh, scene)
    large = sense(mesh, scene, rendering, SensorConfig(noise=0.001, step=0.0005), generator())
    small = sense(*plane(8.0), SensorConfig(noise=0.001, step=0.0005), generator())
    assert (np.abs(large / 1000 - small) < 1e-5).mean() > 0.99  # the rest lay between two steps


def test_depths_are_multiples_of_the_step() -> None:
    case = plane(8.0, slant=30)
    found = sense(*case, SensorConfig(step=0.003), generator()).astype(np.float64)
    np.testing.assert_allclose(found / 0.003, np.round(found / 0.003), atol=2e-4)  # float32 at 2,667 steps
    assert np.abs(found - case[2].depth).max() <= 0.0015 + 1e-6
    assert len(np.unique(found)) > 3


@pytest.mark.parametrize(("slant", "share"), [(40.0, 0.0), (64.0, 0.0), (66.0, 1.0), (72.0, 1.0)])
def test_what_is_slanted_too_much_is_missing(slant: float, share: float) -> None:
    found = sense(*plane(8.0, slant), SensorConfig(max_slant=65.0), generator())
    assert (found == 0).mean() == share


@pytest.mark.parametrize("width", [1, 2, 4])
def test_edges_are_missing_on_both_sides(width: int) -> None:
    case = two_plates(step=0.2)
    found = sense(*case, SensorConfig(edge_width=width, edge_jump=0.1), generator())[40:160, 40:160]
    lost = np.zeros((120, 120), dtype=bool)
    lost[:, 60 - width : 60 + width] = True
    np.testing.assert_array_equal(found == 0, lost)
    np.testing.assert_array_equal(found[~lost], case[2].depth[40:160, 40:160][~lost])
    assert (sense(*case, SensorConfig(edge_width=width, edge_jump=0.3), generator())[40:160, 40:160] > 0).all()


def test_edges_are_lost_with_their_probability_and_towards_nothing_too() -> None:
    mesh, scene, rendering = two_plates(step=0.2)
    losses = [
        (sense(mesh, scene, rendering, SensorConfig(edge_width=4, edge_loss=0.3), generator(seed)) == 0)[40:160, 96:104]
        for seed in range(20)
    ]
    assert np.mean(losses) == pytest.approx(0.3, abs=0.01)  # 19,200 draws: 0.0033
    alone = replace(scene, T_bin_object=scene.T_bin_object[:1])
    exact = render(mesh, alone)
    found = sense(mesh, alone, exact, SensorConfig(edge_width=2), generator())
    assert (found[40:160, 98:100] == 0).all()
    np.testing.assert_array_equal(found[40:160, 40:98], exact.depth[40:160, 40:98])


@pytest.mark.parametrize("patch", [0.0, 0.02])
@pytest.mark.parametrize(("slant", "power", "share"), [(0.0, 1.0, 0.0), (60.0, 1.0, 0.4), (60.0, 3.0, 0.1)])
def test_flanks_are_missing_more_the_more_they_are_slanted(
    patch: float, slant: float, power: float, share: float
) -> None:
    case = plane(8.0, slant)
    # 0.8 * (1 - cos 60)^power; patches of 20 pixels
    config = SensorConfig(flank_loss=0.8, flank_power=power, flank_patch=patch)
    lost = np.stack([sense(*case, config, generator(seed)) == 0 for seed in range(40)])
    # Each of the 40 pictures holds 40,000 independent pixels, or about 8 x 8 independent patches.
    assert lost.mean() == pytest.approx(share, abs=0.002 if patch == 0 else 0.03)
    assert lost.mean() < 1e-3 or share > 0
    if share:
        agreement = (lost[..., 1:] == lost[..., :-1]).mean()
        independent = share**2 + (1 - share) ** 2
        assert agreement > 0.97 if patch else agreement == pytest.approx(independent, abs=0.005)


def test_the_projector_shadow_is_as_wide_as_trigonometry_says() -> None:
    mesh, camera = RayMesh(*box(1.0, 1.0, 1.0)), Camera(400.0, 400.0, 199.5, 199.5, 400, 400)
    height, diagonal = 6.0, 3**0.5
    scene = BinScene(Bin(20.0, 20.0, 0.5, 0.1), pose((0, 0, 0.5))[None], camera, pose((0, 0, height), TOP))
    rendering = render(mesh, scene)
    baseline = 1.5
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        place = [0.0, 0.0, 0.0]
        place[axis] = sign * baseline / diagonal
        lost = sense(mesh, scene, rendering, SensorConfig(projector=(place[0], place[1], place[2])), generator()) == 0
        # The edge of the top away from the projector: the camera sees the floor from edge * Z / (Z - h) on, the
        # projector lights it from there on plus baseline * h / (Z - h).
        row = lost[200] if axis == 0 else lost[:, 200]
        width = camera.fx / height * baseline * 1.0 / (height - 1)
        start = 199.5 - sign * camera.fx * 0.5 / (height - 1)
        columns = np.flatnonzero(row)
        assert len(columns) == pytest.approx(width, abs=1)
        assert columns.max() - columns.min() + 1 == len(columns)
        nearest = columns.max() if sign > 0 else columns.min()
        assert nearest == pytest.approx(start, abs=1)
        assert lost.sum() < 1.3 * width * camera.fx / (height - 1)
    lit = sense(mesh, scene, rendering, SensorConfig(projector=(0.0, 0.0, 0.001)), generator())
    np.testing.assert_array_equal(lit, rendering.depth)


def test_the_bin_casts_a_shadow_only_if_it_is_there() -> None:
    mesh, camera = PLANE, Camera(600.0, 600.0, 310.0, 99.5, 200, 200)
    scene = BinScene(Bin(6.0, 6.0, 1.5, 0.1), pose((-2, 0, 0.3))[None], camera, pose((0, 0, 6), TOP))
    config = SensorConfig(projector=(-6.0, 0.0, 0.0))  # from (-6, 6) the wall's rim at (-3, 1.5) shades all to x = -2.2
    copy_lost = []
    for case in (scene, without_bin(scene)):
        rendering = render(mesh, case)
        own = rendering.instances == 0
        copy_lost.append((sense(mesh, case, rendering, config, generator())[own] == 0).mean())
    # The copy is at z = 0.3, from -2.354 to -1.646; the shadow there ends at -2.2.
    assert copy_lost[0] == pytest.approx((2.354 - 2.2) / 0.707, abs=0.01)
    assert copy_lost[1] == 0


def test_faults_do_not_depend_on_each_other() -> None:
    mesh, camera = RayMesh(*sphere(0.5, 3)), Camera(500.0, 500.0, 199.5, 149.5, 400, 300)
    scene = pile(6, camera)
    rendering = render(mesh, scene)
    full = replace(SensorConfig.structured_light(), edge_loss=0.5, step=0.0)
    together = sense(mesh, scene, rendering, full, generator(3))
    only: list[dict[str, Any]] = [
        {"max_slant": full.max_slant},
        {"edge_width": full.edge_width, "edge_loss": full.edge_loss},
        {"flank_loss": full.flank_loss, "flank_patch": full.flank_patch},
        {"projector": full.projector},
    ]
    lost = [sense(mesh, scene, rendering, SensorConfig(**part), generator(3)) == 0 for part in only]
    assert all(part.any() for part in lost)
    np.testing.assert_array_equal(together == 0, np.any(lost, axis=0))
    noisy = sense(mesh, scene, rendering, SensorConfig(noise=full.noise, slant_noise=1.0), generator(3))
    np.testing.assert_array_equal(together[together > 0], noisy[together > 0])


@pytest.mark.parametrize("distance", [8.0, 16.0])
def test_steps_of_disparity_grow_with_the_depth_squared(distance: float) -> None:
    case = plane(distance, slant=45)
    depth = sense(*case, SensorConfig(disparity_step=0.01), generator())
    expected = 0.01 * (distance / 8) ** 2
    levels = np.unique(depth)
    np.testing.assert_allclose(np.diff(levels), expected, rtol=0.1)
    assert np.abs(depth - case[2].depth).max() <= 0.55 * expected


def test_shared_errors_are_shared_by_neighbours_alone() -> None:
    case = plane(8.0)
    error = sense(*case, SensorConfig(shared_noise=0.01, shared_patch=0.004), generator()) - case[2].depth
    np.testing.assert_allclose(error.std(), 0.01, rtol=0.25)
    beside, far = (np.corrcoef(error[:, step:].ravel(), error[:, :-step].ravel())[0, 1] for step in (1, 30))
    assert beside > 0.9
    assert abs(far) < 0.3


def test_holes_are_patches_of_their_share() -> None:
    case = plane(8.0)
    missing = sense(*case, SensorConfig(holes=0.2, hole_patch=0.003), generator()) == 0
    np.testing.assert_allclose(missing.mean(), 0.2, atol=0.06)
    assert (missing[:, 1:] == missing[:, :-1]).mean() > 0.9


def test_flying_pixels_hang_between_the_sides_of_a_jump() -> None:
    mesh, scene, rendering = two_plates(0.5)
    config = SensorConfig(flying=0.5, edge_width=2, edge_loss=0.0)
    depth = sense(mesh, scene, rendering, config, generator())[40:160, 40:160]
    changed = depth != rendering.depth[40:160, 40:160]
    assert 0.4 < changed[:, 58:62].mean() < 0.6
    assert not changed[:, :56].any()
    assert not changed[:, 64:].any()
    assert ((depth[changed] >= 8 - 1e-5) & (depth[changed] <= 8.5 + 1e-5)).all()


@pytest.mark.parametrize("config", [SensorConfig.stereo(), SensorConfig.time_of_flight()], ids=["stereo", "flight"])
def test_other_families_are_deterministic_and_leave_most_of_what_faces_them(config: SensorConfig) -> None:
    mesh, camera = RayMesh(*bracket()), Camera(500.0, 500.0, 199.5, 149.5, 400, 300)
    scene = pile(6, camera)
    rendering = render(mesh, scene)
    depth = sense(mesh, scene, rendering, config, generator(1))
    np.testing.assert_array_equal(depth, sense(mesh, scene, rendering, config, generator(1)))
    facing = (rendering.depth > 0) & (-rendering.normals[..., 2] > 0.8)
    kept = facing & (depth > 0)
    assert 0.6 * facing.sum() < kept.sum() < facing.sum()
    error = np.abs(depth - rendering.depth)[kept]
    assert 0.002 * mesh.diagonal < np.median(error) < 0.06 * mesh.diagonal


def test_a_structured_light_scanner_is_deterministic_and_leaves_most_of_what_faces_it() -> None:
    mesh, camera = RayMesh(*bracket()), Camera(500.0, 500.0, 199.5, 149.5, 400, 300)
    scene = pile(6, camera)
    rendering = render(mesh, scene)
    first, again, other = (
        sense(mesh, scene, rendering, SensorConfig.structured_light(), generator(seed)) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    kept, hit = first > 0, rendering.depth > 0
    assert (first != other)[kept & (other > 0)].mean() > 0.8
    assert np.isfinite(first).all()
    assert not kept[~hit].any()
    assert np.abs(first - rendering.depth)[kept].max() < 0.1 * mesh.diagonal
    assert 0.5 < kept[hit].mean() < 0.95
    assert kept[hit & (rendering.normals[..., 2] < -0.95)].mean() > 0.8


def test_a_picture_of_nothing_stays_empty() -> None:
    scene = camera_scene([pose((0, 0, -5))], CAMERA)
    rendering = render(PLANE, scene)
    assert not sense(PLANE, scene, rendering, SensorConfig.structured_light(), generator()).any()


@pytest.mark.parametrize(
    "wrong",
    [
        {"noise": -1.0},
        {"noise": float("nan")},
        {"step": float("inf")},
        {"noise_depth": 0.0},
        {"edge_jump": 0.0},
        {"edge_width": -1},
        {"edge_loss": 1.5},
        {"flank_loss": -0.1},
        {"slant_noise": 2.0},
        {"max_slant": 0.0},
        {"projector": (float("nan"), 0.0, 0.0)},
    ],
    ids=str,
)
def test_impossible_faults_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        SensorConfig(**wrong)


def test_a_rendering_of_another_camera_is_refused() -> None:
    mesh, scene, rendering = plane(8.0)
    other = replace(scene, camera=replace(CAMERA, width=100))
    with pytest.raises(InputError, match="200 x 200 pixels, but the scene's camera 100 x 200"):
        sense(mesh, other, rendering, SensorConfig(), generator())
