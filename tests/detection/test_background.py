from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Float

from kmn_jax.detection import bin_content
from kmn_jax.detection._background import BinMargins, away_from_empty, in_front_of_empty, inside_bin
from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera, depth_to_points
from kmn_jax.simulate import Bin

CAMERA = Camera(fx=300.0, fy=300.0, cx=159.5, cy=119.5, width=320, height=240)
BIN = Bin(length=0.3, width=0.2, height=0.1, thickness=0.01)
DIAMETER = 0.06
BALLS = np.array([[0.0, 0.0, 0.03], [0.1, 0.05, 0.03], [-0.1, -0.04, 0.12]])  # bin frame; the last one tops the rim
RADIUS = DIAMETER / 2


def camera_pose() -> Float[np.ndarray, "4 4"]:
    """Return T_camera_bin of a camera that looks down at the bin, tilted and turned."""
    about_x, about_z = np.radians(165), np.radians(20)
    tilt = np.array([[1, 0, 0], [0, np.cos(about_x), -np.sin(about_x)], [0, np.sin(about_x), np.cos(about_x)]])
    turn = np.array([[np.cos(about_z), -np.sin(about_z), 0], [np.sin(about_z), np.cos(about_z), 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn @ tilt, [0.01, -0.02, 0.6]
    return pose


def rendered(with_balls: bool) -> tuple[Float[np.ndarray, "h w"], np.ndarray]:
    """Return the depth of table, bin and balls, and which pixels show balls; open3d casts the rays."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene(nthreads=1)

    def add(mesh: open3d.geometry.TriangleMesh, center: Float[np.ndarray, "3"]) -> None:
        mesh.translate(center, relative=False)
        mesh.transform(camera_pose())
        scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))

    thick = BIN.thickness
    outer = (BIN.length + 2 * thick, BIN.width + 2 * thick)
    walls = [((thick, outer[1], BIN.height), (side * (BIN.length + thick) / 2, 0, BIN.height / 2)) for side in (-1, 1)]
    walls += [((outer[0], thick, BIN.height), (0, side * (BIN.width + thick) / 2, BIN.height / 2)) for side in (-1, 1)]
    slabs = [((*outer, thick), (0, 0, -thick / 2)), ((2.0, 2.0, 0.01), (0, 0, -thick - 0.005)), *walls]
    for size, center in slabs:
        add(open3d.geometry.TriangleMesh.create_box(*size), np.array(center, dtype=float))
    for center in BALLS if with_balls else []:
        add(open3d.geometry.TriangleMesh.create_sphere(RADIUS, 40), center)
    points = depth_to_points(jnp.ones((CAMERA.height, CAMERA.width)), jnp.asarray(CAMERA.matrix, jnp.float32))
    rays = np.concatenate([np.zeros(points.shape, np.float32), np.asarray(points)], axis=-1)
    hits = scene.cast_rays(open3d.core.Tensor(rays))
    shown = hits["geometry_ids"].numpy()
    depth = np.where(np.isfinite(hits["t_hit"].numpy()), hits["t_hit"].numpy(), 0)
    return depth, (shown >= len(slabs)) & (shown < 100)


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    depth, balls = rendered(with_balls=True)
    empty, _ = rendered(with_balls=False)
    return depth, empty, balls


def points_of(depth: np.ndarray) -> np.ndarray:
    points = depth_to_points(jnp.asarray(depth), jnp.asarray(CAMERA.matrix, jnp.float32))
    return np.asarray(points).reshape(-1, 3)


def above_margins(depth: np.ndarray, margin: float) -> np.ndarray:
    """Say which pixels' points are above floor and off the walls by a margin, by inverting the pose in float64."""
    local = (points_of(depth) - camera_pose()[:3, 3]) @ camera_pose()[:3, :3]
    inside = (np.abs(local[:, :2]) < np.array([BIN.length, BIN.width]) / 2 - margin).all(axis=1)
    return (inside & (local[:, 2] > margin)).reshape(depth.shape)


def test_known_bin(scene: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    depth, _, balls = scene
    kept = np.asarray(bin_content(depth, CAMERA, camera_pose(), BIN, DIAMETER))
    assert balls.sum() > 1000
    assert not (kept & ~balls).any()  # nothing of floor, walls, rim and table
    assert (kept & balls).sum() / balls.sum() > 0.97
    np.testing.assert_array_equal(kept[balls], above_margins(depth, 0.03 * DIAMETER)[balls])
    np.testing.assert_array_equal(
        np.asarray(inside_bin(points_of(depth), camera_pose(), BIN, DIAMETER)).reshape(depth.shape), kept
    )


def test_margins(scene: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    depth, _, balls = scene
    low = np.asarray(bin_content(depth, CAMERA, camera_pose(), BIN, DIAMETER, BinMargins(above_rim=0.0)))
    points = (points_of(depth) - camera_pose()[:3, 3]) @ camera_pose()[:3, :3]
    assert points[low.ravel(), 2].max() < BIN.height
    open_margins = BinMargins(floor=-0.02, wall=-0.02)
    everything = np.asarray(bin_content(depth, CAMERA, camera_pose(), BIN, DIAMETER, open_margins))
    assert everything[balls].all()
    assert everything.sum() > 2 * balls.sum()  # floor and walls, too
    with pytest.raises(InputError, match="the margins leave nothing of the bin"):
        bin_content(depth, CAMERA, camera_pose(), BIN, DIAMETER, BinMargins(wall=2.0))
    with pytest.raises(InputError, match="must be finite"):
        BinMargins(floor=float("nan"))


def test_what_was_not_measured_is_not_content(scene: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    depth, empty, balls = scene
    holed = depth.copy()
    holed[balls] = np.where(np.arange(balls.sum()) % 2, 0, np.nan)
    around_camera = np.diag([1.0, -1.0, -1.0, 1.0])  # the camera itself is inside of this bin
    around_camera[2, 3] = 0.01
    assert not np.asarray(bin_content(np.where(balls, holed, 0), CAMERA, around_camera, BIN, DIAMETER)).any()
    assert not np.asarray(in_front_of_empty(holed, empty, DIAMETER, 0.05)).any()
    bad = np.array([[np.nan, 0, 0], [0, np.inf, 0.5]], np.float32)
    assert not np.asarray(inside_bin(bad, camera_pose(), BIN, DIAMETER)).any()
    assert not away_from_empty(bad, np.zeros((1, 3), np.float32), DIAMETER, 0.05).any()


def test_difference_from_the_empty_depth(scene: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    depth, empty, balls = scene
    noise = np.random.default_rng(0).normal(scale=0.0005, size=depth.shape).astype(np.float32)
    kept = np.asarray(in_front_of_empty(depth + noise, empty, DIAMETER, 0.05))
    assert not (kept & ~balls).any()
    assert (kept & balls).sum() / balls.sum() > 0.96
    nearer = empty - depth
    np.testing.assert_array_equal(np.asarray(in_front_of_empty(depth, empty, DIAMETER, 0.05)), nearer > 0.003)
    unknown = empty.copy()
    unknown[100:140] = 0
    kept = np.asarray(in_front_of_empty(depth, unknown, DIAMETER, 0.05))
    assert kept[100:140].all()
    assert not np.asarray(in_front_of_empty(empty + np.float32(0.1), empty, DIAMETER, 0.05)).any()


def test_difference_from_the_empty_cloud(scene: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    depth, empty, balls = scene
    kept = away_from_empty(points_of(depth), points_of(empty), DIAMETER, 0.05).reshape(depth.shape)
    assert not (kept & ~balls).any()
    assert (kept & balls).sum() / balls.sum() > 0.9
    points, reference = np.array([[0, 0, 1], [0, 0, 2], [0, 3, 1]], np.float32), np.array([[0, 0, 1.0]], np.float32)
    assert away_from_empty(points, reference, 1.0, 1.0).tolist() == [False, False, True]
    assert away_from_empty(points, reference, 1.0, 0.99).tolist() == [False, True, True]
    with pytest.raises(InputError, match="empty_points holds no finite point"):
        away_from_empty(points, np.full((2, 3), np.nan, np.float32), 1.0, 0.1)


def test_bad_input_is_named() -> None:
    depth = np.ones((240, 320), np.float32)
    with pytest.raises(InputError, match="depth has shape"):
        bin_content(depth[:-1], CAMERA, camera_pose(), BIN, DIAMETER)
    with pytest.raises(InputError, match="T_camera_bin is not a rigid pose"):
        bin_content(depth, CAMERA, 2 * np.eye(4), BIN, DIAMETER)
    with pytest.raises(InputError, match="diameter is 0"):
        inside_bin(np.zeros((1, 3), np.float32), camera_pose(), BIN, 0.0)
    with pytest.raises(InputError, match="depth has shape"):
        in_front_of_empty(depth, depth[:-1], DIAMETER, 0.1)
    with pytest.raises(InputError, match="depth holds whole numbers"):
        in_front_of_empty(np.full((4, 5), 900, np.uint16), np.ones((4, 5)), DIAMETER, 0.05)
    with pytest.raises(InputError, match="margin is -1"):
        in_front_of_empty(depth, depth, DIAMETER, -1.0)
