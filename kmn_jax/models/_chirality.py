"""From a network that is blind to mirror images to one of the same answers that can learn to tell them apart."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from kmn_jax.errors import InputError
from kmn_jax.models._invariants import LATER_PAIR_CHANNELS, OBJECT_CHANNELS, PAIR_CHANNELS, SCENE_CHANNELS
from kmn_jax.models._keymatchnet import Model, model_structure


def with_chiral_inputs(model: Model) -> Model:
    """Return a network of "chiral" inputs that answers as one of "invariant" inputs does, to go on training it.

    The new inputs are multiplied by zeros. Raises InputError for a network of other inputs, of learned features, or
    with a coarse level.
    """
    config = model.config
    if config.inputs != "invariant" or config.object_branch != "cad":
        raise InputError(
            f'a network of "{config.inputs}" inputs and a "{config.object_branch}" object branch cannot be given'
            ' chiral inputs: only one of "invariant" inputs and CAD features can'
        )
    if config.num_coarse_points:
        raise InputError(
            "a network with a coarse level cannot be given chiral inputs: train one from random parameters"
        )
    grown = model_structure(replace(config, inputs="chiral"))
    parameters = nnx.to_pure_dict(model.parameters)
    added = PAIR_CHANNELS["chiral"] - PAIR_CHANNELS["invariant"]
    for branch, channels in (("scene", SCENE_CHANNELS), ("object", OBJECT_CHANNELS)):
        first, second = (parameters[branch][edge]["first"] for edge in ("edge1", "edge2"))
        points, more = channels["invariant"], channels["chiral"] - channels["invariant"]
        first["kernel"] = _with_rows(first["kernel"], {points: more, 2 * points: more, len(first["kernel"]): added})
        second["kernel"] = _with_rows(second["kernel"], {len(second["kernel"]): LATER_PAIR_CHANNELS["chiral"]})
    state = grown.parameters
    nnx.replace_by_pure_dict(state, parameters)
    return Model(grown.graphdef, state)


def _with_rows(kernel: Float[Array, "i o"], added: dict[int, int]) -> Float[Array, "j o"]:
    """Return a kernel with so many rows of zeros before each of these rows."""
    bounds = [0, *added, len(kernel)]
    pieces = [kernel[start:end] for start, end in pairwise(bounds)]
    zeros = [jnp.zeros((count, kernel.shape[1]), kernel.dtype) for count in (*added.values(), 0)]
    return jnp.concatenate([piece for pair in zip(pieces, zeros, strict=True) for piece in pair])
