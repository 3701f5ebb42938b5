import itertools

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from kmn_jax.errors import InputError
from kmn_jax.simulate import HullConfig, collision_shape

FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ],
    dtype=np.int32,
)


def boxes(*corners):
    """Return the surface of boxes, each given by its lowest and highest corner; they may overlap."""
    vertices = [np.array(list(itertools.product(*zip(low, high, strict=True))), dtype=float) for low, high in corners]
    return np.concatenate(vertices), np.concatenate([FACES + 8 * i for i in range(len(corners))])


def prism(sides, radius, bottom, top):
    """Return the surface of an upright prism."""
    angles = 2 * np.pi * np.arange(sides) / sides
    ring = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    vertices = np.concatenate([np.insert(ring, 2, z, axis=1) for z in (bottom, top)] + [[[0, 0, bottom], [0, 0, top]]])
    i, j = np.arange(sides), (np.arange(sides) + 1) % sides
    walls = [np.stack([i, j, j + sides], axis=1), np.stack([i, j + sides, i + sides], axis=1)]
    lids = [np.stack([j, i, 0 * i + 2 * sides], axis=1), np.stack([i, j, 0 * i + 1], axis=1) + sides]
    return vertices, np.concatenate([*walls, *lids]).astype(np.int32)


def joined(*surfaces):
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in surfaces])
    triangles = [triangles + start for (_, triangles), start in zip(surfaces, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in surfaces]), np.concatenate(triangles).astype(np.int32)


L_SHAPE = boxes(([0, 0, 0], [4, 1, 1]), ([0, 0, 0], [1, 1, 3]))
BOLT = joined(prism(40, 2.0, 0.0, 2.0), prism(40, 1.0, 1.9, 6.0))


def depth_below_surface(points, parts):
    """Return for each point how deep it lies in the union of convex parts (negative: outside)."""
    equations = [ConvexHull(part).equations for part in parts]
    return np.max([-(points @ eq[:, :3].T + eq[:, 3]).max(axis=1) for eq in equations], axis=0)


def surface_samples(vertices, triangles, count=3000):
    rng = np.random.default_rng(0)
    corners = vertices[triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weights = rng.dirichlet(np.ones(3), size=count)
    return np.einsum("nk,nki->ni", weights, corners[rng.choice(len(areas), size=count, p=areas / areas.sum())])


def thickness(part):
    return np.ptp(part @ ConvexHull(part).equations[:, :3].T, axis=0).min()


def test_box_is_one_part_of_eight_corners():
    vertices, triangles = boxes(([1, 2, 3], [4, 4, 4]))
    (part,) = collision_shape(vertices, triangles).parts
    assert part.shape == (8, 3)
    np.testing.assert_allclose(sorted(map(tuple, part)), sorted(map(tuple, vertices)), atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_mass_properties_of_a_turned_box(seed):
    rng = np.random.default_rng(seed)
    size, center = rng.uniform(1, 3, size=3), rng.uniform(-50, 50, size=3)
    R_object_box = Rotation.random(rng=rng).as_matrix()
    vertices, triangles = boxes((-size / 2, size / 2))
    shape = collision_shape(vertices @ R_object_box.T + center, triangles, HullConfig(parts=1))
    np.testing.assert_allclose(shape.volume, size.prod(), rtol=1e-9)
    np.testing.assert_allclose(shape.center, center, atol=1e-9)
    inertia = R_object_box @ np.diag((np.sum(size**2) - size**2) / 12) @ R_object_box.T
    R = shape.R_object_principal
    np.testing.assert_allclose(R @ np.diag(shape.inertia) @ R.T, inertia, atol=1e-9)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0


def test_mass_properties_add_up_over_parts():
    """An L of 4 + 2 unit cubes: the centre is the mean of theirs, the inertia follows from Steiner's theorem."""
    shape = collision_shape(*L_SHAPE)
    cubes = np.array([[x + 0.5, 0.5, 0.5] for x in range(4)] + [[0.5, 0.5, 1.5], [0.5, 0.5, 2.5]])
    offsets = cubes - cubes.mean(axis=0)
    inertia = np.mean([(o @ o + 1 / 6) * np.eye(3) - np.outer(o, o) for o in offsets], axis=0)
    np.testing.assert_allclose(shape.volume, 6, rtol=0.01)
    np.testing.assert_allclose(shape.center, cubes.mean(axis=0), atol=0.02)
    R = shape.R_object_principal
    np.testing.assert_allclose(R @ np.diag(shape.inertia) @ R.T, inertia, atol=0.03)
    np.testing.assert_allclose(shape.diagonal, np.sqrt(16 + 1 + 9))


@pytest.mark.parametrize(("surface", "volume"), [(L_SHAPE, 6.0), (BOLT, 20 * np.sin(np.pi / 20) * (8 + 4))])
def test_concave_shapes_are_cut_where_they_bend(surface, volume):
    parts = collision_shape(*surface).parts
    assert len(parts) == 2
    assert sum(ConvexHull(part).volume for part in parts) == pytest.approx(volume, rel=0.01)


@pytest.mark.parametrize(
    "surface",
    [
        L_SHAPE,
        BOLT,
        boxes(*[([3 * i, 0, 0], [3 * i + 1, 2, 2]) for i in range(5)]),  # several bodies
        boxes(([0, 0, 0], [6, 4, 1]), ([1, 1, 1], [2, 2, 4]), ([4, 2, 1], [5, 3, 3])),
        (BOLT[0], BOLT[1][::2]),  # half of the triangles are missing
        (BOLT[0], np.where(np.arange(len(BOLT[1]))[:, None] % 2 == 0, BOLT[1], BOLT[1][:, ::-1])),  # wound at random
    ],
)
def test_parts_cover_the_surface_and_stay_in_its_hull(surface):
    parts = collision_shape(*surface).parts
    vertices, triangles = surface
    diagonal = np.linalg.norm(np.ptp(vertices, axis=0))
    assert 1 <= len(parts) <= HullConfig().parts
    assert depth_below_surface(surface_samples(vertices, triangles), parts).min() > -1e-9 * diagonal
    assert depth_below_surface(np.concatenate(parts), [vertices[np.unique(triangles)]]).min() > -1e-9 * diagonal
    assert min(thickness(part) for part in parts) > 0.1 * diagonal


def test_thin_pins_stay_in_a_thick_part():
    block = ([0, 0, 0], [6, 3, 3])
    pins = [([x, 1.4, -3], [x + 0.2, 1.6, 0]) for x in (0.5, 3.0, 5.3)]
    parts = collision_shape(*boxes(block, *pins)).parts
    diagonal = np.linalg.norm([6, 3, 6])
    assert min(thickness(part) for part in parts) > 0.1 * diagonal
    assert min(part[:, 2].min() for part in parts) == pytest.approx(-3)


@pytest.mark.parametrize("size", [(10, 0.3, 0.3), (10, 8, 0.2)])
def test_thin_objects_are_one_hull(size):
    bracket = boxes(([0, 0, 0], size), ([0, 0, 0], [1, size[1], 0.5]))
    assert len(collision_shape(*bracket).parts) == 1


def test_number_of_parts_is_bounded():
    stairs = boxes(*[([i, 0, 0], [i + 1, 6, i + 1]) for i in range(10)])
    assert len(collision_shape(*stairs, HullConfig(parts=1)).parts) == 1
    three = collision_shape(*stairs, HullConfig(parts=3, gain=0.001, thickness=0.01)).parts
    eight = collision_shape(*stairs, HullConfig(parts=8, gain=0.001, thickness=0.01)).parts
    assert (len(three), len(eight)) == (3, 8)
    assert sum(ConvexHull(part).volume for part in eight) < sum(ConvexHull(part).volume for part in three)


def test_same_surface_same_bits_and_unit_does_not_matter():
    vertices, triangles = BOLT
    parts = collision_shape(vertices, triangles).parts
    for part, again in zip(parts, collision_shape(vertices.copy(), triangles).parts, strict=True):
        np.testing.assert_array_equal(part, again)
    scaled = collision_shape(1e-3 * vertices + 5, triangles).parts
    assert len(scaled) == len(parts)
    for part, other in zip(parts, scaled, strict=True):
        assert ConvexHull(other).volume == pytest.approx(1e-9 * ConvexHull(part).volume, rel=1e-6)


def test_vertices_that_no_triangle_uses_do_not_count():
    vertices, triangles = boxes(([0, 0, 0], [1, 2, 3]))
    (part,) = collision_shape(np.concatenate([vertices, [[100, 100, np.nan]]]), triangles).parts
    assert part.max() == 3


BOX = boxes(([0, 0, 0], [1, 1, 1]))


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        (BOX[0] * [1, 1, 0], BOX[1], "flat"),
        (BOX[0] * [1, 1, 1e-5], BOX[1], "flat"),
        (BOX[0] @ Rotation.from_rotvec([1, 2, 3]).as_matrix() * [1, 0, 1], BOX[1], "flat"),
        (BOX[0] * 0, BOX[1], "flat"),
        (BOX[0], BOX[1][:1], "flat"),
        (BOX[0], BOX[1][:0], "no triangles"),
        (BOX[0][:0], BOX[1][:0], "no triangles"),
        (np.where(BOX[0] == 1, np.nan, BOX[0]), BOX[1], "NaN"),
        (BOX[0], BOX[1] + 5, "name vertices from 5 to 12 of 8"),
        (BOX[0], BOX[1] - 1, "name vertices from -1 to 6 of 8"),
    ],
)
def test_surfaces_without_volume_are_refused(vertices, triangles, message, capfd):
    with pytest.raises(InputError, match=message):
        collision_shape(vertices, triangles)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "wrong", [{"parts": 0}, {"thickness": 0.0}, {"thickness": 1.0}, {"gain": 0.0}, {"faces": -1}, {"spaced": -1}]
)
def test_wrong_configs_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        HullConfig(**wrong)
