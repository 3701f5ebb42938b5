"""Pictures of boxes, plates and rings before a wall, in it and half hidden."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import DepthImage, PictureAgreement, picture_agreement
from kmn_jax.geometry import intrinsics
from kmn_jax.simulate import Surfels
from tests.detection.box_sample import CAMERA, POSES, SIZES, WALL, box_part, box_view
from tests.reference.meshes import pose

PART = box_part()
SURFELS = Surfels(jnp.asarray(PART.points), jnp.asarray(PART.normals), jnp.float32(PART.area))
NO_SHARES = ("offset", "log_cells", "log_area", "deviation", "noise", "raised", "relief_alike")
NO_SHARES += ("relief_odds", "relief_slope", "relief_slope_error", "log_pixel")
compare = jax.jit(picture_agreement)


@pytest.fixture(scope="module")
def depth() -> jax.Array:
    image = box_view().depth
    assert image is not None
    return jnp.asarray(image)


def directions() -> tuple[np.ndarray, np.ndarray]:
    """Return x and y of what each pixel shows where it is one unit away."""
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    return (columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy


def of(T: np.ndarray, depth: jax.Array) -> PictureAgreement:
    found: PictureAgreement = compare(
        jnp.asarray(T, dtype=jnp.float32),
        SURFELS,
        DepthImage(depth, intrinsics(CAMERA)),
        jnp.float32(PART.diameter),
    )
    assert np.isfinite(np.array(found)).all()
    for name in set(found._fields) - set(NO_SHARES):
        assert 0 <= getattr(found, name) <= 1 + 1e-6, name
    assert found.open + found.level + found.fronted <= 1 + 1e-6
    return found


def test_beyond_a_box_before_a_wall_is_the_wall(depth: jax.Array) -> None:
    for T in POSES:
        assert of(T, depth).open > 0.95


def test_a_wall_goes_on_beyond_a_box_sunk_into_it(depth: jax.Array) -> None:
    found = of(pose((0.0, 0.0, WALL + SIZES[2] / 2)), jnp.full_like(depth, WALL))
    assert found.level > 0.95
    assert found.open == 0


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.3, -0.2), (-0.5, 0.1)])
def test_a_box_on_a_floor_is_above_it_and_one_in_it_is_buried(depth: jax.Array, tilt: tuple[float, float]) -> None:
    x, y = directions()
    floor = jnp.asarray(WALL / (1 - tilt[0] * x - tilt[1] * y), dtype=jnp.float32)
    down = np.array([-tilt[0], -tilt[1], 1.0]) / np.linalg.norm([*tilt, 1.0])
    along = np.cross([0.0, 1.0, 0.0], down)
    along /= np.linalg.norm(along)
    lying, flush = np.eye(4), np.eye(4)
    for T, way in ((lying, -0.5), (flush, 0.5)):
        T[:3, :3] = np.stack([along, np.cross(down, along), down], axis=1)
        T[:3, 3] = np.array([0.0, 0.0, WALL]) + way * SIZES[2] * down
    above, below = of(lying, floor), of(flush, floor)
    assert above.buried < 0.01
    assert below.buried > 0.6  # all but the front and the upper edges of the sides
    assert above.surrounded > 0.8
    assert max(above.uneven, below.uneven) < 0.01
    assert above.buried_between < 0.01
    assert 0.2 < below.buried_between < below.surrounded  # what is in front of the box hides it, and is not around it
    height = SIZES[2] / 2 / down[2] / PART.diameter  # of the middle, along the line of sight
    np.testing.assert_allclose([above.raised, below.raised], [height, -height], atol=0.02)


def test_without_surroundings_nothing_is_buried(depth: jax.Array) -> None:
    for nothing in (jnp.zeros_like(depth), jnp.full_like(depth, 1.0)):  # not measured, or hidden
        found = of(POSES[0], nothing)
        assert (found.buried, found.raised) == (0, 0)
        assert (found.surrounded, found.buried_between) == (0, 0)
        assert (found.beside, found.uneven, found.buried_deep) == (0, 0, 0)


def test_beside_uneven_neighbours_a_box_is_less_deep_than_in_a_floor() -> None:
    # Flush with a floor, and with one of tiles of which every second one lies lower by the height of the box.
    T = pose((0.0, 0.0, WALL + SIZES[2] / 2))
    x, y = directions()
    tile = SIZES[0] / WALL / 3
    steps = np.where((np.floor(x / tile) + np.floor(y / tile)) % 2 == 0, 0.0, SIZES[2])
    box = (np.abs(x) * WALL < SIZES[0] / 2) & (np.abs(y) * WALL < SIZES[1] / 2)
    even, uneven = (
        of(T, jnp.asarray(np.where(box, WALL, WALL + off), dtype=jnp.float32)) for off in (np.zeros_like(steps), steps)
    )
    assert even.uneven < 1e-3
    assert even.buried_deep > 0.9 * even.buried > 0.5
    assert 0.3 * SIZES[2] < uneven.uneven * PART.diameter < 0.7 * SIZES[2]
    assert uneven.buried_deep < 0.3 * uneven.buried
    assert even.beside > 0.95


def test_beside_a_slope_that_is_all_there_is_hardly_anything_is_known_to_be_buried(depth: jax.Array) -> None:
    # A slope that is measured to the right of the box alone, and would rise above all of it.
    T = pose((0.0, 0.0, WALL))
    edge = SIZES[0] / 2 / (WALL - SIZES[2] / 2)
    x, _ = directions()
    slope = np.where(x > edge, WALL / (1 + 2 * (edge - x)), 0)
    found = of(T, jnp.asarray(slope, dtype=jnp.float32))
    whole = of(T, jnp.asarray(np.where(x > edge, slope, WALL - SIZES[2] / 2), dtype=jnp.float32))
    assert found.surrounded < 0.2 < 0.6 < whole.surrounded
    assert found.buried_between <= found.surrounded < found.buried


def test_a_pose_half_on_a_box_is_open_there_only(depth: jax.Array) -> None:
    # Moved by half its length along y: one of its sides lies on the box.
    found = of(POSES[0] @ pose((0.0, SIZES[1] / 2, 0.0)), depth)
    on_box = SIZES[0] / (2 * SIZES[0] + 2 * SIZES[1])
    assert abs(found.level - on_box) < 0.06
    assert abs(found.open - (1 - on_box)) < 0.06


def test_what_is_hidden_counts_for_neither_and_what_was_not_measured_is_open(depth: jax.Array) -> None:
    hidden, unmeasured = of(POSES[0], jnp.full_like(depth, 1.0)), of(POSES[0], jnp.zeros_like(depth))
    assert (hidden.open, hidden.level, hidden.fronted, hidden.near) == (0, 0, 1, 0)
    assert (unmeasured.open, unmeasured.level, unmeasured.stepped, unmeasured.near) == (1, 0, 0, 0)
    left = np.arange(depth.shape[1]) < CAMERA.cx + CAMERA.fx * POSES[0][0, 3] / (POSES[0][2, 3] - SIZES[2] / 2)
    assert abs(of(POSES[0], jnp.where(jnp.asarray(left)[None], depth, 1.0)).open - 0.5) < 0.06
    assert of(POSES[0], jnp.where(jnp.asarray(left)[None], depth, 0)).open > 0.95


def test_a_pose_behind_the_sensor_or_outside_of_the_image_has_no_outline(depth: jax.Array) -> None:
    for T in (pose((0.0, 0.0, -3.0)), pose((9.0, 0.0, 3.0))):
        found = of(T, depth)
        assert (found.open, found.level, found.near) == (0, 0, 0)
        assert (found.relief_odds, found.relief_slope, found.relief_slope_error) == (0, 0, 1)
    assert of(pose((0.0, 0.0, -3.0)), depth).log_pixel == 0
    tiny = of(pose((0.0, 0.0, 200.0)), jnp.full_like(depth, 300.0))  # the box is less than a pixel large
    assert (tiny.open, tiny.level) == (1, 0)


def test_a_sparse_image_of_a_wall_is_still_level(depth: jax.Array) -> None:
    holes = jnp.asarray(np.random.default_rng(0).random(depth.shape) < 0.4)
    found = of(pose((0.0, 0.0, WALL + SIZES[2] / 2)), jnp.where(holes, 0, WALL))
    assert found.level > 0.95


def test_what_is_seen_through_counts_where_it_is_most() -> None:
    camera, diameter, T = intrinsics(CAMERA), jnp.float32(2**0.5), jnp.asarray(pose((0.0, 0.0, 3.0)), jnp.float32)
    x, y = (3 * way for way in directions())
    cell = 1 / 31  # of the plate's 32, of which the outer ones have their middles on its edges

    def with_hole(cells: float, at: float = 0.0) -> PictureAgreement:
        """Return what is found of a plate where a wall has a square hole, in the plate's diagonal from its middle."""
        hole = np.maximum(abs(x - at), abs(y - at)) < cells * cell / 2
        image = DepthImage(jnp.asarray(np.where(hole, 3.5, 3.0), dtype=jnp.float32), camera)
        found: PictureAgreement = compare(T, plate(), image, diameter)
        return found

    # A cell is seen through where all of it is.
    for hole, number, in_3, in_7 in (
        (with_hole(0), 0, 0, 0),
        (with_hole(2.5, 0.2), 4, 4, 4),
        (with_hole(4, 0.2), 9, 9, 9),
        (with_hole(8, 0.5), 16, 9, 16),  # what lies beyond the plate's corner counts for nothing
        (with_hole(11), 100, 9, 49),
    ):
        assert hole.behind == pytest.approx(number / 32**2)
        assert hole.behind_in_3 == pytest.approx(in_3 / 9)
        assert hole.behind_in_7 == pytest.approx(in_7 / 49)


def test_holes_have_an_outline(depth: jax.Array) -> None:
    plate = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 60), np.linspace(-0.5, 0.5, 60)), axis=-1).reshape(-1, 2)
    ring = plate[np.linalg.norm(plate, axis=1) > 0.3]
    points = np.concatenate([ring, np.zeros((len(ring), 1))], axis=1).astype(np.float32)
    surfels = Surfels(jnp.asarray(points), jnp.broadcast_to(jnp.array([0.0, 0, -1]), points.shape), jnp.float32(0.7))
    wall = jnp.full_like(depth, 3.0)
    through = jnp.where(depth >= 0, wall, 0)
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    away = np.hypot(columns - CAMERA.cx, rows - CAMERA.cy) / CAMERA.fx * 3
    hole = jnp.where(jnp.asarray(away) < 0.3, 4.0, through)
    camera, diameter = intrinsics(CAMERA), jnp.float32(2**0.5)
    T = jnp.asarray(pose((0.0, 0.0, 3.0)), dtype=jnp.float32)
    closed, opened = (compare(T, surfels, DepthImage(image, camera), diameter) for image in (through, hole))
    assert closed.open == 0
    assert 0.2 < opened.open < 0.5  # two pi 0.3 of it and 4


def test_a_box_where_it_was_measured_agrees_in_depth_and_normals(depth: jax.Array) -> None:
    for T in POSES:
        right = of(T, depth)
        assert right.near > 0.8
        assert right.aligned > 0.8
        assert right.turned < 0.1
        assert right.coplanar < 0.05
        assert right.deviation < 0.015
        assert abs(right.offset) < 0.005
        moved = of(T @ pose((0.0, 0.0, 0.1 * PART.diameter)), depth)
        assert moved.near < 0.3
    behind = of(POSES[0] @ pose((0.0, 0.0, -0.3 * PART.diameter)), depth)
    assert behind.behind > 0.6


def plate(normal: tuple[float, float, float] = (0.0, 0.0, -1.0)) -> Surfels:
    flat = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 45), np.linspace(-0.5, 0.5, 45)), axis=-1).reshape(-1, 2)
    points = np.concatenate([flat, np.zeros((len(flat), 1))], axis=1).astype(np.float32)
    return Surfels(jnp.asarray(points), jnp.broadcast_to(jnp.array(normal), points.shape), jnp.float32(1.0))


def test_a_plate_in_a_larger_plane_is_told_from_one_that_ends(depth: jax.Array) -> None:
    camera, diameter, T = intrinsics(CAMERA), jnp.float32(2**0.5), jnp.asarray(pose((0.0, 0.0, 3.0)), jnp.float32)
    wall = jnp.full_like(depth, 3.0)
    x, y = (3 * way for way in directions())
    own = jnp.asarray((abs(x) <= 0.5) & (abs(y) <= 0.5))
    in_wall = compare(T, plate(), DepthImage(wall, camera), diameter)
    above, on_floor = (
        compare(T, plate(), DepthImage(jnp.where(own, 3.0, floor), camera), diameter) for floor in (3.3, 3.05)
    )
    assert in_wall.near == on_floor.near == above.near == 1
    assert in_wall.coplanar > 0.9
    assert above.coplanar == 0
    # Of a thin sheet, the slope at its edge may be taken for its own.
    assert on_floor.coplanar < 0.6
    assert on_floor.stepped > 0.8 > 0.2 > in_wall.stepped
    assert in_wall.variety < 0.01
    # Its area in the square of the diameter is a half.
    assert abs(float(in_wall.log_area) - np.log(0.5)) < 0.15


def test_noise_and_turned_normals_are_measured(depth: jax.Array) -> None:
    camera, diameter, T = intrinsics(CAMERA), jnp.float32(2**0.5), jnp.asarray(pose((0.0, 0.0, 3.0)), jnp.float32)
    noise = jnp.asarray(np.random.default_rng(0).normal(0, 0.01, depth.shape), jnp.float32)
    found = compare(T, plate(), DepthImage(3.0 + noise, camera), diameter)
    assert abs(float(found.noise) * 2**0.5 / 0.01 - 1) < 0.25
    assert abs(float(found.deviation) * 2**0.5 / 0.01 - 0.5) < 0.25  # of the mean of five
    slanted = compare(T, plate((0.8, 0.0, -0.6)), DepthImage(jnp.full_like(depth, 3.0), camera), diameter)
    assert slanted.aligned == 0
    assert slanted.near == 1


def test_relief_that_is_measured_and_relief_that_is_not(depth: jax.Array) -> None:
    camera, diameter, T = intrinsics(CAMERA), jnp.float32(2**0.5), jnp.asarray(pose((0.0, 0.0, 3.0)), jnp.float32)
    flat = plate()
    ridge = flat._replace(points=flat.points.at[:, 2].set(0.1 * jnp.abs(flat.points[:, 0])))  # within 4%
    x = (jnp.arange(CAMERA.width, dtype=jnp.float32)[None] - CAMERA.cx) / CAMERA.fx * 3
    wall = jnp.full_like(depth, 3.0)
    bent = wall + 0.1 * jnp.abs(x)
    both, missing, strange, neither = (
        compare(T, one, DepthImage(image, camera), diameter)
        for one, image in ((ridge, bent), (ridge, wall), (flat, bent), (flat, wall))
    )
    # |x| over (-1/2, 1/2) departs from its mean by a root of 1/48; what is a little tilted is as flat.
    assert both.relief == pytest.approx(0.1 * 48**-0.5 / 2**0.5, rel=0.1)
    assert both.relief_alike > 0.95
    assert both.relief_missed < 0.2 * both.relief
    assert missing.relief_missed == pytest.approx(float(missing.relief), rel=0.1)
    assert strange.relief < 0.1 * both.relief < strange.relief_missed
    assert abs(missing.relief_alike) < 0.3
    assert neither.relief_missed < 0.02 * both.relief
    tilted = compare(T, flat, DepthImage(wall + 0.03 * x, camera), diameter)
    assert tilted.relief_missed < 0.05 * both.relief
    # Half of a plate's cells, times the log of how much farther the plane is off, of what is never sure to 0.2%.
    cells = float(jnp.expm1(both.log_cells))
    for found, sure in ((both, 1), (missing, -1)):
        square = float(both.relief) ** 2 / 0.002**2
        odds = np.log1p(cells / 2 * np.log1p(square))
        assert found.relief_odds == pytest.approx(sure * odds, rel=0.1)
        assert found.relief_slope == pytest.approx((1 + sure) / 2, abs=0.2)
        assert 0 < found.relief_slope_error < 0.05
    assert abs(neither.relief_odds) < 1
    assert both.log_pixel == pytest.approx(np.log(3.0 / CAMERA.fx / 2**0.5), abs=0.01)


def test_noise_hides_relief_from_its_correlation_sooner_than_from_its_odds(depth: jax.Array) -> None:
    camera, diameter, T = intrinsics(CAMERA), jnp.float32(2**0.5), jnp.asarray(pose((0.0, 0.0, 3.0)), jnp.float32)
    flat = plate()
    ridge = flat._replace(points=flat.points.at[:, 2].set(0.1 * jnp.abs(flat.points[:, 0])))
    x = (jnp.arange(CAMERA.width, dtype=jnp.float32)[None] - CAMERA.cx) / CAMERA.fx * 3
    noise = jnp.asarray(np.random.default_rng(0).normal(0, 0.03, depth.shape), jnp.float32)
    bent, even = (compare(T, ridge, DepthImage(3.0 + way * jnp.abs(x) + noise, camera), diameter) for way in (0.1, 0.0))
    assert bent.relief_alike < 0.8
    assert bent.relief_odds > 3
    assert even.relief_odds < -3
    # Where a relief may as well be noise, its slope is called less.
    assert 0.7 < bent.relief_slope < 1
    assert abs(even.relief_slope) < 4 * even.relief_slope_error


def test_the_background_is_no_relief_nor_is_the_slant_of_a_plate(depth: jax.Array) -> None:
    camera, diameter = intrinsics(CAMERA), jnp.float32(2**0.5)
    x, y = directions()
    turn = np.pi / 9
    T = np.eye(4)
    T[:3, :3] = [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    T[:3, :3] = T[:3, :3] @ [[0.5**0.5, 0, 0.5**0.5], [0, 1, 0], [-(0.5**0.5), 0, 0.5**0.5]]
    T[2, 3] = 4.0
    away = 4.0 * T[2, 2] / (T[0, 2] * x + T[1, 2] * y + T[2, 2])
    local = np.stack([x * away, y * away, away - 4.0], axis=-1) @ T[:3, :3]
    own = np.abs(local[..., :2]).max(axis=-1) <= 0.5
    for background in (5.0, 8.0):
        image = jnp.asarray(np.where(own, away, background), dtype=jnp.float32)
        found = compare(jnp.asarray(T, dtype=jnp.float32), plate(), DepthImage(image, camera), diameter)
        assert found.near > 0.9
        assert found.relief < 3e-3
        assert found.relief_missed < 5e-3
