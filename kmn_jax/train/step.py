"""The training and evaluation steps: pure functions of state, pack and the indices of a batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from kmn_jax.checks import InputError
from kmn_jax.data.device_pack import DevicePack
from kmn_jax.data.pipeline import SampleIndex
from kmn_jax.models import KeyMatchNetConfig, LossConfig, create_model, matching_loss
from kmn_jax.models.losses import MatchingLoss
from kmn_jax.train.examples import ExampleConfig, Group, make_group
from kmn_jax.typing import PRNGKey


@dataclass(frozen=True)
class StepConfig:
    """What a step computes, all of it static under jit."""

    network: KeyMatchNetConfig
    examples: ExampleConfig
    loss: LossConfig
    crops_per_object: int  # consecutive samples of a batch that share an object, and its encoding
    groups_at_once: int | None  # groups that are computed side by side, the rest one after the other; None: all
    average_decay: float  # of the running mean of the parameters, which is what is evaluated and shipped
    seed: int

    def __post_init__(self) -> None:
        if not 0 <= self.average_decay < 1:
            raise InputError(f"average_decay = {self.average_decay} must be at least 0 and below 1")


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


# Parameters, pack, batch and a dropout key for each of its groups -> gradient and sums.
SumGradients: TypeAlias = Callable[[nnx.State, DevicePack, SampleIndex, Array], tuple[nnx.State, Sums]]


def create_state(config: StepConfig, optimizer: optax.GradientTransformation) -> tuple[nnx.GraphDef, TrainState]:
    """Return the network's structure and the state before the first step."""
    graphdef, parameters = create_model(config.network, jax.random.key(config.seed))
    state = TrainState(jnp.int32(0), parameters, jax.tree.map(jnp.copy, parameters), optimizer.init(parameters))
    return graphdef, state


def train_step(
    graphdef: nnx.GraphDef,
    optimizer: optax.GradientTransformation,
    config: StepConfig,
    state: TrainState,
    pack: DevicePack,
    index: SampleIndex,
    number: Int[Array, ""] | None = None,
    spread: Callable[[SumGradients], SumGradients] = lambda function: function,
) -> tuple[TrainState, Metrics]:
    """Make the examples of a batch, and change the parameters by the gradient of their mean loss.

    If loss or gradient are not finite, the state stays what it was, its step too. With `number`, the step that this is
    meant to be, it also stays in all later steps: what is kept is the state before the first one that failed.
    `spread` may have the sums over the batch computed by several devices.
    """
    groups = index.object.shape[0] // config.crops_per_object
    dropout = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), state.step), groups)
    grads, sums = spread(partial(sum_gradients, graphdef, config))(state.parameters, pack, index, dropout)
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
    index: SampleIndex,
    dropout: Key[Array, " groups"],
) -> tuple[nnx.State, Sums]:
    """Return the gradient of the summed loss of a batch, and the sums, with one dropout key for each group."""

    def summed(parameters: nnx.State, chunk: _Chunk) -> tuple[Float[Array, ""], Sums]:
        sums = _chunk_sums(graphdef, parameters, config, pack, chunk)
        return sums.loss, sums

    gradient = jax.grad(summed, has_aux=True)
    chunks = _chunks(index, dropout, config)
    if jax.tree.leaves(chunks)[0].shape[0] == 1:
        only: tuple[nnx.State, Sums] = gradient(parameters, jax.tree.map(lambda leaf: leaf[0], chunks))
        return only

    def add(carry: tuple[nnx.State, Sums], chunk: _Chunk) -> tuple[tuple[nnx.State, Sums], None]:
        return jax.tree.map(jnp.add, carry, gradient(parameters, chunk)), None

    zeros = (jax.tree.map(jnp.zeros_like, parameters), Sums(*(jnp.float32(0),) * len(Sums._fields)))
    return jax.lax.scan(add, zeros, chunks)[0]


def eval_step(
    graphdef: nnx.GraphDef, config: StepConfig, parameters: nnx.State, pack: DevicePack, index: SampleIndex
) -> Sums:
    """Return the sums of losses and accuracies over a batch of examples without augmentation or dropout.

    Sums of several batches are added; `mean_metrics` makes means of them.
    """
    chunks = _chunks(index, None, config)
    sums = jax.lax.map(lambda chunk: _chunk_sums(graphdef, parameters, config, pack, chunk, False), chunks)
    return jax.tree.map(lambda leaf: leaf.sum(), sums)


class _Chunk(NamedTuple):
    """Groups that are computed side by side: c of them, g samples each."""

    row: Int[Array, " c"]
    drops: Int[Array, "c g"]
    keys: UInt32[Array, "c g 2"]
    counted: Bool[Array, "c g"]
    dropout: PRNGKey | None


def _chunks(index: SampleIndex, dropout: Key[Array, " groups"] | None, config: StepConfig) -> _Chunk:
    """Split a batch into groups, and those into chunks along a new first axis."""
    size = index.object.shape[0]
    groups = size // config.crops_per_object
    at_once = config.groups_at_once or groups
    if size % config.crops_per_object or groups % at_once:
        raise InputError(
            f"a batch of {size} must hold whole chunks of {at_once} groups of crops_per_object ="
            f" {config.crops_per_object}"
        )
    shape = (groups // at_once, at_once, config.crops_per_object)
    rows, drops, counted = (jnp.asarray(array).reshape(shape) for array in (index.object, index.drop, index.mask))
    keys = jnp.asarray(index.key).reshape(*shape, 2)
    return _Chunk(rows[..., 0], drops, keys, counted, None if dropout is None else dropout.reshape(shape[:2]))


def _chunk_sums(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    config: StepConfig,
    pack: DevicePack,
    chunk: _Chunk,
    train: bool = True,
) -> Sums:
    network = nnx.merge(graphdef, parameters)
    examples = config.examples if train else config.examples.plain()
    groups = jax.lax.stop_gradient(
        jax.vmap(lambda row, drops, keys: make_group(pack, row, drops, keys, config.network, examples))(
            chunk.row, chunk.drops, chunk.keys
        )
    )

    def losses(group: Group, key: PRNGKey | None) -> MatchingLoss:
        object_key, crops_key = (None, None) if key is None else jax.random.split(key)
        features = network.encode_object(group.cloud, group.keypoint_indices, group.length, object_key)
        keys = None if crops_key is None else jax.random.split(crops_key, group.crops.shape[0])

        def one(crop, mask, is_object, keypoint, head_key):  # type: ignore[no-untyped-def]
            scene = network.encode_scene(crop, group.length, mask)
            segmentation, keypoints = network.match(scene, features, mask, head_key)
            return matching_loss(segmentation, keypoints, is_object, keypoint, mask, config.loss)

        return jax.vmap(one)(group.crops, group.mask, group.is_object, group.keypoint, keys)

    result = jax.vmap(losses)(groups, chunk.dropout)
    weight = (groups.valid & chunk.counted).astype(jnp.float32)
    points, object_points = (
        weight * count.astype(jnp.float32) for count in (result.num_points, result.num_object_points)
    )
    return Sums(
        loss=(weight * result.total).sum(),
        segmentation_loss=(weight * result.segmentation).sum(),
        keypoint_loss=(weight * result.keypoint).sum(),
        segmentation_right=(points * result.segmentation_accuracy).sum(),
        keypoint_right=(object_points * result.keypoint_accuracy).sum(),
        points=points.sum(),
        object_points=object_points.sum(),
        num_crops=weight.sum(),
    )


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
