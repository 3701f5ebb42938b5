import jax
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.pose import MatchConfig, PoseStatus, find_matches, ransac

N, K = 40, 6


def make_case(seed=0, n=N, k=K):
    generator = np.random.default_rng(seed)
    segmentation, keypoint = generator.normal(size=(n, 2)), 2 * generator.normal(size=(n, k))
    clouds = [generator.normal(size=(rows, 3)) for rows in (n, n, k, k)]
    return *(array.astype(np.float32) for array in (segmentation, keypoint, *clouds)), 2.0


def softmax(logits, axis=1):
    scores = np.exp(np.asarray(logits, np.float64))
    return scores / scores.sum(axis=axis, keepdims=True)


def reference(case, threshold, axis=1):
    """All (point, keypoint, weight) votes in plain NumPy, best first."""
    segmentation, keypoint = softmax(case[0]), softmax(case[1], axis)
    votes = keypoint >= threshold * keypoint.max(axis=1, keepdims=True)
    votes &= (segmentation[:, 1] > segmentation[:, 0])[:, None]
    found = [(i, j, segmentation[i, 1] * keypoint[i, j]) for i, j in np.argwhere(votes)]
    return sorted(found, key=lambda vote: -vote[2])


@pytest.mark.parametrize(("softmax", "axis"), [("keypoints", 1), ("points", 0)])
@pytest.mark.parametrize("threshold", [0.1, 0.7, 1.0])
@pytest.mark.parametrize("seed", range(2))
def test_against_numpy(seed, threshold, softmax, axis):
    case = make_case(seed)
    config = MatchConfig(vote_threshold=threshold, softmax=softmax, capacity=300)
    matches = jax.device_get(find_matches(*case, config=config))
    expected = reference(case, threshold, axis)
    assert matches.mask.sum() == len(expected)
    assert not matches.overflow
    assert matches.mask.shape == (300,)
    for row, (i, j, weight) in enumerate(expected):
        np.testing.assert_allclose(matches.weights[row], weight, rtol=1e-5)
        np.testing.assert_array_equal(matches.scene_points[row], case[2][i])
        np.testing.assert_array_equal(matches.scene_normals[row], case[3][i])
        np.testing.assert_array_equal(matches.object_points[row], case[4][j])
        np.testing.assert_array_equal(matches.object_normals[row], case[5][j])
    assert not matches.weights[len(expected) :].any()


def test_overflow_keeps_the_best():
    case = make_case()
    expected = reference(case, 0.1)
    matches = find_matches(*case, config=MatchConfig(vote_threshold=0.1, capacity=10))
    assert matches.overflow
    assert matches.mask.all()
    np.testing.assert_allclose(matches.weights, [weight for *_, weight in expected[:10]], rtol=1e-5)


def test_large_logits_do_not_overflow():
    case = make_case()
    matches = find_matches(case[0] * np.float32(1e4), case[1] * np.float32(1e4), *case[2:])
    assert matches.mask.any()
    for field in matches:
        assert np.isfinite(field).all()


def test_nothing_segmented_gives_no_pose():
    case = make_case()
    matches = find_matches(np.tile(np.float32([3, -3]), (N, 1)), *case[1:])
    assert not matches.mask.any()
    result = ransac(jax.random.key(0), matches)
    assert result.status == PoseStatus.TOO_FEW_MATCHES
    np.testing.assert_array_equal(result.T_scene_object, np.eye(4))


@pytest.mark.parametrize("least", [1, 7, N, N + 5])
def test_points_most_like_the_object_vote_though_all_are_background(least):
    case = make_case()
    background = np.asarray(case[0]) - [0.0, 100.0]
    hidden = np.arange(N) % 4 == 0  # padding never votes, and does not take the place of what could
    config = MatchConfig(vote_threshold=1.0, capacity=300, least_points=least)
    matches = find_matches(background, *case[1:], mask=~hidden, config=config)
    margins = np.where(hidden, -np.inf, background[:, 1] - background[:, 0])
    expected = np.argsort(-margins)[: min(least, (~hidden).sum())]
    voting = np.asarray(matches.scene_points)[np.asarray(matches.mask)]
    assert {tuple(point) for point in voting} == {tuple(point) for point in np.asarray(case[2])[expected]}


def test_where_enough_points_vote_no_others_do():
    case = make_case()
    voting = int((case[0][:, 1] > case[0][:, 0]).sum())
    own, more = (find_matches(*case, config=MatchConfig(least_points=least)) for least in (0, voting))
    for before, after in zip(own, more, strict=True):
        np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize("softmax", ["keypoints", "points"])
def test_points_that_are_not_real_change_nothing(softmax):
    case, config = make_case(), MatchConfig(softmax=softmax)
    few = [array[:30] for array in case[:4]]
    alone = find_matches(*few, *case[4:], config=config)
    masked = find_matches(*case, mask=np.arange(N) < 30, config=config)
    for one, other in zip(alone, masked, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)
    nothing = find_matches(*case, mask=np.zeros(N, bool), config=config)
    assert not nothing.mask.any()
    assert np.isfinite(nothing.weights).all()


def test_masked_points_never_vote():
    case = make_case()
    mask = np.arange(N) < 30
    rubbish = [np.where(mask[:, None], array, np.float32(np.nan)) for array in case[:4]]
    matches = find_matches(*rubbish, *case[4:], mask=mask)
    expected = find_matches(*(array[:30] for array in case[:4]), *case[4:])
    for name in ("object_points", "scene_points", "weights", "mask"):
        np.testing.assert_array_equal(getattr(matches, name), getattr(expected, name))


def test_traced_points_that_are_not_finite_never_vote():
    case = list(make_case())
    case[1][3, 0], case[2][5, 0] = np.nan, np.inf
    mask = ~np.isin(np.arange(N), [3, 5])
    matches = jax.jit(find_matches)(*case)
    expected = jax.jit(find_matches)(*make_case(), mask)
    for got, want in zip(matches, expected, strict=True):
        np.testing.assert_array_equal(got, want)
    with pytest.raises(InputError, match="keypoint_logits holds"):
        find_matches(*case)


def test_vmap_agrees_with_single_calls():
    cases = [make_case(seed) for seed in range(3)]
    batch = jax.vmap(find_matches)(*(np.stack([np.float32(x) for x in side]) for side in zip(*cases, strict=True)))
    for row, case in enumerate(cases):
        np.testing.assert_allclose(np.asarray(batch.weights)[row], find_matches(*case).weights, rtol=1e-5)


def test_bad_input_is_named():
    case = make_case()

    def with_argument(position, value):
        return [*case[:position], value, *case[position + 1 :]]

    bad = [
        (0, case[0][:, :1], "segmentation_logits has shape"),
        (0, case[0].astype(bool), "segmentation_logits has dtype"),
        (1, case[1][0], "keypoint_logits has shape"),
        (1, case[1][:0], "keypoint_logits has shape"),
        (2, case[2][:5], "scene_points has shape"),
        (3, case[3][:, :2], "scene_normals has shape"),
        (4, case[4][:2], "keypoints has shape"),
        (5, case[5] * np.float32(np.inf), "keypoint_normals holds"),
        (6, -1.0, "object_diameter is -1"),
    ]
    for position, value, message in bad:
        with pytest.raises(InputError, match=message):
            find_matches(*with_argument(position, value))
    with pytest.raises(InputError, match="mask has dtype"):
        find_matches(*case, mask=np.ones(N, np.int32))


@pytest.mark.parametrize(
    "change", [{"vote_threshold": 0.0}, {"vote_threshold": 1.5}, {"capacity": 2}, {"least_points": -1}]
)
def test_config_refuses_contradictions(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        MatchConfig(**change)
