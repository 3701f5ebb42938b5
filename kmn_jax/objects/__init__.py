"""What there is to know of an object: its outer surface, symmetries, and the card that a search needs."""

from kmn_jax.objects._grasps import Grasp, Grasps, Gripper, load_grasps
from kmn_jax.objects._object_model import ObjectConfig, ObjectModel, load_object, object_from_cloud, object_from_mesh
from kmn_jax.objects._part import (
    CARD_SUFFIX,
    Part,
    PartArrays,
    arrays_of,
    load_part,
    make_part,
    model_digest,
    save_part,
)
from kmn_jax.objects._symmetry import Symmetries

__all__ = [
    "CARD_SUFFIX",
    "Grasp",
    "Grasps",
    "Gripper",
    "ObjectConfig",
    "ObjectModel",
    "Part",
    "PartArrays",
    "Symmetries",
    "arrays_of",
    "load_grasps",
    "load_object",
    "load_part",
    "make_part",
    "model_digest",
    "object_from_cloud",
    "object_from_mesh",
    "save_part",
]
