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
)

__all__ = [
    "KeyMatchNet",
    "KeyMatchNetConfig",
    "Model",
    "ObjectFeatures",
    "create_model",
    "encode_object",
    "encode_scene",
    "match",
]
