"""Masked losses and accuracies of the two outputs (arXiv 2303.16102, training section)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.errors import InputError
from kmn_jax.geometry import nearest, squared_distances

_LEAST_SPREAD, _MOST_SPREAD = 0.001, 10.0


@dataclass(frozen=True)
class LossConfig:
    """Weights of the two cross entropies; the published ones. Labels of keypoints are spread in training alone."""

    segmentation_weight: float = 0.2
    keypoint_weight: float = 0.8
    keypoint_spread: float = 0.0  # deviation, in crop radii, of the keypoints that share a point's label; 0: one has it

    def __post_init__(self) -> None:
        weights = (self.segmentation_weight, self.keypoint_weight)
        if min(weights) < 0 or max(weights) <= 0:
            raise InputError(f"loss weights are {weights}, but none may be negative and one must be above zero")
        if self.keypoint_spread != 0 and not _LEAST_SPREAD <= self.keypoint_spread <= _MOST_SPREAD:
            raise InputError(
                f"keypoint_spread = {self.keypoint_spread} must be 0, or from {_LEAST_SPREAD} to {_MOST_SPREAD}"
            )


class MatchingLoss(NamedTuple):
    """Loss and accuracies of one crop. What nothing was counted for is zero; the counts say so.

    Attributes:
        total: weighted sum of the two cross entropies, in nats.
        segmentation, keypoint: mean cross entropy over real points, and over real points of the object.
        segmentation_accuracy, keypoint_accuracy: share of the same points whose largest logit is the label.
        num_points, num_object_points: how many points the means are over.
    """

    total: Float[Array, ""]
    segmentation: Float[Array, ""]
    keypoint: Float[Array, ""]
    segmentation_accuracy: Float[Array, ""]
    keypoint_accuracy: Float[Array, ""]
    num_points: Int[Array, ""]
    num_object_points: Int[Array, ""]


def matching_loss(
    segmentation_logits: Float[Array, "n 2"],
    keypoint_logits: Float[Array, "n k"],
    on_object: Bool[Array, " n"],
    keypoint_labels: Int[Array, " n"],
    mask: Bool[Array, " n"] | None = None,
    config: LossConfig = LossConfig(),
    shares: Float[Array, "k k"] | None = None,
) -> MatchingLoss:
    """Return losses and accuracies of one crop.

    `on_object` marks the points on the seed's instance; the keypoint loss counts only those, whatever label
    the others carry. Points where `mask` is false count nowhere. With `shares`, a label stands for its row of them, see
    `spread_labels`; accuracies are those of the labels.
    """
    real = jnp.ones_like(on_object) if mask is None else mask
    scored = real & on_object
    labels = jnp.where(scored, keypoint_labels, 0)
    segmentation, segmentation_accuracy = _mean_cross_entropy(segmentation_logits, on_object.astype(jnp.int32), real)
    keypoint, keypoint_accuracy = _mean_cross_entropy(keypoint_logits, labels, scored, shares)
    return MatchingLoss(
        config.segmentation_weight * segmentation + config.keypoint_weight * keypoint,
        segmentation,
        keypoint,
        segmentation_accuracy,
        keypoint_accuracy,
        real.sum(),
        scored.sum(),
    )


def keypoint_labels(
    scene_points: Float[Array, "n 3"], keypoints_scene: Float[Array, "k 3"]
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Return for each scene point its nearest keypoint of the instance (both in the scene frame) and the distance."""
    return nearest(scene_points, keypoints_scene)


def spread_labels(keypoints: Float[Array, "k 3"], spread: float) -> Float[Array, "k k"]:
    """Return for each keypoint, as the label of a point, the shares that all keypoints have in it; rows sum to one.

    They fall with the distance from the keypoint that is the label, as a normal distribution of this deviation does.
    """
    return jax.nn.softmax(-squared_distances(keypoints, keypoints) / (2 * spread**2), axis=1)


def _mean_cross_entropy(
    logits: Float[Array, "n c"],
    labels: Int[Array, " n"],
    counted: Bool[Array, " n"],
    shares: Float[Array, "c c"] | None = None,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    logits = jnp.where(counted[:, None], logits, 0)  # before the softmax: padding must not reach the gradient either
    log_probability = jax.nn.log_softmax(logits.astype(jnp.float32), axis=1)
    if shares is None:
        entropy = -jnp.take_along_axis(log_probability, labels[:, None], axis=1)[:, 0]
    else:
        entropy = -(shares[labels] * log_probability).sum(axis=1)
    count = jnp.maximum(counted.sum(), 1).astype(jnp.float32)
    right = (logits.argmax(axis=1) == labels) & counted
    return jnp.where(counted, entropy, 0).sum() / count, right.sum().astype(jnp.float32) / count
