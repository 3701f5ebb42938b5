"""KeyMatchNet (arXiv 2303.16102): the network and its three pure entry points.

`encode_object` once per object, `encode_scene` once per crop, `match` for every pair of them. Frames: a crop
enters with its seed point at the origin, in the scene's axes; an object cloud in the object's frame.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.errors import InputError, float_array, index_array, is_traced, mask_array, positive_scalar, row_count
from kmn_jax.geometry import largest_distance
from kmn_jax.models._attention import Attention
from kmn_jax.models._config import KeyMatchNetConfig
from kmn_jax.models._encoder import Encoder
from kmn_jax.models._invariants import (
    OBJECT_CHANNELS,
    SCENE_CHANNELS,
    object_invariants,
    raw_inputs,
    scene_invariants,
)
from kmn_jax.models._layers import NormalizedLinear, dropout
from kmn_jax.models._normalization import metric_object, metric_scene, released_object, released_scene
from kmn_jax.models._pair_head import PairHead
from kmn_jax.programs import kept
from kmn_jax.typing import ArrayInput

_LARGEST = 1e18  # a length whose square, summed over three axes, still fits float32


class Model(NamedTuple):
    """A network as data: its structure (static, hashable) and its parameters (a pytree of arrays)."""

    graphdef: nnx.GraphDef
    parameters: nnx.State

    @property
    def config(self) -> KeyMatchNetConfig:
        """The config that the network was built from."""
        return nnx.merge(*self).config

    def under(self, config: KeyMatchNetConfig) -> Model:
        """Return the same parameters in a network of another config, on which their shapes must not depend."""
        return Model(model_structure(config).graphdef, self.parameters)


ModelPair: TypeAlias = tuple[nnx.GraphDef, nnx.State] | Any  # judged at the edge, like arrays


class ObjectFeatures(NamedTuple):
    """What `match` needs of an object, computed once and reused.

    Attributes:
        features: (K, object_width), one row per keypoint.
        keypoints: (K, 6), the keypoints and their normals, in the object's frame and the cloud's unit.
        length: the length that the object was divided by, in the cloud's unit ("released" ignores it).
    """

    features: Float[Array, "k o"]
    keypoints: Float[Array, "k 6"]
    length: Float[Array, ""]


class KeyMatchNet(nnx.Module):
    """The network of one scene crop and one object. Stateless: dropout keys are arguments."""

    def __init__(self, config: KeyMatchNetConfig, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.scene = Encoder(config, SCENE_CHANNELS[config.inputs], coarse=config.num_coarse_points > 0, rngs=rngs)
        if config.object_branch == "cad":
            self.object = Encoder(config, OBJECT_CHANNELS[config.inputs], rngs=rngs)
            self.object_out = NormalizedLinear(config.scene_width, config.object_width, config.groups, rngs=rngs)
        else:
            shape = config.num_keypoints, config.object_width
            self.keypoints = nnx.Param(jax.random.normal(rngs.params(), shape, jnp.float32))
        self.head = PairHead(config.scene_width, config.object_width, config.pair_width, config.groups, rngs=rngs)
        own, other = config.scene_width, config.object_width
        self.to_object = Attention(own, other, other, config.groups, rngs=rngs) if config.attention == "both" else None

    def encode_object(
        self,
        cloud: Float[Array, "m 6"],
        keypoint_indices: Int[Array, " k"],
        length: Float[Array, ""],
        key: jax.Array | None = None,
    ) -> Float[Array, "k o"]:
        """Return one feature per keypoint. With a key, dropout acts before and after the last layer.

        A network of one object has features of its own, for as many keypoints as it was made with, whatever the cloud.
        """
        config = self.config
        if config.object_branch == "learned":
            if keypoint_indices.shape[0] != config.num_keypoints:
                raise InputError(
                    f"{keypoint_indices.shape[0]} keypoints given, but this network was trained for one object and its"
                    f" {config.num_keypoints}"
                )
            return self.keypoints[...]
        if config.normalization == "released":
            inputs = raw_inputs(released_object(cloud))
        elif config.inputs == "raw":
            inputs = raw_inputs(metric_object(cloud, length))
        else:
            inputs = object_invariants(metric_object(cloud, length))
        before, after = (None, None) if key is None else jax.random.split(key)
        x = self.object(inputs, config.compute, None, keypoint_indices)
        x = dropout(x, config.dropout, before)
        return dropout(self.object_out(x, config.compute), config.dropout, after)

    def encode_scene(
        self, crop: Float[Array, "n 6"], length: Float[Array, ""], mask: Bool[Array, " n"] | None = None
    ) -> Float[Array, "n s"]:
        """Return one feature per point; padded rows are zero."""
        config = self.config
        if mask is not None:
            crop = jnp.where(mask[:, None], crop, 0)
        if config.normalization == "released":
            inputs = raw_inputs(released_scene(crop, mask))
        elif config.inputs == "raw":
            inputs = raw_inputs(metric_scene(crop, length))
        else:
            inputs = scene_invariants(metric_scene(crop, length), mask, config.inputs == "chiral")
        features = self.scene(inputs, config.compute, mask)
        return features if mask is None else jnp.where(mask[:, None], features, 0)

    def match(
        self,
        scene_features: Float[Array, "n s"],
        object_features: Float[Array, "k o"],
        mask: Bool[Array, " n"] | None = None,
        key: jax.Array | None = None,
    ) -> tuple[Float[Array, "n 2"], Float[Array, "n k"]]:
        """Return segmentation logits (class 1 = the seed's instance) and keypoint logits, in float32."""
        config = self.config
        if self.to_object is not None:
            scene_features = self.to_object(scene_features, object_features, config.compute, mask)
        return self.head(
            scene_features, object_features, config.compute, mask, config.dropout, config.pair_dropout, key
        )

    def __call__(
        self,
        crop: Float[Array, "n 6"],
        cloud: Float[Array, "m 6"],
        keypoint_indices: Int[Array, " k"],
        length: Float[Array, ""],
        mask: Bool[Array, " n"] | None = None,
        key: jax.Array | None = None,
    ) -> tuple[Float[Array, "n 2"], Float[Array, "n k"]]:
        """Return the logits of one crop and one object; the form that training differentiates."""
        object_key, head_key = (None, None) if key is None else jax.random.split(key)
        object_features = self.encode_object(cloud, keypoint_indices, length, object_key)
        return self.match(self.encode_scene(crop, length, mask), object_features, mask, head_key)


def create_model(config: KeyMatchNetConfig, key: jax.Array) -> Model:
    """Return a network with freshly drawn parameters (uniform, as the published code's layers start)."""
    return Model(*nnx.split(KeyMatchNet(config, rngs=nnx.Rngs(params=key))))


def model_structure(config: KeyMatchNetConfig) -> Model:
    """Return a network with shapes in place of parameters: what loaded arrays are put into."""
    return Model(*nnx.split(nnx.eval_shape(lambda: KeyMatchNet(config, rngs=nnx.Rngs(0)))))


def encode_object(
    model: ModelPair,
    object_cloud: ArrayInput,
    keypoint_indices: ArrayInput,
    length: ArrayInput | None = None,
) -> ObjectFeatures:
    """Encode an object once for all scenes.

    Args:
        model: the pair (graphdef, parameters).
        object_cloud: (M, 6) points and unit outward normals, in the object's frame, any unit.
        keypoint_indices: (K,) rows of the cloud that are its keypoints.
        length: the crops' radius, in the cloud's unit; None takes the object's diameter. "released" ignores it.

    Raises:
        InputError: wrong shapes, dtypes, values that are not finite, indices out of range, no extent.
    """
    cloud = _cloud_array(object_cloud, "object_cloud")
    indices = index_array(keypoint_indices, "keypoint_indices", None, cloud.shape[0])
    if indices.shape[0] < 1:
        raise InputError("keypoint_indices is empty: choose at least one keypoint")
    graphdef, parameters = _pair(model)
    _check_extent(jnp.ptp(cloud[:, :3], axis=0).max(), "object_cloud")
    length = _diameter(cloud[:, :3]) if length is None else positive_scalar(length, "length")
    return _encode_object(graphdef, parameters, cloud, indices, length.astype(jnp.float32))


def encode_scene(
    model: ModelPair,
    scene_crop: ArrayInput,
    length: ArrayInput | None = None,
    mask: ArrayInput | None = None,
) -> Float[Array, "n s"]:
    """Encode a scene crop once for all objects that are encoded with the same length.

    Args:
        model: the pair (graphdef, parameters).
        scene_crop: (N, 6) points and unit normals towards the camera, with the seed point at the origin.
        length: the crop's radius, in the crop's unit; None takes the distance of the farthest point, which is
            the radius of a full crop. Give it where the object may end before the radius does. "released"
            ignores it.
        mask: (N,) true for real points; None means all.

    Returns:
        (N, scene_width). Padded rows are zero, which is how `match` knows them.

    Raises:
        InputError: wrong shapes, dtypes, values that are not finite, fewer than one real point, no extent.
    """
    given = None if mask is None else mask_array(mask, "mask", row_count(scene_crop, "scene_crop"))
    crop = _cloud_array(scene_crop, "scene_crop", given)
    if given is not None and not is_traced(given) and not bool(given.any()):
        raise InputError("mask is all false: scene_crop has no real point")
    graphdef, parameters = _pair(model)
    radius = _crop_radius(crop, given)
    _check_extent(radius, "scene_crop")
    length = radius if length is None else positive_scalar(length, "length")
    return _encode_scene(graphdef, parameters, crop, length.astype(jnp.float32), given)


def match(
    model: ModelPair,
    scene_features: ArrayInput,
    object_features: ObjectFeatures | Any,
) -> tuple[Float[Array, "n 2"], Float[Array, "n k"]]:
    """Match an encoded crop with an encoded object.

    Args:
        model: the pair (graphdef, parameters).
        scene_features: (N, scene_width) from `encode_scene`; rows of zeros are padding.
        object_features: from `encode_object`.

    Returns:
        Segmentation logits (N, 2), class 1 = on the same instance as the seed, and keypoint logits (N, K).
        Padded rows get certain background.

    Raises:
        InputError: shapes that do not belong together or values that are not finite.
    """
    graphdef, parameters = _pair(model)
    if not isinstance(object_features, ObjectFeatures):
        raise InputError(f"object_features is a {type(object_features).__name__}, but must come from encode_object")
    scene = float_array(scene_features, "scene_features", (None, None))
    keypoints = float_array(object_features.features, "object_features.features", (None, None))
    return _match(graphdef, parameters, scene, keypoints)


def _cloud_array(value: ArrayInput, name: str, mask: jax.Array | None = None) -> Float[Array, "n 6"]:
    """Return a cloud (n, 6) as float32. Raises InputError for another shape or dtype, or without any point."""
    cloud = float_array(value, name, (None, 6), mask=mask)
    if cloud.shape[0] == 0:
        raise InputError(f"{name} is empty: at least one point is needed")
    return cloud.astype(jnp.float32)


def _check_extent(extent: Float[Array, ""], name: str) -> None:
    """Raise InputError where a cloud has no extent, or one beyond float32; under a trace nothing is known."""
    if is_traced(extent):
        return
    if float(extent) == 0:
        raise InputError(f"{name} has no extent: all of its points coincide")
    if not float(extent) < _LARGEST:
        raise InputError(f"{name} is too large for float32: use a larger unit of length")


@kept("graphdef", results=(ObjectFeatures,))
def _encode_object(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    cloud: Float[Array, "m 6"],
    indices: Int[Array, " k"],
    length: Float[Array, ""],
) -> ObjectFeatures:
    features = nnx.merge(graphdef, parameters).encode_object(cloud, indices, length)
    return ObjectFeatures(features, cloud[indices], jnp.asarray(length, jnp.float32))


@partial(jax.jit, static_argnums=0)
def _encode_scene(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    crop: Float[Array, "n 6"],
    length: Float[Array, ""],
    mask: Bool[Array, " n"] | None,
) -> Float[Array, "n s"]:
    return nnx.merge(graphdef, parameters).encode_scene(crop, length, mask)


@partial(jax.jit, static_argnums=0)
def _match(
    graphdef: nnx.GraphDef, parameters: nnx.State, scene: Float[Array, "n s"], keypoints: Float[Array, "k o"]
) -> tuple[Float[Array, "n 2"], Float[Array, "n k"]]:
    network = nnx.merge(graphdef, parameters)
    widths, wanted = (scene.shape[1], keypoints.shape[1]), (network.config.scene_width, network.config.object_width)
    if widths != wanted:  # shapes are known while tracing
        raise InputError(
            f"scene and object features have widths {widths}, but this network's scene_width and object_width are"
            f" {wanted}: encode both with the same model"
        )
    mask = (scene != 0).any(axis=1)  # a real row of GroupNorm outputs is never zero in every channel
    return network.match(scene, keypoints, mask)


def _pair(model: Any) -> tuple[nnx.GraphDef, nnx.State]:
    if not isinstance(model, tuple) or len(model) != 2 or not isinstance(model[0], nnx.GraphDef):
        raise InputError(
            f"model is a {type(model).__name__}, but must be the pair (graphdef, parameters): see load_released,"
            " load_model and create_model"
        )
    return model


_diameter = jax.jit(largest_distance)


@jax.jit
def _crop_radius(crop: Float[Array, "n 6"], mask: Bool[Array, " n"] | None) -> Float[Array, ""]:
    distance = jnp.sqrt((crop[:, :3] ** 2).sum(axis=1))
    return (distance if mask is None else jnp.where(mask, distance, 0)).max()
