"""The data of a run: training and validation objects, on the devices, and the order of their samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jax
import numpy as np
from flax import nnx
from jax.sharding import Mesh
from jaxtyping import Int32

from kmn_jax.data import DevicePack, Pack, PipelineConfig, SampleBatches, SampleIndex, stack_pack
from kmn_jax.errors import InputError
from kmn_jax.models import KeyMatchNetConfig, load_model, load_pretrained, with_chiral_inputs
from kmn_jax.train._config import TrainConfig
from kmn_jax.train._records import what_differs
from kmn_jax.train._rendered import rendered_frames
from kmn_jax.train._sharding import put_whole
from kmn_jax.train._step import Samples

Report = Callable[[str], None]  # is given one sentence for each object or image that is left out

_WITHOUT_PARAMETERS = (
    "num_scene_points",
    "num_object_points",
    "num_keypoints",
    "num_neighbors",
    "graph",
    "dropout",
    "pair_dropout",
    "compute",
)
_VALIDATION_SEED = 0  # of the samples, so that runs of all seeds are validated on the same


@dataclass(frozen=True)
class Source:
    """Objects and batches of their samples, of which each process has its share."""

    pack: DevicePack
    names: tuple[str, ...]
    digest: str
    batches: SampleBatches
    read: Callable[[SampleIndex], Samples] | None = None  # makes a batch on the host, if the steps do not


def ignore(message: str) -> None:
    """Report nothing."""


def training_source(config: TrainConfig, mesh: Mesh, report: Report = ignore) -> Source:
    """Return the training objects, or the configured share of them, and their endless samples.

    What is left out goes to `report`, of images also while they are read.
    """
    if config.rendered is not None:
        frames = rendered_frames(config.rendered, config.rendered_split, config.network, config.examples.crops, report)
        batches = _own_batches(config.pipeline, frames.num_frames, 1)
        return Source(put_whole(frames.pack, mesh), frames.names, frames.digest, batches, frames.read)
    pack = Pack(config.pack)
    names = pack.names("train")
    count = max(1, round(config.training_share * len(names)))
    chosen = [names[row * len(names) // count] for row in range(min(count, len(names)))]
    return _packed_source(config, pack, chosen if names else "train", config.pipeline, mesh, report)


def validation_source(config: TrainConfig, mesh: Mesh, report: Report = ignore) -> Source:
    """Return the validation objects and their fixed samples, in order, as one pass; see `training_source`."""
    pipeline = replace(config.pipeline, samples_per_object=config.validation_samples, random_seed=_VALIDATION_SEED)
    return _packed_source(config, Pack(config.pack), "validation", pipeline, mesh, report, ordered=True)


def trained_network(config: TrainConfig) -> KeyMatchNetConfig:
    """Return the network's config as it is saved: one of learned features knows the CAD file of its object.

    Raises InputError if such a network is to be trained with more than one object.
    """
    if config.network.object_branch == "cad" or config.rendered is not None:
        return config.network
    pack = Pack(config.pack)
    digests = {pack.load(name, visibility=False).digest for name in pack.names()}
    if len(digests) != 1:
        raise InputError(
            f"the pack {config.pack} holds {len(digests)} objects, but a network with learned features is of one"
        )
    return replace(config.network, object_digest=digests.pop())


def warm_parameters(config: TrainConfig) -> nnx.State | None:
    """Return the parameters to begin with, if a warm start is configured.

    Raises InputError if the weights cannot be read or are of another network than the config's.
    """
    if config.warm_start is None:
        return None
    known = Path(config.warm_start).suffix == ".safetensors"
    model = load_model(config.warm_start) if known else load_pretrained(config.warm_start)
    if config.network.inputs == "chiral" and model.config.inputs == "invariant":
        model = with_chiral_inputs(model)
    own = trained_network(config)
    theirs = _fitted_to(own, model.config)
    if theirs != own:
        raise InputError(
            f"warm_start = {config.warm_start} is a network with {what_differs(asdict(theirs), asdict(own))}:"
            " choose the same, or leave it out"
        )
    return model.parameters


def _fitted_to(other: KeyMatchNetConfig, config: KeyMatchNetConfig) -> KeyMatchNetConfig:
    """Return a network's config with what of another's has no parameters, so that its own fit both."""
    changed = {name: getattr(other, name) for name in _WITHOUT_PARAMETERS}
    if config.object_branch == "learned":  # it has parameters for each keypoint
        del changed["num_keypoints"]
    return replace(config, **changed)


def _packed_source(
    config: TrainConfig,
    pack: Pack,
    objects: str | list[str],
    pipeline: PipelineConfig,
    mesh: Mesh,
    report: Report,
    ordered: bool = False,
) -> Source:
    worlds = config.examples.worlds is not None
    stacked = stack_pack(pack, objects, config.examples.visibility == "bits", scenes=not worlds)
    arrays, needed = stacked.arrays, config.network.num_object_points
    if arrays.points.shape[1] < needed:  # before anything is written: steps could not be compiled
        raise InputError(
            f"the pack {config.pack} has {arrays.points.shape[1]} surfels an object, but network.num_object_points ="
            f" {needed}: choose fewer, or build a pack with more"
        )
    for problem in stacked.problems:
        report(problem)
    batches = _own_batches(pipeline, len(stacked.names), 1 if worlds else np.asarray(arrays.num_drops), ordered)
    return Source(put_whole(arrays, mesh), stacked.names, stacked.digest, batches)


def _own_batches(
    pipeline: PipelineConfig, count: int, num_drops: int | Int32[np.ndarray, " o"], ordered: bool = False
) -> SampleBatches:
    return SampleBatches(pipeline, count, num_drops, jax.process_index(), jax.process_count(), ordered)
