import jax
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.pose import (
    add,
    adi,
    bounding_box_diagonal,
    diameter,
    discretise_symmetry,
    mssd,
    recall,
)
from tests.reference.meshes import pose as pose_of
from tests.reference.meshes import random_rotations


def make_case(seed, count=100):
    generator = np.random.default_rng(seed)
    poses = [pose_of(2 * generator.normal(size=3), rotation) for rotation in random_rotations(2, seed)]
    return *np.float32(poses), generator.normal(size=(count, 3)).astype(np.float32)


def translated(x):
    return pose_of((x, 0, 0)).astype(np.float32)


def posed(pose, points):
    pose, points = np.asarray(pose, np.float64), np.asarray(points, np.float64)
    return points @ pose[:3, :3].T + pose[:3, 3]


@pytest.mark.parametrize("seed", range(3))
def test_against_numpy(seed):
    estimated, true, points = make_case(seed)
    a, b = posed(estimated, points), posed(true, points)
    distances = np.linalg.norm(a - b, axis=1)
    nearest = np.linalg.norm(b[:, None] - a[None], axis=-1).min(axis=1)
    np.testing.assert_allclose(add(estimated, true, points), distances.mean(), rtol=1e-5)
    np.testing.assert_allclose(adi(estimated, true, points), nearest.mean(), rtol=1e-5)
    np.testing.assert_allclose(mssd(estimated, true, points), distances.max(), rtol=1e-5)
    spread = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.testing.assert_allclose(diameter(points), spread.max(), rtol=1e-6)
    np.testing.assert_allclose(bounding_box_diagonal(points), np.linalg.norm(np.ptp(points, axis=0)), rtol=1e-6)


@pytest.mark.parametrize("metric", [add, adi, mssd])
def test_equal_poses_have_no_error(metric):
    _, true, points = make_case(0)
    assert metric(true, true, points) == 0


def test_adi_measures_from_the_true_points():
    points = np.float32([[0, 0, 0], [1, 0, 0]])
    # Points to 1 and 2: the true 0 is 1 away from one, the true 1 meets one.
    assert adi(translated(1), translated(0), points) == pytest.approx(0.5)


def test_far_from_the_origin_digits_are_kept():
    _, _, points = make_case(1)
    for metric in (add, mssd):
        assert metric(translated(1000.125), translated(1000), points) == pytest.approx(0.125, rel=1e-3)


def test_on_a_map_errors_are_those_near_the_origin():
    estimated, true, points = (np.float64(value) for value in make_case(1))
    turns = np.float64(discretise_symmetry([0, 0, 1], [1, 2, 0], 4))
    there = pose_of((5e6, -4e7, 3e5), random_rotations(1, 3)[0])  # of sizes of some units, as from metres to a map
    offset = np.array([-7e6, 2e6, 1e7])
    own = pose_of(-offset)  # the object's frame is as far away
    moved = [there @ pose @ own for pose in (estimated, true)]
    around = np.array([pose_of(offset) @ turn @ own for turn in turns])
    for metric, symmetries, far in ((add, (), ()), (adi, (), ()), (mssd, (turns,), (around,))):
        expected = metric(estimated, true, points, *symmetries)
        np.testing.assert_allclose(metric(*moved, points + offset, *far), expected, rtol=1e-4)
        with pytest.raises(InputError, match=r"T_estimated places an object of size .* give it in float64"):
            metric(np.float32(pose_of((1e8, 0, 0))), true, points, *symmetries)
        with pytest.raises(InputError, match=r"points lies 1e.07 from the origin, but is only"):
            metric(estimated, true, np.float32(points + offset), *symmetries)
    for size in (diameter, bounding_box_diagonal):
        np.testing.assert_allclose(size(points + offset), size(points), rtol=1e-5)
        with pytest.raises(InputError, match=r"points lies 1e.07 from the origin"):
            size(np.float32(points + offset))


def test_symmetric_objects():
    generator = np.random.default_rng(0)
    quarter = generator.normal(size=(25, 3)).astype(np.float32)
    eighths = np.asarray(discretise_symmetry(np.float32([0, 0, 2]), np.float32([1, 2, 0]), 8))
    turns = eighths[::2]
    points = np.concatenate([posed(turn, quarter) for turn in turns]).astype(np.float32)  # maps onto itself
    _, true, _ = make_case(2)
    for turn in turns:
        estimated = true @ turn
        assert mssd(estimated, true, points, turns) < 1e-5
        assert adi(estimated, true, points) < 1e-5
    assert mssd(true @ turns[1], true, points) > 0.5
    assert mssd(true @ eighths[1], true, points, turns) > 0.5


def test_mssd_counts_the_identity_among_the_symmetries():
    _, true, points = make_case(3)
    turns = discretise_symmetry(np.float32([1, 0, 0]), np.zeros(3, np.float32), 8)
    assert mssd(true, true, points, np.asarray(turns)[1::2]) < 1e-5  # the nearest of the turns is a whole part away


def test_discretised_symmetry():
    offset = np.array([1.0, -2, 3], np.float32)
    turns = np.asarray(discretise_symmetry(np.array([1.0, 1, 0], np.float32), offset, 8))
    np.testing.assert_allclose(turns[0], np.eye(4), atol=1e-6)
    for turn in turns:
        np.testing.assert_allclose(posed(turn, offset[None]), offset[None], atol=1e-5)
    product = np.linalg.multi_dot(turns[1][None].repeat(8, axis=0))
    np.testing.assert_allclose(product, np.eye(4), atol=1e-5)
    with pytest.raises(InputError, match="axis is zero"):
        discretise_symmetry(np.zeros(3), np.zeros(3), 3)
    with pytest.raises(InputError, match="count"):
        discretise_symmetry(np.ones(3), np.zeros(3), 0)


def test_recall():
    errors = np.float32([0.05, 0.1, 0.2, np.inf, np.inf])
    assert recall(errors, 1) == pytest.approx(0.2)
    assert recall(errors, 1.0, threshold=0.15) == pytest.approx(0.4)
    assert recall(errors, np.float32([0.1, 2, 3, 4, 5])) == pytest.approx(0.4)
    with pytest.raises(InputError, match="errors holds NaN"):
        recall(np.float32([0.05, np.nan]), 1.0)
    with pytest.raises(InputError, match="size must be above zero"):
        recall(errors, -1.0)
    with pytest.raises(InputError, match="threshold is 0"):
        recall(errors, 1.0, threshold=0.0)
    with pytest.raises(InputError, match="errors is empty"):
        recall(np.zeros(0), 1.0)
    with pytest.raises(InputError, match="size has shape"):
        recall(errors, np.ones(3))


def test_vmap_agrees_with_single_calls():
    cases = [make_case(seed) for seed in range(3)]
    batch = [np.stack(side) for side in zip(*cases, strict=True)]
    for metric in (add, adi, mssd):
        np.testing.assert_allclose(jax.vmap(metric)(*batch), [metric(*case) for case in cases], rtol=1e-5)


@pytest.mark.usefixtures("all_optimisations")
def test_pairs_of_points_are_never_stored():
    given = translated(0), translated(0), np.zeros((2048, 3), np.float32)
    memory = jax.jit(adi).lower(*given).compile().memory_analysis()
    if memory is not None:
        assert memory.temp_size_in_bytes < 2048 * 2048  # a quarter of what the float32 pairs would take


@pytest.mark.parametrize("metric", [add, adi, mssd])
def test_bad_input_is_named(metric):
    estimated, true, points = make_case(5)
    with pytest.raises(InputError, match="T_estimated has shape"):
        metric(estimated[:3], true, points)
    with pytest.raises(InputError, match="T_true holds"):
        metric(estimated, true * np.float32(np.nan), points)
    with pytest.raises(InputError, match="points is empty"):
        metric(estimated, true, points[:0])
    with pytest.raises(InputError, match="floating"):
        metric(estimated, true, points.astype(bool))
    with pytest.raises(InputError, match="points is empty"):
        diameter(points[:0])


@pytest.mark.parametrize("metric", [add, adi, mssd])
def test_gradient_is_finite_at_the_true_pose(metric):
    _, true, points = make_case(0)
    assert np.isfinite(jax.grad(lambda pose: metric(pose, true, points))(true)).all()
