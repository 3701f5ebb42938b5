from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.models import LossConfig, keypoint_labels, matching_loss, spread_labels

loss_of = jax.jit(matching_loss)
shares_of = jax.jit(spread_labels, static_argnames="spread")


def reference(segmentation, keypoint, on_object, labels):
    """Cross entropies by hand, in float64."""

    def entropy(logits, target):
        logits = logits.astype(np.float64)
        return np.log(np.exp(logits).sum(axis=1)) - logits[np.arange(len(target)), target]

    a = entropy(segmentation, on_object.astype(int)).mean()
    b = entropy(keypoint[on_object], labels[on_object]).mean()
    return 0.2 * a + 0.8 * b, a, b


def example(seed: int, n: int = 60, k: int = 7):
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=(n, 2)).astype("f4"),
        rng.normal(size=(n, k)).astype("f4"),
        rng.random(n) < 0.6,
        rng.integers(0, k, n).astype("i4"),
    )


@pytest.mark.parametrize("seed", range(3))
def test_loss_and_accuracies_by_hand(seed: int) -> None:
    segmentation, keypoint, on_object, labels = example(seed)
    loss = loss_of(segmentation, keypoint, on_object, labels)
    np.testing.assert_allclose(loss[:3], reference(segmentation, keypoint, on_object, labels), rtol=1e-5)
    np.testing.assert_allclose(loss.segmentation_accuracy, (segmentation.argmax(1) == on_object).mean(), rtol=1e-6)
    right = keypoint[on_object].argmax(1) == labels[on_object]
    np.testing.assert_allclose(loss.keypoint_accuracy, right.mean(), rtol=1e-6)
    assert (int(loss.num_points), int(loss.num_object_points)) == (60, on_object.sum())


def test_padding_and_background_labels_do_not_matter() -> None:
    segmentation, keypoint, on_object, labels = example(3)
    mask = np.arange(60) < 41
    want = loss_of(*(x[:41] for x in (segmentation, keypoint, on_object, labels)))
    labels = np.where(on_object & mask, labels, 10**6).astype("i4")
    got = loss_of(segmentation, keypoint, on_object, labels, mask)
    np.testing.assert_allclose(got, want, rtol=1e-6)


def test_no_object_point_means_no_keypoint_loss_and_no_nan() -> None:
    segmentation, keypoint, _, labels = map(jnp.asarray, example(4))
    none = jnp.zeros(60, bool)
    loss = loss_of(segmentation, keypoint, none, labels)
    assert float(loss.keypoint) == float(loss.keypoint_accuracy) == 0
    assert int(loss.num_object_points) == 0
    gradient = jax.jit(jax.grad(lambda logits: matching_loss(segmentation, logits, none, labels).total))(keypoint)
    assert (np.asarray(gradient) == 0).all()


def test_labels_are_the_nearest_keypoints() -> None:
    rng = np.random.default_rng(5)
    points, keypoints = rng.normal(size=(50, 3)).astype("f4"), rng.normal(size=(6, 3)).astype("f4")
    distances = np.linalg.norm(points[:, None] - keypoints[None], axis=-1)
    labels, distance = jax.jit(keypoint_labels)(points, keypoints)
    np.testing.assert_array_equal(labels, distances.argmin(axis=1))
    np.testing.assert_allclose(distance, distances.min(axis=1), rtol=1e-5)


def test_weights_are_checked() -> None:
    for weights in ((-1.0, 1.0), (0.0, 0.0)):
        with pytest.raises(ValueError, match="loss weights"):
            LossConfig(*weights)


def test_padding_reaches_neither_loss_nor_gradient() -> None:
    segmentation, keypoint, on_object, labels = map(jnp.asarray, example(6))
    mask = jnp.arange(60) < 41

    @jax.jit
    @jax.value_and_grad
    def total(logits: jax.Array) -> jax.Array:
        return matching_loss(segmentation, logits, on_object, labels, mask).total

    broken = np.where(mask[:, None], keypoint, np.float32(np.nan))
    (got, of_broken), (want, of_whole) = total(broken), total(keypoint)
    np.testing.assert_allclose(got, want, rtol=1e-6)
    np.testing.assert_allclose(of_broken, of_whole, atol=1e-7)


def test_spread_labels_are_shared_by_keypoints_as_near_as_they_are() -> None:
    keypoints = np.random.default_rng(0).normal(size=(7, 3)).astype("f4")
    shares = np.asarray(shares_of(keypoints, 0.5))
    np.testing.assert_allclose(shares.sum(axis=1), 1, rtol=1e-6)
    gap = np.linalg.norm(keypoints[2] - keypoints[5])
    np.testing.assert_allclose(shares[2, 5] / shares[2, 2], np.exp(-(gap**2) / (2 * 0.5**2)), rtol=1e-4)
    np.testing.assert_allclose(shares_of(keypoints, 1e-3), np.eye(7), atol=1e-6)


def test_loss_with_shares_is_the_mean_of_losses_with_labels() -> None:
    segmentation, keypoint, on_object, _ = example(7)
    shares = np.asarray(shares_of(np.random.default_rng(1).normal(size=(7, 3)).astype("f4"), 1.0))
    label = np.full(60, 3, dtype=np.int32)
    got = loss_of(segmentation, keypoint, on_object, label, shares=shares)
    each = [loss_of(segmentation, keypoint, on_object, label * 0 + other).keypoint for other in range(7)]
    np.testing.assert_allclose(got.keypoint, (shares[3] * np.asarray(each)).sum(), rtol=1e-5)
    same = loss_of(segmentation, keypoint, on_object, label)
    assert float(got.keypoint_accuracy) == float(same.keypoint_accuracy)


@pytest.mark.parametrize("spread", [-0.1, 1e-20, 1e200, float("nan")])
def test_labels_are_spread_over_lengths_that_an_object_has(spread: float) -> None:
    with pytest.raises(InputError, match=r"keypoint_spread = .* must be 0, or from 0\.001 to 10"):
        LossConfig(keypoint_spread=spread)
