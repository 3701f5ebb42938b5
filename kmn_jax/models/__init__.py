"""The network: published shapes from exact algebra, object and scene features as reusable values."""

from kmn_jax.models.keymatchnet import (
    KeyMatchNet,
    KeyMatchNetConfig,
    Model,
    ObjectFeatures,
    create_model,
    encode_object,
    encode_scene,
    match,
    model_structure,
)
from kmn_jax.models.losses import LossConfig, MatchingLoss, keypoint_labels, matching_loss
from kmn_jax.models.released import RELEASED_CONFIG, load_released, save_released
from kmn_jax.models.weights import load_model, load_pretrained, released_file, save_model

__all__ = [
    "RELEASED_CONFIG",
    "KeyMatchNet",
    "KeyMatchNetConfig",
    "LossConfig",
    "MatchingLoss",
    "Model",
    "ObjectFeatures",
    "create_model",
    "encode_object",
    "encode_scene",
    "keypoint_labels",
    "load_model",
    "load_pretrained",
    "load_released",
    "match",
    "matching_loss",
    "model_structure",
    "released_file",
    "save_model",
    "save_released",
]
