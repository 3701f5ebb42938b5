"""The training and evaluation steps: pure functions of state, pack and the indices of a batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from kmn_jax.data import DevicePack, SampleIndex
from kmn_jax.errors import InputError
from kmn_jax.models import KeyMatchNetConfig, LossConfig, MatchingLoss, create_model, matching_loss, spread_labels
from kmn_jax.train._examples import ExampleConfig, Group, RenderedCrops, make_group
from kmn_jax.typing import PRNGKey


@dataclass(frozen=True)
class StepConfig:
    """What a step computes, all of it static under jit."""

    network: KeyMatchNetConfig
    examples: ExampleConfig
    loss: LossConfig
    crops_per_object: int  # consecutive samples of a batch that share an object, and its encoding
    crops_at_once: int | None  # that a device computes side by side, the rest one after the other; None: all
    average_decay: float  # of the running mean of the parameters, which is what is evaluated and shipped
    random_seed: int

    def __post_init__(self) -> None:
        if not 0 <= self.average_decay < 1:
            raise InputError(f"average_decay = {self.average_decay} must be at least 0 and below 1")


class RenderedSamples(NamedTuple):
    """Samples whose crops were made before: what a step takes instead of the indices of a pack's scenes."""

    samples: SampleIndex
    crops: RenderedCrops


Samples: TypeAlias = SampleIndex | RenderedSamples


class TrainState(NamedTuple):
    """All that a run changes from step to step."""

    step: Int[Array, ""]
    parameters: nnx.State
    average: nnx.State  # running mean of the parameters
    optimizer: optax.OptState


class Metrics(NamedTuple):
    """Means over the valid crops of a batch, and how many there were; of a training step also what it did."""

    loss: Float[Array, ""]
    segmentation_loss: Float[Array, ""]
    keypoint_loss: Float[Array, ""]
    segmentation_accuracy: Float[Array, ""]
    keypoint_accuracy: Float[Array, ""]  # over object points of all crops
    num_crops: Float[Array, ""]
    gradient_norm: Float[Array, ""] | None = None
    taken: Bool[Array, ""] | None = None  # false if the state was left as it was


class Sums(NamedTuple):
    """Sums over valid crops, or over their points."""

    loss: Float[Array, ""]
    segmentation_loss: Float[Array, ""]
    keypoint_loss: Float[Array, ""]
    segmentation_right: Float[Array, ""]
    keypoint_right: Float[Array, ""]
    points: Float[Array, ""]
    object_points: Float[Array, ""]
    num_crops: Float[Array, ""]


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

# Parameters, pack, batch and a dropout key for each of its groups -> gradient and sums.
SumGradients: TypeAlias = Callable[[nnx.State, DevicePack, Samples, Array], tuple[nnx.State, Sums]]


def create_state(
    config: StepConfig, optimizer: optax.GradientTransformation, parameters: nnx.State | None = None
) -> tuple[nnx.GraphDef, TrainState]:
    """Return the network's structure and the state before the first step, with random parameters unless given."""
    graphdef, drawn = create_model(config.network, jax.random.key(config.random_seed))
    parameters = drawn if parameters is None else parameters
    state = TrainState(jnp.int32(0), parameters, jax.tree.map(jnp.copy, parameters), optimizer.init(parameters))
    return graphdef, state


def train_step(
    graphdef: nnx.GraphDef,
    optimizer: optax.GradientTransformation,
    config: StepConfig,
    state: TrainState,
    pack: DevicePack,
    samples: Samples,
    number: Int[Array, ""] | None = None,
    spread: Callable[[SumGradients], SumGradients] = lambda function: function,
) -> tuple[TrainState, Metrics]:
    """Make the examples of a batch, and change the parameters by the gradient of their mean loss.

    If loss or gradient are not finite, the state stays what it was, its step too. With `number`, the step that this is
    meant to be, it also stays in all later steps: what is kept is the state before the first one that failed.
    `spread` may have the sums over the batch computed by several devices.
    """
    groups = index_of(samples).object.shape[0] // config.crops_per_object
    dropout = jax.random.split(jax.random.fold_in(jax.random.key(config.random_seed), state.step), groups)
    grads, sums = spread(partial(sum_gradients, graphdef, config))(state.parameters, pack, samples, dropout)
    count = jnp.maximum(sums.num_crops, 1)
    grads = jax.tree.map(lambda leaf: leaf / count, grads)
    norm = optax.tree.norm(grads)
    taken = jnp.isfinite(sums.loss) & jnp.isfinite(norm)
    if number is not None:
        taken &= state.step == number
    updates, moments = optimizer.update(grads, state.optimizer, state.parameters)
    parameters = optax.apply_updates(state.parameters, updates)
    # The running mean starts as a plain one: early parameters should not linger.
    steps = state.step.astype(jnp.float32) + 1
    decay = jnp.minimum(config.average_decay, steps / (steps + 10))
    average = jax.tree.map(lambda old, new: decay * old + (1 - decay) * new, state.average, parameters)
    changed = TrainState(state.step + 1, parameters, average, moments)
    result = jax.tree.map(lambda new, old: jnp.where(taken, new, old), changed, state)
    return result, mean_metrics(sums)._replace(gradient_norm=norm, taken=taken)


def sum_gradients(
    graphdef: nnx.GraphDef,
    config: StepConfig,
    parameters: nnx.State,
    pack: DevicePack,
    samples: Samples,
    dropout: Key[Array, " groups"],
) -> tuple[nnx.State, Sums]:
    """Return the gradient of the summed loss of a batch, and the sums, with one dropout key for each group.

    Gradients are summed up part by part, in both directions before the next one: nothing of a part need be kept, and
    its arrays stay in a CPU's cache.
    """

    def of_chunk(chunk: _Chunk) -> tuple[nnx.State, Sums]:
        groups = _make(pack, chunk, config, config.examples)
        object_keys, crop_keys = _dropout_keys(chunk.dropout, config.crops_per_object)
        shares = _label_shares(groups, config.loss)

        def encode(parameters: nnx.State) -> Float[Array, "c k o"]:
            return _encode_objects(graphdef, parameters, groups, object_keys)

        def summed(
            parameters: nnx.State, features: Float[Array, "c k o"], part: _Part
        ) -> tuple[Float[Array, ""], Sums]:
            sums = _part_sums(graphdef, parameters, config.loss, features, groups.length, part, shares)
            return sums.loss, sums

        features, pull = jax.vjp(encode, parameters)
        gradient = jax.grad(summed, argnums=(0, 1), has_aux=True)
        (own, of_features), sums = _summed(
            lambda part: gradient(parameters, features, part), _parts(groups, chunk, crop_keys, config)
        )
        return jax.tree.map(jnp.add, own, pull(of_features)[0]), sums

    return _summed(of_chunk, _chunks(samples, dropout, config))


def eval_step(
    graphdef: nnx.GraphDef, config: StepConfig, parameters: nnx.State, pack: DevicePack, samples: Samples
) -> Sums:
    """Return the sums of losses and accuracies over a batch of examples without augmentation or dropout.

    Sums of several batches are added; `mean_metrics` makes means of them.
    """

    def of_chunk(chunk: _Chunk) -> Sums:
        groups = _make(pack, chunk, config, config.examples.plain())
        features = _encode_objects(graphdef, parameters, groups, None)
        return _summed(
            lambda part: _part_sums(graphdef, parameters, config.loss, features, groups.length, part),
            _parts(groups, chunk, None, config),
        )

    return _summed(of_chunk, _chunks(samples, None, config))


def make_samples(config: StepConfig, pack: DevicePack, samples: Samples) -> Group:
    """Return the examples of a batch as a training step makes them, with leading axes for chunks and their groups."""
    return jax.lax.map(lambda chunk: _make(pack, chunk, config, config.examples), _chunks(samples, None, config))


class _Chunk(NamedTuple):
    """Groups that are computed side by side: c of them, g samples each."""

    which: SampleIndex  # (c, g) in place of (b,)
    rendered: RenderedCrops | None
    dropout: PRNGKey | None


class _Part(NamedTuple):
    """Crops that are computed side by side: p of each of c groups."""

    crops: Float[Array, "c p n 6"]
    mask: Bool[Array, "c p n"]
    is_object: Bool[Array, "c p n"]
    keypoint: Int[Array, "c p n"]
    weight: Float[Array, "c p"]
    dropout: PRNGKey | None


def _chunks(samples: Samples, dropout: Key[Array, " groups"] | None, config: StepConfig) -> _Chunk:
    """Split a batch into groups, and those into chunks along a new first axis."""
    index, each = index_of(samples), config.crops_per_object
    size = index.object.shape[0]
    groups = size // each
    at_once = max(1, config.crops_at_once // each) if config.crops_at_once else groups
    if size % each or groups % at_once:
        raise InputError(f"a batch of {size} must hold whole chunks of {at_once} groups of crops_per_object = {each}")
    shape = (groups // at_once, at_once, each)
    rendered = samples.crops if isinstance(samples, RenderedSamples) else None
    index, rendered = jax.tree.map(lambda leaf: jnp.asarray(leaf).reshape(*shape, *leaf.shape[1:]), (index, rendered))
    return _Chunk(index, rendered, None if dropout is None else dropout.reshape(shape[:2]))


def index_of(samples: Samples) -> SampleIndex:
    """Return which samples they are."""
    return samples.samples if isinstance(samples, RenderedSamples) else samples


def _make(pack: DevicePack, chunk: _Chunk, config: StepConfig, examples: ExampleConfig) -> Group:
    """Make the examples of a chunk."""

    def one(
        row: Int[Array, ""], drops: Int[Array, " g"], keys: UInt32[Array, "g 2"], rendered: RenderedCrops | None
    ) -> Group:
        return make_group(pack, row, drops, keys, config.network, examples, rendered)

    rows, drops, keys = (jnp.asarray(array) for array in chunk.which[:3])
    return jax.lax.stop_gradient(jax.vmap(one)(rows[:, 0], drops, keys, chunk.rendered))


def _dropout_keys(
    keys: Key[Array, " c"] | None, crops: int
) -> tuple[Key[Array, " c"] | None, Key[Array, "c g"] | None]:
    """Return a key for each group's object and for each of its crops."""
    if keys is None:
        return None, None
    pairs = jax.vmap(jax.random.split)(keys)
    return pairs[:, 0], jax.vmap(lambda key: jax.random.split(key, crops))(pairs[:, 1])


def _parts(groups: Group, chunk: _Chunk, keys: Key[Array, "c g"] | None, config: StepConfig) -> _Part:
    """Split the crops of a chunk's groups into parts along a new first axis."""
    each = config.crops_per_object
    at_once = min(config.crops_at_once or each, each)
    weight = (groups.valid & chunk.which.mask).astype(jnp.float32)
    whole = _Part(groups.crops, groups.mask, groups.is_object, groups.keypoint, weight, keys)

    def split(array: Array) -> Array:
        return jnp.moveaxis(array.reshape(array.shape[0], each // at_once, at_once, *array.shape[2:]), 1, 0)

    return jax.tree.map(split, whole)


def _encode_objects(
    graphdef: nnx.GraphDef, parameters: nnx.State, groups: Group, keys: Key[Array, " c"] | None
) -> Float[Array, "c k o"]:
    network = nnx.merge(graphdef, parameters)
    return jax.vmap(network.encode_object)(groups.cloud, groups.keypoint_indices, groups.length, keys)


def _label_shares(groups: Group, config: LossConfig) -> Float[Array, "c k k"] | None:
    """Return which shares keypoints have in each other as labels; None if each label is one of them."""
    if config.keypoint_spread == 0:
        return None

    def of_group(
        cloud: Float[Array, "m 6"], indices: Int[Array, " k"], length: Float[Array, ""]
    ) -> Float[Array, "k k"]:
        return spread_labels(cloud[indices, :3] / length, config.keypoint_spread)

    return jax.vmap(of_group)(groups.cloud, groups.keypoint_indices, groups.length)


def _part_sums(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    config: LossConfig,
    features: Float[Array, "c k o"],
    lengths: Float[Array, " c"],
    part: _Part,
    shares: Float[Array, "c k k"] | None = None,
) -> Sums:
    network = nnx.merge(graphdef, parameters)
    # Crops that do not count may have no points, of which a maximum and its gradient are not finite: their padding is
    # taken for points.
    part = part._replace(mask=part.mask | (part.weight == 0)[..., None])

    def of_group(
        features: Float[Array, "k o"], length: Float[Array, ""], part: _Part, shares: Float[Array, "k k"] | None
    ) -> MatchingLoss:
        def one(crop, mask, is_object, keypoint, key):  # type: ignore[no-untyped-def]
            scene = network.encode_scene(crop, length, mask)
            segmentation, keypoints = network.match(scene, features, mask, key)
            return matching_loss(segmentation, keypoints, is_object, keypoint, mask, config, shares)

        return jax.vmap(one)(part.crops, part.mask, part.is_object, part.keypoint, part.dropout)

    result = jax.vmap(of_group)(features, lengths, part, shares)
    points, object_points = (
        part.weight * count.astype(jnp.float32) for count in (result.num_points, result.num_object_points)
    )
    return Sums(
        loss=(part.weight * result.total).sum(),
        segmentation_loss=(part.weight * result.segmentation).sum(),
        keypoint_loss=(part.weight * result.keypoint).sum(),
        segmentation_right=(points * result.segmentation_accuracy).sum(),
        keypoint_right=(object_points * result.keypoint_accuracy).sum(),
        points=points.sum(),
        object_points=object_points.sum(),
        num_crops=part.weight.sum(),
    )


def _summed(function: Callable[[_Item], _Result], items: _Item) -> _Result:
    """Return the sum of what a function gives for each entry along the items' first axis, one after the other."""
    first = jax.tree.map(lambda leaf: leaf[0], items)
    if jax.tree.leaves(items)[0].shape[0] == 1:
        return function(first)

    def add(total: _Result, item: _Item) -> tuple[_Result, None]:
        return jax.tree.map(jnp.add, total, function(item)), None

    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(function, first))
    return jax.lax.scan(add, zeros, items)[0]


def total_sums(parts: Sequence[Sums]) -> Sums:
    """Return the sum of the sums of several batches, added up on the host in float64."""
    return jax.tree.map(lambda *values: jnp.float32(np.sum(values, dtype=np.float64)), *parts)


def mean_metrics(sums: Sums) -> Metrics:
    """Return the means that sums over one or several batches stand for."""
    crops = jnp.maximum(sums.num_crops, 1)
    return Metrics(
        loss=sums.loss / crops,
        segmentation_loss=sums.segmentation_loss / crops,
        keypoint_loss=sums.keypoint_loss / crops,
        segmentation_accuracy=sums.segmentation_right / jnp.maximum(sums.points, 1),
        keypoint_accuracy=sums.keypoint_right / jnp.maximum(sums.object_points, 1),
        num_crops=sums.num_crops,
    )
