import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.geometry import compose, random_pose
from kmn_jax.pose import (
    add,
    adi,
    bounding_box_diagonal,
    diameter,
    discretise_symmetry,
    mssd,
    recall,
)


def make_case(seed, count=100):
    keys = jax.random.split(jax.random.key(seed), 3)
    return random_pose(keys[0], 2.0), random_pose(keys[1], 2.0), jax.random.normal(keys[2], (count, 3))


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
    points = jnp.array([[0.0, 0, 0], [1, 0, 0]])
    pose = jnp.eye(4).at[0, 3].set(1.0)  # points to 1 and 2: the true 0 is 1 away from one, the true 1 meets one
    assert adi(pose, jnp.eye(4), points) == pytest.approx(0.5)


def test_far_from_the_origin_digits_are_kept():
    _, _, points = make_case(1)
    true = jnp.eye(4).at[0, 3].set(1000.0)
    estimated = true.at[0, 3].add(0.125)
    for metric in (add, mssd):
        assert metric(estimated, true, points) == pytest.approx(0.125, rel=1e-3)


def test_symmetric_objects():
    generator = np.random.default_rng(0)
    quarter = generator.normal(size=(30, 3)).astype(np.float32)
    turns = discretise_symmetry(jnp.array([0.0, 0, 2]), jnp.array([1.0, 2, 0]), 4)
    points = np.concatenate([posed(turn, quarter) for turn in turns]).astype(np.float32)  # maps onto itself
    _, true, _ = make_case(2)
    for turn in turns:
        estimated = compose(true, turn)
        assert mssd(estimated, true, points, turns) < 1e-5
        assert adi(estimated, true, points) < 1e-5
    assert mssd(compose(true, turns[1]), true, points) > 0.5
    half_off = compose(true, discretise_symmetry(jnp.array([0.0, 0, 1]), jnp.array([1.0, 2, 0]), 8)[1])
    assert mssd(half_off, true, points, turns) > 0.5


def test_mssd_counts_the_identity_among_the_symmetries():
    _, true, points = make_case(3)
    turns = discretise_symmetry(jnp.array([1.0, 0, 0]), jnp.zeros(3), 3)[1:]
    assert mssd(true, true, points, turns) < 1e-5  # the nearest of the turns is a whole part away


def test_discretised_symmetry():
    offset = np.array([1.0, -2, 3], np.float32)
    turns = discretise_symmetry(np.array([1.0, 1, 0], np.float32), offset, 6)
    np.testing.assert_allclose(turns[0], np.eye(4), atol=1e-6)
    for turn in turns:
        np.testing.assert_allclose(posed(turn, offset[None]), offset[None], atol=1e-5)
    product = np.linalg.multi_dot(np.asarray(turns[1])[None].repeat(6, axis=0))
    np.testing.assert_allclose(product, np.eye(4), atol=1e-5)
    with pytest.raises(InputError, match="axis is zero"):
        discretise_symmetry(jnp.zeros(3), jnp.zeros(3), 3)
    with pytest.raises(InputError, match="count"):
        discretise_symmetry(jnp.ones(3), jnp.zeros(3), 0)


def test_recall():
    errors = jnp.array([0.05, 0.1, 0.2, jnp.inf, jnp.nan])
    assert recall(errors, 1.0) == pytest.approx(0.2)
    assert recall(errors, 1.0, threshold=0.15) == pytest.approx(0.4)
    assert recall(errors, jnp.array([0.1, 2, 3, 4, 5])) == pytest.approx(0.4)
    with pytest.raises(InputError, match="errors is empty"):
        recall(jnp.zeros(0), 1.0)
    with pytest.raises(InputError, match="size has shape"):
        recall(errors, jnp.ones(3))


def test_vmap_agrees_with_single_calls():
    cases = [make_case(seed) for seed in range(3)]
    batch = [jnp.stack(side) for side in zip(*cases, strict=True)]
    for metric in (add, adi, mssd):
        np.testing.assert_allclose(jax.vmap(metric)(*batch), [metric(*case) for case in cases], rtol=1e-5)


@pytest.mark.usefixtures("all_optimisations")
def test_pairs_of_points_are_never_stored():
    points = jnp.zeros((2048, 3))
    memory = jax.jit(adi).lower(jnp.eye(4), jnp.eye(4), points).compile().memory_analysis()
    if memory is not None:
        assert memory.temp_size_in_bytes < 2048 * 2048  # a quarter of what the float32 pairs would take


@pytest.mark.parametrize("metric", [add, adi, mssd])
def test_bad_input_is_named(metric):
    estimated, true, points = make_case(5)
    with pytest.raises(InputError, match="T_estimated has shape"):
        metric(estimated[:3], true, points)
    with pytest.raises(InputError, match="T_true holds"):
        metric(estimated, true * jnp.nan, points)
    with pytest.raises(InputError, match="points is empty"):
        metric(estimated, true, points[:0])
    with pytest.raises(InputError, match="floating"):
        metric(estimated, true, points.astype(jnp.int32))
    with pytest.raises(InputError, match="points is empty"):
        diameter(points[:0])


@pytest.mark.parametrize("metric", [add, adi, mssd])
def test_gradient_is_finite_at_the_true_pose(metric):
    points = jnp.asarray(np.random.default_rng(0).normal(size=(30, 3)), "f4")
    assert bool(jnp.isfinite(jax.grad(lambda pose: metric(pose, jnp.eye(4), points))(jnp.eye(4))).all())
