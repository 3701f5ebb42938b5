import time

import numpy as np
import open3d
import pytest
from scipy.spatial import cKDTree

from kmn_jax.errors import InputError
from kmn_jax.objects._surface import outer_surface
from tests.reference.meshes import surface_points
from tests.reference.solids import area, block, joined, prism, revolution, ring, torus, volume

POINTS = 300
CUBE = block((-1, -1, -1), (1, 1, 1))
BOX = block((-10, -5, -2), (10, 5, 3))
RING = torus(10, 3, 60, 40)
OVERLAPPING = joined(block((0, 0, 0), (2, 1, 1)), block((1, 0.3, 0.3), (3, 0.7, 2)))
TUBE = revolution([(0.6, -1), (1, -1), (1, 1), (0.6, 1), (0.6, -1)])
TENT = (
    np.array([[0, 0, 0], [1, 0, 0.2], [1, 1, 0.2], [0, 1, 0], [2, 0, 0], [2, 1, 0]], dtype=float),
    np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]]),
)


def flipped(mesh, which):
    return mesh[0], np.where(np.broadcast_to(which, len(mesh[1]))[:, None], mesh[1][:, ::-1], mesh[1])


def depth_in_box(points, low, high):
    return np.minimum(points - low, high - points).min(axis=1)


def inside(solid, points):
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(solid[0].astype(np.float32), solid[1].astype(np.uint32))
    return scene.compute_occupancy(points.astype(np.float32), nsamples=5).numpy() > 0


def torus_distance(points):
    return np.hypot(np.hypot(points[:, 0], points[:, 1]) - 10, points[:, 2]) - 3


def test_faces_inside_are_left_out():
    outer = outer_surface(*joined(CUBE, block((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))), POINTS)
    assert outer.points.shape == outer.normals.shape == (POINTS, 3)
    np.testing.assert_allclose(np.abs(outer.points).max(axis=1), 1, atol=1e-6)
    assert len(outer.triangles) == 12
    assert len(outer.vertices) == 8
    assert volume((outer.vertices, outer.triangles)) == pytest.approx(8)
    assert outer.hidden_share == pytest.approx(6 / 30, abs=0.03)  # estimated by 1,500 samples
    assert outer.area == pytest.approx(24, rel=0.04)


def test_overlapping_parts_are_not_sampled_inside():
    outer = outer_surface(*OVERLAPPING, POINTS)
    assert depth_in_box(outer.points, [0, 0, 0], [2, 1, 1]).max() < 1e-5
    assert depth_in_box(outer.points, [1, 0.3, 0.3], [3, 0.7, 2]).max() < 1e-5
    first, second = area(block((0, 0, 0), (2, 1, 1))), area(block((1, 0.3, 0.3), (3, 0.7, 2)))
    hidden = (2 * 1 * 0.7 + 1 * 0.4 + 0.4 * 0.7) + (1 * 0.4 + 0.4 * 0.7)  # of the second box, of the first
    assert outer.hidden_share == pytest.approx(hidden / (first + second), abs=0.03)
    assert outer.area == pytest.approx(first + second - hidden, rel=0.04)


@pytest.mark.parametrize("solid", [BOX, RING, prism(ring(np.array([3, 1] * 5)), 1.0), TUBE])
@pytest.mark.parametrize("winding", ["outwards", "inwards", "mixed"])
def test_normals_point_outwards_whatever_the_winding(solid, winding):
    mixed = np.random.default_rng(0).random(len(solid[1])) < 0.5
    outer = outer_surface(*flipped(solid, {"outwards": False, "inwards": True, "mixed": mixed}[winding]), POINTS)
    assert volume((outer.vertices, outer.triangles)) == pytest.approx(volume(solid), rel=1e-6)
    np.testing.assert_allclose(np.linalg.norm(outer.normals, axis=1), 1, atol=1e-6)
    step = 1e-4 * np.ptp(solid[0]) * outer.normals
    assert not inside(solid, outer.points + step).any()
    assert inside(solid, outer.points - step).all()
    assert outer.hidden_share == 0
    assert outer.area == pytest.approx(area(solid), rel=1e-6)


def test_a_bore_is_seen_and_its_normals_point_to_its_axis():
    outer = outer_surface(*TUBE, POINTS)
    bore = np.hypot(outer.points[:, 0], outer.points[:, 1]) < 0.61
    inward = -outer.points[bore, :2] / np.linalg.norm(outer.points[bore, :2], axis=1, keepdims=True)
    assert bore.sum() > 50
    assert ((outer.normals[bore, :2] * inward).sum(axis=1) > 0.99).sum() > 0.8 * bore.sum()  # the rest lies at its rims
    assert (outer.normals[bore, :2] * inward).sum(axis=1).min() > -1e-6


@pytest.mark.parametrize("upwards", [True, False])
def test_open_sheets_keep_their_winding(upwards):
    outer = outer_surface(*flipped(TENT, not upwards), POINTS)
    assert (np.sign(outer.normals[:, 2]) == (1 if upwards else -1)).all()
    corners = outer.vertices[outer.triangles]
    assert (
        np.sign(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]) == 2 * upwards - 1
    ).all()
    assert outer.area == pytest.approx(area(TENT))
    assert outer.hidden_share == 0


def test_points_keep_their_distance():
    outer = outer_surface(*BOX, POINTS)
    hexagonal = np.sqrt(2 * area(BOX) / POINTS / np.sqrt(3))  # what the densest packing in the plane would have
    spacing = cKDTree(outer.points).query(outer.points, k=2)[0][:, 1] / hexagonal
    uniform_points = surface_points(BOX, POINTS)[0]
    uniform = cKDTree(uniform_points).query(uniform_points, k=2)[0][:, 1] / hexagonal
    assert spacing.min() > 0.6
    assert uniform.min() < 0.1
    shares = [np.mean(np.abs(outer.normals[:, axis]) > 0.9) for axis in range(3)]
    np.testing.assert_allclose(shares, np.array([100, 200, 400]) / 700, atol=0.02)


def test_the_same_seed_gives_the_same_bits():
    first, second = (
        outer_surface(*OVERLAPPING, POINTS, random_seed=3),
        outer_surface(*OVERLAPPING, POINTS, random_seed=3),
    )
    for name in ("vertices", "triangles", "points", "normals"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()
    assert (first.area, first.hidden_share) == (second.area, second.hidden_share)
    assert not np.array_equal(first.points, outer_surface(*OVERLAPPING, POINTS, random_seed=4).points)


@pytest.mark.parametrize(("scale", "offset"), [(1e-3, 0), (1e3, 0), (1.0, 2e4), (1e-3, 20.0), (1e-9, 0), (1e9, 0)])
def test_size_and_place_change_nothing(scale, offset):
    here = outer_surface(*OVERLAPPING, POINTS)
    away = np.array([1, -0.5, 0.8]) * offset
    there = outer_surface(OVERLAPPING[0] * scale + away, OVERLAPPING[1], POINTS)
    np.testing.assert_array_equal(there.triangles, here.triangles)
    np.testing.assert_allclose((there.vertices - away) / scale, here.vertices, atol=1e-9)
    # Points are float32: 10,000 sizes away from the origin a thousandth of the size is left.
    np.testing.assert_allclose((there.points - away) / scale, here.points, atol=1e-3 if offset else 1e-6)
    np.testing.assert_allclose(there.normals, here.normals, atol=1e-6)
    assert there.area / scale**2 == pytest.approx(here.area, rel=1e-6)
    assert there.hidden_share == here.hidden_share


def test_degenerate_triangles_do_not_count():
    vertices, triangles = CUBE
    slivers = np.array([[0, 0, 1], [2, 2, 2], [8, 9, 10]])
    outer = outer_surface(
        np.concatenate([vertices, [[5, 0, 0], [6, 0, 0], [7, 0, 0]]]), np.concatenate([triangles, slivers]), 64
    )
    np.testing.assert_allclose(np.abs(outer.points).max(axis=1), 1, atol=1e-6)
    assert len(outer.triangles) == 12


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        (np.eye(3), [[0, 1, 2]], r"1 triangles with an area \(of 1\)"),
        (np.ones((6, 3)), [[0, 1, 2], [3, 4, 5], [0, 2, 4]], r"0 triangles with an area \(of 3\)"),
        (np.arange(18.0).reshape(6, 3), [[0, 1, 2], [3, 4, 5]], r"0 triangles with an area \(of 2\)"),
        (np.eye(3), [[0, 0, 2], [1, 1, 1]], r"0 triangles with an area \(of 2\)"),
    ],
    ids=["one", "coincident", "on a line", "repeated corners"],
)
@pytest.mark.parametrize("copies", [1, 100_001])
def test_no_surface(vertices, triangles, message, copies):
    pattern = message if copies == 1 else "with an area"
    with pytest.raises(InputError, match=pattern):
        outer_surface(vertices, np.array(triangles * copies)[: copies * len(triangles)], 64)


def test_nearly_all_hidden():
    layers = [block((-s, -s, -s), (s, s, s)) for s in np.linspace(0.9, 0.95, 60)]
    with pytest.raises(InputError, match="of the mesh can be seen from outside"):
        outer_surface(*joined(CUBE, *layers), POINTS)


def test_large_meshes_without_shared_vertices_stay_whole():
    vertices, triangles = torus(10, 3, 350, 150)
    soup = vertices[triangles].reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)
    assert 100_000 < len(triangles) < 200_000
    outer = outer_surface(*soup, POINTS)
    assert len(outer.triangles) <= 100_000
    assert np.abs(torus_distance(outer.points)).max() < 1e-4 * 26
    assert volume((outer.vertices, outer.triangles)) == pytest.approx(volume((vertices, triangles)), rel=1e-3)


def test_millions_of_triangles_take_bounded_time(record_property):
    rough = torus(10, 3, 1100, 950)
    hidden = np.random.default_rng(0).permutation(len(rough[0]))  # vertices in no order
    mesh = rough[0][np.argsort(hidden)], hidden[rough[1]]
    assert len(mesh[1]) > 2_000_000
    start = time.process_time()
    outer = outer_surface(*mesh, POINTS)
    seconds = time.process_time() - start
    record_property("seconds", round(seconds, 1))
    assert seconds < 30
    assert len(outer.triangles) <= 100_000
    diagonal = np.linalg.norm([26, 26, 6])
    assert np.abs(torus_distance(outer.points)).max() < 0.001 * diagonal
    assert np.abs(torus_distance(outer.vertices)).max() < 0.001 * diagonal
    center = outer.points * [1, 1, 0]
    center *= 10 / np.linalg.norm(center, axis=1, keepdims=True)
    assert ((outer.points - center) * outer.normals).sum(axis=1).min() > 2.9
    assert outer.area == pytest.approx(area(rough), rel=0.005)
    assert outer.hidden_share < 0.001
    assert volume((outer.vertices, outer.triangles)) == pytest.approx(volume(rough), rel=0.005)


def test_simplified_edges_stay_where_they_are():
    """Squares all over a box: its edges and corners are what simplification rounds most."""
    low, high = np.array([-10, -5, -2]), np.array([10, 5, 3])
    cells = np.stack(np.meshgrid(np.arange(150), np.arange(150), indexing="ij"), axis=-1).reshape(-1, 1, 2)
    corners = (cells + np.array([[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]])) / 150
    faces = []
    for axis in range(3):
        for side in (0.0, 1.0):
            square = np.insert(corners, axis, side, axis=2).reshape(-1, 3)
            faces.append(square)
    vertices = np.concatenate(faces) * (high - low) + low
    triangles = np.arange(len(vertices)).reshape(-1, 3)
    assert len(triangles) > 200_000
    outer = outer_surface(vertices + 1000.0, triangles, POINTS)
    assert len(outer.triangles) <= 100_000
    depth = depth_in_box(outer.vertices - 1000.0, low, high)
    diagonal = np.linalg.norm(high - low)
    assert np.abs(depth).max() < 0.0025 * diagonal
    assert np.quantile(np.abs(depth), 0.9) < 1e-6 * diagonal
    np.testing.assert_allclose(outer.vertices.min(axis=0), low + 1000.0, atol=0.0025 * diagonal)
    np.testing.assert_allclose(outer.vertices.max(axis=0), high + 1000.0, atol=0.0025 * diagonal)
    assert outer.area == pytest.approx(700, rel=0.01)
    assert volume((outer.vertices - 1000.0, outer.triangles)) == pytest.approx(1000, rel=0.01)
