import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.pose import kabsch

# Corner cases of the shape of a point set; all but the collinear one determine a rotation. As far as it can be, of six
# points: each number of them is compiled for.
SHAPES = {
    "regular": np.random.default_rng(0).normal(size=(6, 3)),
    "planar": np.random.default_rng(1).normal(size=(6, 3)) * [1, 1, 0],
    "triplet": np.array([[0.0, 0, 0], [1, 0, 0], [0.3, 0.8, 0]]),
    "octahedron": np.concatenate([np.eye(3), -np.eye(3)]),  # all singular values equal
    "square": np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0], [0, 0, 0], [0, 0, 0]]),  # two equal, one zero
    "prism": np.concatenate([np.eye(3), -np.eye(3)]) * [1, 1, 3],  # two equal
}
COLLINEAR = np.linspace(-1, 2, 6)[:, None] * np.array([[1.0, 2, -0.5]]) + 0.3
reverse_mode = jax.jit(jax.jacrev(kabsch, argnums=(0, 1)))


def random_rotation(generator):
    q, r = np.linalg.qr(generator.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def reference(source, target, weights=None):
    """Kabsch by NumPy's SVD in float64."""
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    weights = np.ones(len(source)) if weights is None else np.asarray(weights, np.float64)
    weights = weights / weights.sum()
    source_mean, target_mean = weights @ source, weights @ target
    covariance = ((target - target_mean) * weights[:, None]).T @ (source - source_mean)
    u, _, vt = np.linalg.svd(covariance)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, target_mean - rotation @ source_mean
    return pose


def make_pair(seed, source=None, noise=0.05):
    generator = np.random.default_rng(seed)
    source = generator.normal(size=(12, 3)) if source is None else source
    target = source @ random_rotation(generator).T + generator.normal(size=3)
    return source.astype(np.float32), (target + noise * generator.normal(size=target.shape)).astype(np.float32)


def cost(pose, source, target):
    pose = np.asarray(pose, np.float64)
    return ((source @ pose[:3, :3].T + pose[:3, 3] - target) ** 2).sum()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("shape", SHAPES)
def test_agrees_with_svd(shape, seed):
    source, target = make_pair(seed, SHAPES[shape])
    np.testing.assert_allclose(kabsch(source, target), reference(source, target), atol=3e-6)


@pytest.mark.parametrize("seed", range(3))
def test_weights(seed):
    source, target = make_pair(seed, noise=0.3)
    weights = np.random.default_rng(seed).uniform(0, 2, size=len(source)).astype(np.float32)
    weights[3] = 0
    np.testing.assert_allclose(kabsch(source, target, weights), reference(source, target, weights), atol=3e-6)
    target[3] = np.nan  # a row of weight zero is padding
    source[3] = 1e38
    np.testing.assert_allclose(kabsch(source, target, weights), kabsch(source, target, weights * 1e-6), atol=1e-6)
    assert np.isfinite(kabsch(source, target, weights)).all()


@pytest.mark.parametrize("seed", range(5))
def test_never_mirrors(seed):
    source, target = make_pair(seed, noise=0.01)
    mirrored = target * np.array([1, 1, -1], np.float32)
    pose = np.asarray(kabsch(source, mirrored))
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(pose, reference(source, mirrored), atol=2e-5)


@pytest.mark.parametrize("seed", range(5))
def test_collinear_points_give_a_proper_rotation_that_fits(seed):
    source, target = make_pair(seed, COLLINEAR, noise=0)
    pose = np.asarray(kabsch(source, target))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-5)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1, abs=1e-5)
    assert cost(pose, source, target) < 1e-8


def test_duplicated_points():
    same = np.full((6, 3), 2.5, np.float32)
    pose = np.asarray(kabsch(same, same + 1))
    np.testing.assert_allclose(pose, [[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [0, 0, 0, 1]], atol=1e-6)
    source, target = make_pair(0)
    twice = kabsch(np.concatenate([source[:8], source[:4]]), np.concatenate([target[:8], target[:4]]))
    weights = np.repeat(np.float32([2, 1, 0]), 4)
    np.testing.assert_allclose(twice, kabsch(source, target, weights), atol=1e-6)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_units_do_not_matter(scale):
    source, target = make_pair(0)
    pose, scaled = np.array(kabsch(source, target)), np.asarray(kabsch(source * scale, target * scale))
    np.testing.assert_allclose(scaled[:3, :3], pose[:3, :3], atol=2e-6)
    np.testing.assert_allclose(scaled[:3, 3] / scale, pose[:3, 3], atol=5e-6)


def test_far_from_the_origin():
    source, target = make_pair(0)
    source, target = source + np.float32(1000), target - np.float32(3000)  # rounds the points themselves by 1e-4
    pose = np.asarray(kabsch(source, target))
    np.testing.assert_allclose(pose[:3, :3], reference(source, target)[:3, :3], atol=3e-6)
    centre = np.append(source.mean(axis=0), 1)
    np.testing.assert_allclose((pose @ centre)[:3], target.mean(axis=0), atol=2e-3)


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_half_precision_is_computed_in_float32(dtype):
    source, target = (points.astype(dtype) for points in make_pair(0))
    pose = kabsch(source, target)
    assert pose.dtype == jnp.float32
    np.testing.assert_allclose(pose, kabsch(source.astype(np.float32), target.astype(np.float32)), atol=1e-6)


def test_vmap_and_jit_agree_with_single_calls():
    pairs = [make_pair(seed) for seed in range(4)]
    source, target = (np.stack(side) for side in zip(*pairs, strict=True))
    singles = np.stack([kabsch(a, b) for a, b in pairs])
    np.testing.assert_allclose(jax.vmap(kabsch)(source, target), singles, atol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.vmap(kabsch))(source, target), singles, atol=1e-6)


def probe(seed, count):
    """A random linear function of the pose, so that one gradient tests all of its entries."""
    return jnp.asarray(np.random.default_rng(seed).normal(size=(count, 4)), dtype=jnp.float32)


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("shape", SHAPES)
def test_gradients_match_finite_differences(shape, noise):
    source, target = make_pair(3, SHAPES[shape], noise=noise)
    weights = np.random.default_rng(4).uniform(0.5, 1, size=len(source)).astype(np.float32)
    if noise == 0 and shape != "regular":
        weights[:] = 1  # keeps the singular values equal
    coefficients = probe(5, 3)

    def value(source, target, weights):
        return (coefficients * kabsch(source, target, weights)[:3]).sum()

    def reference_value(arguments):
        return (np.asarray(coefficients) * reference(*arguments)[:3]).sum()

    inputs = [np.asarray(x, np.float64) for x in (source, target, weights)]
    gradients = jax.grad(value, argnums=(0, 1, 2))(source, target, weights)
    step = 1e-6
    for position, gradient in enumerate(gradients):
        numeric = np.zeros(inputs[position].shape)
        for index in np.ndindex(*numeric.shape):
            sides = []
            for sign in (1, -1):
                moved = [x.copy() for x in inputs]
                moved[position][index] += sign * step
                sides.append(reference_value(moved))
            numeric[index] = (sides[0] - sides[1]) / (2 * step)
        np.testing.assert_allclose(gradient, numeric, atol=2e-4 * max(1, np.abs(numeric).max()))


@pytest.mark.parametrize("shape", ["triplet", "octahedron"])
def test_forward_and_reverse_mode_agree(shape):
    source, target = make_pair(6, SHAPES[shape])
    forward = jax.jit(jax.jacfwd(kabsch, argnums=(0, 1)))(source, target)
    for a, b in zip(forward, reverse_mode(source, target), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)


@pytest.mark.parametrize("points", [COLLINEAR, np.zeros((6, 3)), np.repeat(COLLINEAR[:2], 3, axis=0)])
def test_gradients_are_finite_where_the_rotation_is_open(points):
    source, target = make_pair(7, points, noise=0)
    for gradient in jax.device_get(reverse_mode(source, target)):
        assert np.isfinite(gradient).all()
        assert np.abs(gradient).max() < 1e3


def test_gradient_descent_through_kabsch_reaches_a_target_rotation():
    source, target = make_pair(8, noise=0)
    wanted = jnp.asarray(random_rotation(np.random.default_rng(9)), dtype=jnp.float32)

    def loss(target):
        return ((kabsch(source, target)[:3, :3] - wanted) ** 2).sum()

    step = jax.jit(lambda target: target - 2.0 * jax.grad(loss)(target))
    start = jax.jit(loss)(target)
    for _ in range(200):
        target = step(target)
    assert float(jax.jit(loss)(target)) < 1e-3 * float(start)


BAD = {
    "two points": (np.zeros((2, 3), np.float32), np.zeros((2, 3), np.float32), None, "at least 3"),
    "no points": (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), None, "at least 3"),
    "unequal": (np.ones((4, 3), np.float32), np.ones((5, 3), np.float32), None, "target has shape"),
    "not 3D": (np.ones((4, 2), np.float32), np.ones((4, 2), np.float32), None, "source has shape"),
    "flat": (np.ones(3, np.float32), np.ones((3, 3), np.float32), None, "source has shape"),
    "scalar": (np.float32(1), np.ones((3, 3), np.float32), None, "source has shape"),
    "truths": (np.ones((4, 3), bool), np.ones((4, 3), np.float32), None, "floating"),
    "NaN": (np.full((4, 3), np.nan, np.float32), np.ones((4, 3), np.float32), None, "NaN"),
    "infinite": (np.ones((4, 3), np.float32), np.full((4, 3), np.inf, np.float32), None, "infinite"),
    "weights": (np.ones((4, 3), np.float32), np.ones((4, 3), np.float32), np.ones(3, np.float32), "weights has shape"),
    "zero": (np.ones((4, 3), np.float32), np.ones((4, 3), np.float32), np.zeros(4, np.float32), "positive for 0"),
    "negative": (np.ones((4, 3), np.float32), np.ones((4, 3), np.float32), -np.ones(4, np.float32), "negative"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    source, target, weights, message = BAD[case]
    with pytest.raises(InputError, match=message):
        kabsch(source, target, weights)


def test_whole_numbers_are_points():
    source = np.array([[0, 0, 0], [10, 0, 0], [0, 20, 0], [0, 0, 30]], np.uint8)
    target = source[:, [1, 2, 0]] + np.int16(5)
    np.testing.assert_array_equal(kabsch(source, target, [1, 1, 1, 1]), kabsch(source * 1.0, target * 1.0))


def test_traced_points_that_are_not_finite_count_as_weight_zero():
    source, target = make_pair(0)
    expected = kabsch(source, target, np.float32(np.arange(12) > 0))
    target[0] = np.nan
    np.testing.assert_allclose(jax.jit(kabsch)(source, target), expected, atol=1e-6)
    nothing = jax.jit(kabsch)(source, np.full_like(target, np.nan))
    np.testing.assert_allclose(nothing, np.eye(4), atol=1e-6)
