"""The pose verifier: a small network that looks at an object's picture at a pose beside what was measured there.

It is given the cells of one picture (`kmn_jax.detection.verifier_cells`) and nothing else, so that it serves any part,
sensor and network. What it says is one column of evidence among others: how probable a pose is, calibrations tell.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from kmn_jax.files import read_safetensors, write_whole
from kmn_jax.models._layers import dropout
from kmn_jax.models._weights import PRETRAINED, parameters_bytes, parameters_of
from kmn_jax.typing import Scalar

VERIFIER_CHANNELS = 11
VERIFIER = PRETRAINED / "verifier" / "cells.safetensors"  # whose evidence the released calibrations were fitted to
_LAYERS, _HIDDEN = ((32, 2), (32, 1), (64, 2), (96, 2)), 64  # channels and steps of convolutions, then one row
_DROPOUT = 0.3  # of what is pooled
_HIGHEST = jax.lax.Precision.HIGHEST


class Verifier(NamedTuple):
    """A verifier as data: its structure (static, hashable) and its parameters (a pytree of arrays)."""

    graphdef: nnx.GraphDef
    parameters: nnx.State


class _Affine(nnx.Module):
    """A linear map, or a convolution of a grid by 3 x 3 weights with steps of `stride` cells, plus a bias."""

    def __init__(self, shape: tuple[int, ...], stride: int = 1, *, rngs: nnx.Rngs) -> None:
        self.kernel = nnx.Param(nnx.initializers.he_normal()(rngs.params(), shape, jnp.float32))
        self.bias = nnx.Param(jnp.zeros(shape[-1], jnp.float32))
        self.stride = stride

    def of_row(self, x: Float[Array, " i"]) -> Float[Array, " o"]:
        return jnp.matmul(x, self.kernel[...], precision=_HIGHEST) + self.bias[...]

    def of_grid(self, x: Float[Array, "s s i"]) -> Float[Array, "t t o"]:
        found = jax.lax.conv_general_dilated(
            x[None],
            self.kernel[...],
            (self.stride, self.stride),
            "SAME",
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
            precision=_HIGHEST,
        )
        return found[0] + self.bias[...][None, None]


class PoseVerifier(nnx.Module):
    """Four convolutions, of which three halve the grid, then the mean and the maximum of all cells."""

    def __init__(self, *, rngs: nnx.Rngs) -> None:
        widths = VERIFIER_CHANNELS, *(width for width, _ in _LAYERS)
        self.convolutions = nnx.List(
            [
                _Affine((3, 3, *pair), stride, rngs=rngs)
                for pair, (_, stride) in zip(pairwise(widths), _LAYERS, strict=True)
            ]
        )
        self.hidden = _Affine((2 * widths[-1], _HIDDEN), rngs=rngs)
        self.out = _Affine((_HIDDEN, 1), rngs=rngs)

    def __call__(self, cells: Float[Array, "s s c"], key: jax.Array | None = None) -> Scalar:
        """Return the log odds that a pose is right, given the cells of its picture; with a key, there is dropout."""
        x = cells
        for layer in self.convolutions:
            x = jax.nn.relu(layer.of_grid(x))
        pooled = jnp.concatenate([x.mean(axis=(0, 1)), x.max(axis=(0, 1))])
        return self.out.of_row(jax.nn.relu(self.hidden.of_row(dropout(pooled, _DROPOUT, key))))[0]


def verify(
    graphdef: nnx.GraphDef, parameters: nnx.State, cells: Float[Array, "s s c"], key: jax.Array | None = None
) -> Scalar:
    """Return what the verifier of a structure and parameters says of cells, see `PoseVerifier`; pure, for one pose."""
    return nnx.merge(graphdef, parameters)(cells, key)


def create_verifier(key: jax.Array) -> Verifier:
    """Return a verifier with freshly drawn parameters."""
    return Verifier(*nnx.split(PoseVerifier(rngs=nnx.Rngs(params=key))))


def save_verifier(verifier: Verifier, path: str | Path) -> None:
    """Write the parameters to a .safetensors file."""
    write_whole(path, parameters_bytes(verifier.parameters, {}))


def load_verifier(path: str | Path = VERIFIER) -> Verifier:
    """Load what `save_verifier` wrote: what ships, unless a file is named. Raises InputError if it is no such file."""
    graphdef, shapes = nnx.split(nnx.eval_shape(lambda: PoseVerifier(rngs=nnx.Rngs(0))))
    return Verifier(graphdef, parameters_of(path, read_safetensors(path)[0], shapes))
