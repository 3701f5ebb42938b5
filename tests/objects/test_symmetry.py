import itertools

import numpy as np
import open3d
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from kmn_jax.errors import InputError
from kmn_jax.objects._symmetry import find_symmetries, rotation_about
from tests.reference.meshes import sphere, surface_points
from tests.reference.solids import block, joined, prism, revolution, ring, torus, tube

GOLDEN = (1 + 5**0.5) / 2


def hull(points):
    return np.array(points, dtype=float), ConvexHull(np.array(points)).simplices


def gear(teeth, depth):
    return prism(ring(np.where(np.arange(8 * teeth) % 8 < 4, 1, 1 - depth)), 0.5)


def thread(depth):
    """Return a screw: a shank with a helical thread of a depth, and a head."""
    height = np.linspace(-2, 1, 80)
    phase = 2 * height[:, None] - 2 * np.arange(32) / 32
    shank = 0.5 + depth * (np.abs(phase % 2 - 1) - 0.5)
    head = np.repeat([[1.0], [1.0], [0.0]], 32, axis=1)
    return tube(np.concatenate([0 * head[:1], shank, head]), np.array([-2, *height, 1, 1.6, 1.6]))


SIGNS = list(itertools.product((-1, 1), repeat=2))
CYLINDER = revolution([(0, -2), (1, -2), (1, 2), (0, 2)])
FINITE = {
    "box": (block((-3, -2, -1), (3, 2, 1)), 4),
    "square prism": (prism(ring(np.ones(4)), 3.0), 8),
    "flat square prism": (prism(ring(np.ones(4)), 0.4), 8),
    "cube": (block((0, 0, 0), (1, 1, 1)), 24),
    "tetrahedron": (hull([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]), 12),
    "octahedron": (hull(np.concatenate([np.eye(3), -np.eye(3)])), 24),
    "icosahedron": (hull([np.roll((0, a, b * GOLDEN), k) for a, b in SIGNS for k in range(3)]), 60),
    "triangular prism": (prism(ring(np.ones(3)), 1.0), 6),
    "hexagonal prism": (prism(ring(np.ones(6)), 1.0), 12),
    "heptagonal prism": (prism(ring(np.ones(7)), 1.0), 14),
    "square pyramid": (
        (
            np.array([*[(a, b, 0) for a, b in SIGNS], (0, 0, 2.5)]),
            hull([*[(a, b, 0) for a, b in SIGNS], (0, 0, 2.5)])[1],
        ),
        4,
    ),
    "gear of 12 teeth": (gear(12, 0.25), 24),
    "gear of 26 teeth": (gear(26, 0.5), 52),  # each multiple of 13 among the orders up to 36 is one of its own
    "cross of three bars": (
        joined(*[block(-np.roll((2, 0.5, 0.5), k), np.roll((2, 0.5, 0.5), k)) for k in range(3)]),
        24,
    ),
    # Its half turns lie in the plane of equal moments, at 45 degrees to its bars.
    "bars crossed one over the other": (
        joined(block((-3, -0.5, 0), (3, 0.5, 1)), block((-0.5, -3, -1), (0.5, 3, 0))),
        4,
    ),
    "bracket": (joined(block((0, 0, 0), (4, 1.5, 1)), block((0, 0, 0), (1, 1, 3))), 1),
    "lopsided box": (joined(block((-3, -2, -1), (3, 2, 1)), block((1, 1, 1), (2.5, 1.8, 2))), 1),
    "screw with a coarse thread": (thread(0.4), 1),
}
CONTINUOUS = {
    "cylinder": (CYLINDER, 2),
    "disc": (revolution([(0, -0.1), (1, -0.1), (1, 0.1), (0, 0.1)]), 2),
    "cylinder of equal moments": (revolution([(0, -0.834), (1, -0.834), (1, 0.834), (0, 0.834)]), 2),
    "ring": (torus(1.0, 0.3, 64, 24), 2),
    "cone": (revolution([(0, -1), (1, -1), (0, 1.5)]), 1),
    "stepped shaft": (revolution([(0, -3), (0.5, -3), (0.5, 0), (1, 0), (1, 2), (0, 2)]), 1),
    "screw with a fine thread": (thread(0.06), 1),
}


class Posed:
    """A solid in a random pose, and what the search takes of it."""

    def __init__(self, solid, seed=0, scale=1.0, samples=200):
        self.R = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
        self.solid = (solid[0] @ self.R.T + np.array([30, -50, 20])) * scale, solid[1]
        corners = self.solid[0][solid[1]]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(cross, axis=1)
        self.center = np.average(corners.mean(axis=1), axis=0, weights=area)
        middles = (corners + np.roll(corners, 1, axis=1)) / 2 - self.center  # a rule that is exact for squares
        self.moments = np.einsum("t,tmi,tmj->ij", area, middles, middles) / (3 * area.sum())
        self.diameter = float(pdist(self.solid[0]).max())
        self.points = np.concatenate([surface_points(self.solid, samples)[0], self.solid[0]])
        self.scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self.scene.add_triangles(self.local(self.solid[0]), solid[1].astype(np.uint32))

    def local(self, points):
        return ((points - self.center) / self.diameter).astype(np.float32)

    def distance(self, points):
        return self.scene.compute_distance(self.local(points)).numpy() * self.diameter

    def symmetries(self, tolerance=0.02):
        return find_symmetries(self.points, self.center, self.moments, self.distance, self.diameter, tolerance)

    def misfit(self, transforms):
        """Return how far the transforms take fresh points off the surface, at most, in diameters."""
        points = surface_points(self.solid, 1000, seed=1)[0]
        moved = np.einsum("sij,nj->sni", transforms[:, :3, :3], points) + transforms[:, None, :3, 3]
        return self.distance(moved.reshape(-1, 3)).max() / self.diameter


def angle_between(axis, other):
    return np.degrees(np.arccos(min(1.0, abs(axis @ other))))


@pytest.mark.parametrize("name", FINITE)
def test_finite_groups(name):
    solid, count = FINITE[name]
    posed = Posed(solid, seed=len(name))
    found = posed.symmetries()
    rotations = found.rotations
    assert found.axes.shape == (0, 3)
    assert len(rotations) == count
    np.testing.assert_array_equal(rotations[0], np.eye(3))
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (count, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
    # A group: every product is exactly one of its members, and no two of these are the same.
    products = np.einsum("aij,bjk->abik", rotations, rotations).reshape(-1, 9)
    apart = np.linalg.norm(products[:, None] - rotations.reshape(-1, 9), axis=2)
    assert apart.min(axis=1).max() < 1e-6
    assert ((apart < 0.1).sum(axis=1) == 1).all()
    # These solids are exact, and so should the rotations be: half a degree moves an end by 0.4% of the diameter.
    assert posed.misfit(found.transforms) < 0.002
    np.testing.assert_allclose(
        found.transforms[:, :3, :3] @ found.center + found.transforms[:, :3, 3], np.tile(found.center, (count, 1))
    )
    np.testing.assert_array_equal(found.center, posed.center)


@pytest.mark.parametrize("name", CONTINUOUS)
def test_continuous_axes(name):
    solid, count = CONTINUOUS[name]
    posed = Posed(solid, seed=len(name))
    found = posed.symmetries()
    assert found.axes.shape == (1, 3)
    assert len(found.rotations) == count
    assert angle_between(found.axes[0], posed.R[:, 2]) < 0.5
    np.testing.assert_array_equal(found.rotations[0], np.eye(3))
    if count == 2:  # turned over
        np.testing.assert_allclose(found.rotations[1] @ found.axes[0], -found.axes[0], atol=1e-9)
    for angle in (0.3, 1.0, 2.5):
        about = np.eye(4)
        about[:3, :3] = rotation_about(found.axes[0], angle)
        about[:3, 3] = found.center - about[:3, :3] @ found.center
        assert posed.misfit(about @ found.transforms) < 0.02


def test_sphere():
    posed = Posed(sphere(1.0, subdivisions=3))
    found = posed.symmetries()
    np.testing.assert_allclose(found.axes @ found.axes.T, np.eye(3), atol=1e-9)
    np.testing.assert_array_equal(found.rotations, np.eye(3)[None])


@pytest.mark.parametrize(("factor", "count"), [(0.97, 8), (1.03, 4)])
@pytest.mark.parametrize("tolerance", [0.01, 0.05])
def test_tolerance_is_the_largest_distance_in_diameters(factor, count, tolerance):
    """A quarter turn takes the longer sides of a box this far off its surface."""
    excess = 0.0
    for _ in range(50):  # the diameter depends on it
        excess = factor * tolerance * np.linalg.norm([10, 10 + 2 * excess, 4])
    posed = Posed(block((-5, -5 - excess, -2), (5, 5 + excess, 2)))
    found = posed.symmetries(tolerance)
    assert len(found.rotations) == count
    assert found.tolerance == tolerance
    if count == 8:
        assert posed.misfit(found.transforms) <= tolerance


@pytest.mark.parametrize(("tolerance", "continuous"), [(0.005, False), (0.02, True)])
def test_tolerance_decides_between_corners_and_a_circle(tolerance, continuous):
    """Half a step takes a 12-gon's corners (1 - cos 15 degrees) / 2.8 = 1.2% of the diameter off its sides."""
    found = Posed(prism(ring(np.ones(12)), 2.0)).symmetries(tolerance)
    assert len(found.axes) == continuous
    assert len(found.rotations) == (2 if continuous else 24)


def test_nearly_continuous_axes_have_no_made_up_orders():
    """Only sixfold: that seventh or thirty-first parts of a turn stay within the tolerance is chance."""
    posed = Posed(prism(ring(np.ones(6)), 6.0))
    corner = (1 - np.cos(np.pi / 6)) / posed.diameter
    for share in (0.8, 0.99):
        assert len(posed.symmetries(share * corner).rotations) == 12


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_size_changes_nothing(scale):
    here, there = (Posed(FINITE["hexagonal prism"][0], scale=s).symmetries() for s in (1.0, scale))
    apart = np.linalg.norm(there.rotations.reshape(-1, 1, 9) - here.rotations.reshape(-1, 9), axis=2)
    assert max(apart.min(axis=0).max(), apart.min(axis=1).max()) < 0.01
    np.testing.assert_allclose(there.center, here.center * scale)


@pytest.mark.parametrize("tolerance", [0.0, -0.1, 0.21, np.nan])
def test_tolerances_outside_of_the_range(tolerance):
    with pytest.raises(InputError, match=r"above 0 and at most 0\.2"):
        Posed(CYLINDER).symmetries(tolerance)


def counted(distance):
    """Return a distance, and the list of how many points it was asked for."""
    asked = []

    def count(points):
        asked.append(len(points))
        return distance(points)

    return count, asked


def cube_distance(points):
    outside = np.abs(points) - 0.5
    return np.abs(np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0))


def test_most_rotations_are_refused_by_few_points():
    points = surface_points(block((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)), 800)[0]
    distance, asked = counted(cube_distance)
    found = find_symmetries(points, np.zeros(3), np.eye(3), distance, 3**0.5)
    assert len(found.rotations) == 24
    print(f"{sum(asked)} distances")
    assert sum(asked) < 1_000_000


def test_a_search_without_an_end_is_ended_and_told(monkeypatch, caplog):
    monkeypatch.setattr("kmn_jax.objects._symmetry._MOST_DISTANCES", 100_000)

    def rough(points):
        return 0.04 + 0.024 * np.sin(30 * points).prod(axis=1)

    points = np.random.default_rng(0).normal(size=(800, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    distance, asked = counted(rough)
    found = find_symmetries(points, np.zeros(3), np.eye(3), distance, 2.0)
    assert len(found.rotations) == 1
    assert sum(asked) < 600_000
    assert "may have missed some" in caplog.text
