"""The network: published shapes from exact algebra, object and scene features as reusable values."""

from kmn_jax.models._chirality import with_chiral_inputs
from kmn_jax.models._config import KeyMatchNetConfig
from kmn_jax.models._invariants import LATER_PAIR_CHANNELS, OBJECT_CHANNELS, PAIR_CHANNELS, SCENE_CHANNELS
from kmn_jax.models._keymatchnet import (
    KeyMatchNet,
    Model,
    ObjectFeatures,
    create_model,
    encode_object,
    encode_scene,
    match,
    model_structure,
)
from kmn_jax.models._layers import Compute
from kmn_jax.models._losses import LossConfig, MatchingLoss, keypoint_labels, matching_loss, spread_labels
from kmn_jax.models._normalization import released_object, released_scene
from kmn_jax.models._released import RELEASED_CONFIG, load_released, save_released
from kmn_jax.models._verifier import (
    VERIFIER,
    VERIFIER_CHANNELS,
    PoseVerifier,
    Verifier,
    create_verifier,
    load_verifier,
    save_verifier,
    verify,
)
from kmn_jax.models._weights import PRETRAINED, is_model_file, load_model, load_pretrained, released_file, save_model

__all__ = [
    "LATER_PAIR_CHANNELS",
    "OBJECT_CHANNELS",
    "PAIR_CHANNELS",
    "PRETRAINED",
    "RELEASED_CONFIG",
    "SCENE_CHANNELS",
    "VERIFIER",
    "VERIFIER_CHANNELS",
    "Compute",
    "KeyMatchNet",
    "KeyMatchNetConfig",
    "LossConfig",
    "MatchingLoss",
    "Model",
    "ObjectFeatures",
    "PoseVerifier",
    "Verifier",
    "create_model",
    "create_verifier",
    "encode_object",
    "encode_scene",
    "is_model_file",
    "keypoint_labels",
    "load_model",
    "load_pretrained",
    "load_released",
    "load_verifier",
    "match",
    "matching_loss",
    "model_structure",
    "released_file",
    "released_object",
    "released_scene",
    "save_model",
    "save_released",
    "save_verifier",
    "spread_labels",
    "verify",
    "with_chiral_inputs",
]
