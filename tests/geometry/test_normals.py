"""Normals of planes and spheres, from clouds and depth maps, against NumPy's eigh; degenerate neighbourhoods."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.geometry import _normals as normals
from kmn_jax.geometry import depth_normals, depth_to_points, estimate_normals, orient_to_camera

SEEDS = range(3)
estimate = jax.jit(estimate_normals, static_argnames="k")
from_depth = jax.jit(depth_normals, static_argnames="window_radius")
orient, to_points = jax.jit(orient_to_camera), jax.jit(depth_to_points)
HEIGHT, WIDTH, FOCAL = 60, 80, 100.0
INTRINSICS = np.array([[FOCAL, 0, 38.5], [0, FOCAL, 31], [0, 0, 1]], dtype=np.float32)


def angles(found: np.ndarray, expected: np.ndarray, signed: bool = False) -> np.ndarray:
    """Return the angles between unit vectors in degrees."""
    cosine = (np.asarray(found, dtype=np.float64) * expected).sum(axis=-1)
    sine = np.linalg.norm(np.cross(np.asarray(found, dtype=np.float64), expected), axis=-1)
    return np.degrees(np.arctan2(sine, cosine if signed else np.abs(cosine)))


def noisy_sphere(seed: int, total: int, sigma: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(total, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return (directions + sigma * rng.normal(size=(total, 3))).astype(np.float32), directions


def tilted_plane(seed: int, total: int, sigma: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = rng.uniform(-1, 1, size=(total, 3)) * [1, 1, 0]
    flat[:, 2] = sigma * rng.normal(size=total)
    return (flat @ basis.T).astype(np.float32), basis[:, 2]


def normals_by_eigh(points: np.ndarray, k: int) -> np.ndarray:
    points = points.astype(np.float64)
    order = np.argsort(((points[:, None] - points[None]) ** 2).sum(axis=2), axis=1)[:, :k]
    return np.stack([np.linalg.eigh(np.cov(points[row].T))[1][:, 0] for row in order])


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("offset", [0.0, 10.0])
def test_cloud_normals_are_the_eigenvectors_of_the_least_spread(seed: int, offset: float) -> None:
    points = noisy_sphere(seed, 300, 0.02)[0] + np.float32(offset)
    found, valid = estimate(points, k=12)
    assert np.asarray(valid).all()
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    # Rounding may swap a near-tie in one neighbourhood; all others agree to rounding.
    error = angles(found, normals_by_eigh(points, 12))
    assert np.quantile(error, 0.98) < 0.05
    assert error.max() < 5


@pytest.mark.parametrize("seed", SEEDS)
def test_cloud_normals_of_a_plane(seed: int) -> None:
    points, expected = tilted_plane(seed, 300)
    found, valid = estimate(points + np.array([5, -3, 8], dtype=np.float32), k=12)
    assert np.asarray(valid).all()
    assert angles(found, expected).max() < 0.05
    noisy, expected = tilted_plane(seed, 300, sigma=0.005)
    # Neighbourhoods are about 0.2 wide: sigma 0.005 leaves a few degrees.
    assert np.median(angles(estimate(noisy, k=30)[0], expected)) < 2


@pytest.mark.parametrize("seed", SEEDS)
def test_cloud_normals_of_a_noisy_sphere_point_outwards_once_oriented(seed: int) -> None:
    points, expected = noisy_sphere(seed, 2000, 0.005)
    found, valid = estimate(points, k=30)
    assert np.asarray(valid).all()
    camera = np.float32([0, 0, -10])
    oriented = np.asarray(orient(points, found, camera))
    seen = (expected * (camera - points)).sum(axis=1) > 2
    error = angles(oriented, expected, signed=True)[seen]
    assert np.median(error) < 2
    assert error.max() < 10


def test_camera_at_the_origin_is_the_default_and_zero_normals_stay_zero() -> None:
    points = np.float32([[0, 0, 5], [0, 0, 5], [0, 0, -5], [1, 1, 1]])
    given = np.float32([[0, 0, 1], [0, 0, -1], [0, 0, -1], [0, 0, 0]])
    np.testing.assert_array_equal(orient(points, given), [[0, 0, -1], [0, 0, -1], [0, 0, 1], [0, 0, 0]])


def test_a_radius_keeps_a_neighbourhood_on_its_own_surface() -> None:
    # Two parallel sheets 0.2 apart with points 0.1 apart: 30 neighbours reach across, those within 0.15 do not.
    side = np.stack(np.meshgrid(np.arange(8), np.arange(8)), axis=-1).reshape(-1, 2) * 0.1
    sheet = np.concatenate([side, np.zeros((64, 1))], axis=1)
    points = np.concatenate([sheet, sheet + np.array([0.03, 0.02, 0.2])]).astype(np.float32)
    found, valid = estimate(points, k=30, max_radius=0.15)
    assert np.asarray(valid).all()
    assert angles(found, [0, 0, 1]).max() < 0.05
    assert not np.asarray(estimate(points, k=30, max_radius=0.05)[1]).any()


@pytest.mark.parametrize("padding", [0.0, 1e5, np.nan, np.inf])
def test_padding_changes_no_cloud_normal_whatever_it_holds(padding: float) -> None:
    points = noisy_sphere(0, 300)[0]
    mask = np.arange(300) % 3 != 0
    padded = np.where(mask[:, None], points, np.float32(padding))
    found, valid = estimate(padded, k=12, mask=mask)
    np.testing.assert_array_equal(valid, mask)
    assert angles(np.asarray(found)[mask], np.asarray(estimate(points[mask], k=12)[0])).max() < 0.05
    np.testing.assert_array_equal(np.asarray(found)[~mask], 0)


@pytest.mark.parametrize(
    "points",
    [
        np.ones((1, 3)),
        np.array([[0.0, 0, 0], [1, 2, 3]]),
        np.ones((40, 3)) * [100, 200, 300.7],
        np.repeat(np.array([[0.0, 0, 0], [1, 2, 3]]), 20, axis=0),
        np.linspace(0, 1, 40)[:, None] * [1, -2, 0.3] + [10, 20, 30],
        np.full((40, 3), np.nan),
    ],
    ids=["one point", "two points", "coincident", "two places", "a line", "NaN"],
)
def test_degenerate_clouds_have_no_valid_normal_and_no_nan(points: np.ndarray) -> None:
    found, valid = estimate(points.astype(np.float32))
    assert not np.asarray(valid).any()
    np.testing.assert_array_equal(found, 0)


def test_an_all_masked_cloud_has_no_valid_normal() -> None:
    found, valid = estimate(noisy_sphere(0, 300)[0], k=12, mask=np.zeros(300, dtype=bool))
    assert not np.asarray(valid).any()
    np.testing.assert_array_equal(found, 0)


@pytest.mark.parametrize("num_real", [3, 5])
def test_fewer_real_points_than_k_use_what_there_is(num_real: int) -> None:
    points, expected = tilted_plane(0, 300)
    found, valid = estimate(points, k=12, mask=np.arange(300) < num_real)
    np.testing.assert_array_equal(valid, np.arange(300) < num_real)
    assert angles(np.asarray(found)[:num_real], expected).max() < 0.1


def test_blocks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    points = noisy_sphere(0, 300)[0]
    whole, _ = estimate(points, k=12)
    monkeypatch.setattr(normals, "_MAX_DISTANCES", 300 * 70)  # five blocks, the last one partly filled
    blocked, valid = jax.jit(lambda cloud: estimate_normals(cloud, 12))(points)
    assert np.asarray(valid).all()
    assert angles(np.asarray(blocked), np.asarray(whole)).max() < 0.05


def test_blocks_bound_the_memory() -> None:
    # Dense distances of 20,000 points would be 1.6 GB.
    lowered = jax.jit(estimate_normals).lower(jax.ShapeDtypeStruct((20_000, 3), jnp.float32))
    memory = lowered.compile().memory_analysis()
    assert memory is None or memory.temp_size_in_bytes < 300e6


def test_cloud_mistakes_are_refused() -> None:
    with pytest.raises(ValueError, match="empty"):
        estimate_normals(jnp.zeros((0, 3)))
    with pytest.raises(ValueError, match="k = 2"):
        estimate(noisy_sphere(0, 300)[0], k=2)
    with pytest.raises(InputError, match="max_radius"):
        estimate_normals(jnp.zeros((5, 3)), max_radius=-1.0)


def test_cloud_normals_vmap_equals_a_loop_and_jit_equals_eager() -> None:
    points = np.stack([noisy_sphere(seed, 300)[0] for seed in range(3)])
    batched, valid = jax.jit(jax.vmap(partial(estimate_normals, k=12)))(points)
    assert np.asarray(valid).all()
    for one, found in zip(points, np.asarray(batched), strict=True):
        assert angles(np.asarray(estimate(one, k=12)[0]), found).max() < 0.05
    assert angles(np.asarray(estimate_normals(jnp.asarray(points[0]), 12)[0]), np.asarray(batched)[0]).max() < 0.05


def rays() -> np.ndarray:
    """Return the directions through the pixels' centres, scaled to z = 1."""
    column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    return np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(INTRINSICS.astype(np.float64)).T


def plane_depth(normal: np.ndarray, distance: float) -> np.ndarray:
    return (distance / (rays() @ normal)).astype(np.float32)


def sphere_depth(center_z: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a sphere's depth, 0 beside it, and its outward normals."""
    direction = rays()
    center = np.array([0.0, 0, center_z])
    a, b = (direction**2).sum(-1), direction @ center
    root = b**2 - a * (center_z**2 - radius**2)
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0)
    return depth.astype(np.float32), (depth[..., None] * direction - center) / radius


def test_depth_to_points_inverts_the_projection() -> None:
    depth = np.random.default_rng(0).uniform(1, 3, size=(HEIGHT, WIDTH)).astype(np.float32)
    skewed = INTRINSICS + np.array([[0, 2.0, 0], [0, 0, 0], [0, 0, 0]], dtype=np.float32)
    points = np.asarray(to_points(depth, skewed))
    np.testing.assert_array_equal(points[..., 2], depth)
    projected = points @ skewed.T
    column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    np.testing.assert_allclose(projected[..., 0] / projected[..., 2], column, atol=1e-4)
    np.testing.assert_allclose(projected[..., 1] / projected[..., 2], row, atol=1e-4)


def test_pixels_without_a_depth_are_the_zero_point() -> None:
    depth = np.float32([[0, -1, np.nan], [np.inf, -np.inf, 2]])
    points = np.asarray(to_points(depth, INTRINSICS))
    np.testing.assert_array_equal(points.reshape(-1, 3)[:5], 0)
    assert points[1, 2, 2] == 2


@pytest.mark.parametrize("normal", [[0, 0, 1.0], [0.5, 0, 1], [-0.6, 0.8, 1], [0.3, -0.2, 0.5]])
@pytest.mark.parametrize("distance", [0.5, 800.0], ids=["metres", "millimetres"])
def test_depth_normals_of_a_plane_are_exact_and_face_the_camera_up_to_the_border(
    normal: list[float], distance: float
) -> None:
    unit = np.array(normal) / np.linalg.norm(normal)
    found, valid = from_depth(plane_depth(unit, distance), INTRINSICS)
    assert np.asarray(valid).all()
    np.testing.assert_allclose(found, np.broadcast_to(-unit, found.shape), atol=1e-3)


def test_depth_normals_of_a_sphere() -> None:
    depth, expected = sphere_depth(3.0, 0.7)
    found, valid = from_depth(depth, INTRINSICS)
    np.testing.assert_array_equal(np.asarray(valid)[depth == 0], False)
    facing = -(expected * rays()).sum(axis=-1) / np.linalg.norm(rays(), axis=-1)
    seen = (depth > 0) & (facing > 0.5)  # within 60 degrees of the line of sight
    assert np.asarray(valid)[seen].all()
    error = angles(np.asarray(found)[seen], expected[seen], signed=True)
    assert error.mean() < 0.7  # a window is a fifth of the radius wide: its plane is not the tangent plane
    assert error.max() < 3


@pytest.mark.parametrize("max_jump", [None, 5.0], ids=["relative", "length"])
def test_a_step_in_depth_bends_no_normal(max_jump: float | None) -> None:
    depth = np.full((HEIGHT, WIDTH), 500, dtype=np.float32)
    depth[:, WIDTH // 2 :] = 560
    found, valid = from_depth(depth, INTRINSICS, max_jump=max_jump)
    assert np.asarray(valid).all()
    np.testing.assert_allclose(found, np.broadcast_to([0, 0, -1], found.shape), atol=1e-3)
    bent, _ = from_depth(depth, INTRINSICS, max_jump=100.0)
    assert angles(np.asarray(bent)[:, WIDTH // 2], [0, 0, -1]).min() > 20


@pytest.mark.parametrize("hole", [0.0, -1.0, np.nan, np.inf])
def test_holes_in_the_depth_are_left_out(hole: float) -> None:
    unit = np.array([0.3, -0.2, 1]) / np.linalg.norm([0.3, -0.2, 1])
    missing = np.random.default_rng(0).random((HEIGHT, WIDTH)) < 0.2
    found, valid = from_depth(np.where(missing, np.float32(hole), plane_depth(unit, 800.0)), INTRINSICS)
    np.testing.assert_array_equal(valid, ~missing)
    np.testing.assert_allclose(np.asarray(found)[~missing], np.broadcast_to(-unit, ((~missing).sum(), 3)), atol=1e-3)
    np.testing.assert_array_equal(np.asarray(found)[missing], 0)


def test_lone_pixels_and_lines_of_pixels_have_no_normal() -> None:
    depth = np.zeros((HEIGHT, WIDTH), dtype=np.float32)
    depth[10, 10] = depth[20, 30] = depth[20, 31] = 500
    depth[40] = 500
    found, valid = from_depth(depth, INTRINSICS)
    assert not np.asarray(valid).any()
    np.testing.assert_array_equal(found, 0)


@pytest.mark.parametrize("shape", [(1, 7), (2, 2)])
def test_images_smaller_than_the_window(shape: tuple[int, int]) -> None:
    found, valid = from_depth(np.full(shape, 2, dtype=np.float32), INTRINSICS, window_radius=3)
    np.testing.assert_array_equal(valid, np.full(shape, min(shape) > 1))
    np.testing.assert_allclose(found, np.where(np.asarray(valid)[..., None], [0, 0, -1], 0), atol=1e-3)


def test_depth_mistakes_are_refused() -> None:
    depth = jnp.ones((HEIGHT, WIDTH))
    with pytest.raises(ValueError, match="window_radius = 0"):
        depth_normals(depth, jnp.asarray(INTRINSICS), window_radius=0)
    with pytest.raises(InputError, match="max_jump"):
        depth_normals(depth, jnp.asarray(INTRINSICS), max_jump=0.0)


def test_depth_normals_vmap_equals_a_loop_and_jit_equals_eager() -> None:
    depth = np.random.default_rng(0).uniform(1, 1.2, size=(2, HEIGHT, WIDTH)).astype(np.float32)
    batched, batched_valid = jax.jit(jax.vmap(lambda image: depth_normals(image, jnp.asarray(INTRINSICS))))(depth)
    eager = depth_normals(jnp.asarray(depth[0]), jnp.asarray(INTRINSICS))
    for i, (found, valid) in ((0, from_depth(depth[0], INTRINSICS)), (1, from_depth(depth[1], INTRINSICS)), (0, eager)):
        np.testing.assert_array_equal(valid, batched_valid[i])
        assert angles(np.asarray(found), np.asarray(batched[i]))[np.asarray(valid)].max() < 0.05
