"""Scenes: depth images are as they are, clouds are seen from where their sensor was; thinning and foreground."""

from __future__ import annotations

import jax
import jax.monitoring
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kmn_jax.detection import ForegroundOptions, OrientedBox, Scene, make_scene, seed_keys, seeds_over
from kmn_jax.detection._sources import read_source
from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera, measured_points
from kmn_jax.io import Scan
from tests.reference.meshes import pose, random_rotations
from tests.reference.parts import box_part


def wall(count: int = 4000, seed: int = 0) -> np.ndarray:
    """Return points of a wavy wall in front of a sensor at the origin."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) * [1, 0.6, 0]
    points[:, 2] = 4 + 0.2 * np.sin(3 * points[:, 0])
    return points.astype(np.float32)


def seen(scan: Scan, sensor: np.ndarray | None = None) -> Scene:
    return make_scene(scan, 0.5, sensor=sensor, inside=np.ones(len(scan.points), dtype=bool))


def cloud(points: np.ndarray) -> Scan:
    return Scan(points.astype(np.float32), None, None, None, "m")


def reached(scene: Scene) -> float:
    """Return the share of points that the depth image shows within a hundredth."""
    x, y, z = scene.points.T
    column = np.round(scene.camera.fx * x / z + scene.camera.cx).astype(int)
    row = np.round(scene.camera.fy * y / z + scene.camera.cy).astype(int)
    inside = (column >= 0) & (column < scene.camera.width) & (row >= 0) & (row < scene.camera.height)
    shown = np.zeros(len(z))
    shown[inside] = scene.depth[row[inside], column[inside]]
    return float((np.abs(shown - z) < 0.01 * z).mean())


def test_a_depth_image_is_its_own_view() -> None:
    depth = np.full((4, 5), 2.0, dtype=np.float32)
    camera = Camera(10.0, 10.0, 2.0, 2.0, 5, 4)
    scene = seen(Scan(np.ones((20, 3), np.float32), None, depth, camera, "m"))
    assert scene.depth is depth
    assert scene.camera == camera
    np.testing.assert_array_equal(scene.T_scene_camera, np.eye(4))


def test_a_cloud_is_seen_from_the_origin() -> None:
    scene = seen(cloud(wall()))
    np.testing.assert_array_equal(scene.T_scene_camera, np.eye(4))
    assert len(scene.points) == 4000
    assert reached(scene) > 0.97
    rows, columns = np.nonzero(scene.depth)
    filled = len(rows) / (np.ptp(rows) + 1) / (np.ptp(columns) + 1)
    assert 0.2 < filled <= 1


@pytest.mark.parametrize("row", range(3))
def test_frame_and_sensor_may_be_any(row: int) -> None:
    T = pose((5.0, -3.0, 2.0), random_rotations(3, 7)[row])
    points = wall() @ T[:3, :3].T + T[:3, 3]
    scene = seen(cloud(points), T[:3, 3])
    assert reached(scene) > 0.97
    back = scene.points @ scene.T_scene_camera[:3, :3].T + scene.T_scene_camera[:3, 3]
    np.testing.assert_allclose(back, points, atol=1e-4)
    assert (scene.points[:, 2] > 3).all()


@pytest.mark.parametrize("kind", [np.int16, np.int64, np.float16])
def test_a_scan_may_be_of_numbers_of_any_kind(kind: type) -> None:
    points = np.round(1000 * wall())[:400].astype(kind)
    scan, _, _ = read_source(points, "mm", None, box_part())
    assert scan.points.dtype == np.float32
    np.testing.assert_array_equal(scan.points, points)
    with pytest.raises(InputError, match="an image of colours"):
        read_source(points.astype(np.uint8), "mm", None, box_part())


def test_a_sensor_among_the_points_is_refused() -> None:
    with pytest.raises(InputError, match="cannot have been at the origin, among the points: say where it was"):
        seen(cloud(wall() - [0, 0, 4]))
    with pytest.raises(InputError, match="among the points"):
        seen(cloud(wall()), np.array([0.0, 0.0, 4.0]))


def test_a_million_points_and_a_single_one() -> None:
    assert reached(seen(cloud(wall(1_000_000)))) > 0.95
    assert reached(seen(cloud(wall(1)))) == 1


def test_a_large_scan_is_thinned_out_but_for_what_is_asked_for_and_a_small_foreground() -> None:
    points = wall(300_000)
    inside = np.zeros(len(points), dtype=bool)
    inside[7] = True
    place = points[[11]]
    scene = make_scene(cloud(points), 0.5, inside=inside, keep=place)
    assert len(scene.points) <= 131_074
    assert scene.foreground.sum() == 1
    np.testing.assert_array_equal(scene.points[scene.foreground], points[[7]])
    assert (scene.points == place).all(axis=1).any()
    again = make_scene(cloud(points), 0.5, inside=inside, keep=place)
    np.testing.assert_array_equal(scene.points, again.points)
    assert scene.cloud.points.shape == (2**17, 3)
    assert all(size % 256 == 0 for size in scene.image.depth.shape)


def test_regions_are_in_the_frame_of_the_scan() -> None:
    T = pose((5.0, -3.0, 2.0), random_rotations(1, 7)[0])
    points = wall() @ T[:3, :3].T + T[:3, 3]
    low = points[:, 0] < np.median(points[:, 0])
    roi = (-99.0, -99.0, -99.0, float(np.median(points[:, 0])), 99.0, 99.0)
    options = ForegroundOptions(roi=roi, remove_plane="never")
    scene = make_scene(cloud(points), 0.5, sensor=T[:3, 3], background=options)
    assert abs(scene.foreground.mean() - low.mean()) < 0.01
    empty = ForegroundOptions(background=cloud(points[low]), remove_plane="never", background_margin=1e-4)
    left = make_scene(cloud(points), 0.5, sensor=T[:3, 3], background=empty).foreground
    assert abs(left.mean() - (~low).mean()) < 0.01


def test_a_region_may_be_turned() -> None:
    T = pose((5.0, -3.0, 2.0), random_rotations(1, 7)[0])
    points, size = wall(), np.array([1.5, 1.0, 20.0])
    wanted = (np.abs(points[:, :2]) <= size[:2] / 2).all(axis=1)
    assert 0 < wanted.mean() < 1
    # The box is in line with the axes of a frame in which the scan is not.
    roi = OrientedBox(T, size)
    options = ForegroundOptions(roi=roi, remove_plane="never")
    scene = make_scene(cloud(points @ T[:3, :3].T + T[:3, 3]), 0.5, sensor=T[:3, 3], background=options)
    assert scene.is_narrowed
    np.testing.assert_array_equal(scene.foreground, wanted)
    turn = Rotation.from_matrix(T[:3, :3]).as_rotvec(degrees=True)
    again = OrientedBox.of_numbers([*T[:3, 3].tolist(), *size.tolist(), *turn.tolist()])
    np.testing.assert_allclose(again.T_scene_box, T, atol=1e-9)
    for pose_of_box, sides, match in ((2 * np.eye(4), size, "a rotation"), (T, -size, "above zero")):
        with pytest.raises(InputError, match=match):
            OrientedBox(pose_of_box, sides)


def test_a_scene_without_foreground_is_refused() -> None:
    with pytest.raises(InputError, match="no point of the scan is left as foreground"):
        make_scene(cloud(wall()), 0.5, inside=np.zeros(4000, dtype=bool))


def test_scenes_of_other_sizes_compile_nothing() -> None:
    compiled: list[str] = []

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    def prepared(count: int, height: int, seeds: int) -> tuple[tuple[int, ...], ...]:
        scene = seen(cloud(wall(count)))
        rows = seeds_over(scene, scene.foreground, box_part(), seeds)
        assert len(rows) == seeds
        assert seed_keys(rows, 0).shape == (seeds, 2)
        image = depth_image(height)
        return scene.cloud.points.shape, scene.image.depth.shape, image.image.depth.shape

    def depth_image(height: int) -> Scene:
        camera = Camera(10.0, 10.0, 2.0, 2.0, 50, height)
        depth = np.full((height, 50), 2.0, dtype=np.float32)
        return seen(Scan(measured_points(depth, camera), None, depth, camera, "m"))

    first = prepared(4000, 40, 3)
    jax.monitoring.register_event_duration_secs_listener(listen)
    assert prepared(9000, 300, 5) == prepared(70, 1000, 2) == first
    assert compiled == []
    jax.jit(lambda x: x + 1)(np.float32(1))
    assert len(compiled) == 1


def test_large_scans_keep_the_capacity_and_the_asked_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kmn_jax.detection._scene.MOST_POINTS", 1024)
    points = wall(4000)
    places = points[[5, 2000, 3999]].astype(np.float64)
    scene = make_scene(cloud(points), 0.5, inside=np.ones(4000, dtype=bool), keep=places)
    assert scene.cloud.points.shape == (1024, 3)
    assert all((scene.points == place.astype(np.float32)).all(axis=1).any() for place in places)
    assert reached(scene) > 0.97
