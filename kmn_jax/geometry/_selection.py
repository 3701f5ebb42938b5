"""The largest of each row, and the one at a place in order: without a full sort where that takes long."""

from __future__ import annotations

import inspect
import os
from functools import partial
from importlib.util import find_spec

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float32, Int, Shaped

from kmn_jax.platforms import by_platform

# From version 0.11 on JAX takes a promise back; before that, XLA has to be told: see `ask_for_fast_selection`.
_ANY_TIES = {"is_stable": False} if "is_stable" in inspect.signature(jax.lax.top_k).parameters else {}
_FLAG = "xla_gpu_experimental_use_raft_select_k"
_GROUP_SIZES = (4, 8, 16, 32)
_WORTH_GROUPS = 4  # times fewer numbers to select from, for which more kernels are started
_GPU_PACKAGES = ("jax_cuda12_plugin", "jax_cuda13_plugin")


def largest(values: Shaped[Array, "... n"], k: int) -> tuple[Shaped[Array, "... k"], Int[Array, "... k"]]:
    """Return the k largest of each row, in order, and their places; on CPUs, the first of equal ones come first."""

    def in_order(values: Shaped[Array, "... n"]) -> tuple[Shaped[Array, "... k"], Int[Array, "... k"]]:
        best, places = jax.lax.top_k(values, k)
        return best, places

    return by_platform(values, cpu=in_order, default=partial(largest_in_any_order, k=k))


def largest_in_any_order(values: Shaped[Array, "... n"], k: int) -> tuple[Shaped[Array, "... k"], Int[Array, "... k"]]:
    """Return the k largest of each row, in order but for equal ones, and their places.

    Where k are few of many, they are found in the k groups whose largest are largest: what takes time is how many
    numbers a selection is given.
    """
    size = _group_size(values.shape[-1], k)
    if size == 1:
        return _selected(values, k)
    groups = values.reshape(*values.shape[:-1], values.shape[-1] // size, size)
    _, chosen = _selected(groups.max(axis=-1), k)
    found = jnp.take_along_axis(groups, chosen[..., None], axis=-2)
    best, places = _selected(found.reshape(*values.shape[:-1], k * size), k)
    return best, size * jnp.take_along_axis(chosen, places // size, axis=-1) + places % size


def smallest_at(values: Float32[Array, " n"], place: Int[Array, ""]) -> Float32[Array, ""]:
    """Return the number at a place among n in order, the smallest at 0; none may be below zero, inf may be there."""
    return by_platform(values, place, cpu=smallest_by_bits, default=lambda values, place: jnp.sort(values)[place])


def smallest_by_bits(values: Float32[Array, " n"], place: Int[Array, ""]) -> Float32[Array, ""]:
    """Return the same bit by bit: CPUs count eight numbers at once, but sort one by one.

    Floats of zero and above are in the order of the integers that their bits are.
    """
    codes = jax.lax.bitcast_convert_type(values, jnp.int32)

    def add_bit(step: Int[Array, ""], found: Int[Array, ""]) -> Int[Array, ""]:
        larger = found | (jnp.int32(1) << (30 - step))
        return jnp.where((codes < larger).sum(dtype=jnp.int32) <= place, larger, found)

    return jax.lax.bitcast_convert_type(jax.lax.fori_loop(0, 31, add_bit, jnp.int32(0)), jnp.float32)


def _group_size(count: int, k: int) -> int:
    """Return how many numbers a group is to have, 1 if groups would not leave a fraction to select from."""

    def left(size: int) -> float:
        return count / size + k * size

    best = min((size for size in _GROUP_SIZES if count % size == 0), key=left, default=1)
    return best if _WORTH_GROUPS * left(best) <= count else 1


def _selected(values: Shaped[Array, "... n"], k: int) -> tuple[Shaped[Array, "... k"], Int[Array, "... k"]]:
    best, places = jax.lax.top_k(values, k, **_ANY_TIES)
    return best, places


def ask_for_fast_selection() -> None:
    """Have XLA select on NVIDIA GPUs by a library where JAX cannot ask for it; call it before JAX is used.

    Otherwise it sorts whole rows for more than 16 of each. Versions of JAX that can ask need nothing, and without JAX
    for GPUs nothing changes.
    """
    given = os.environ.get("XLA_FLAGS", "")
    if not _ANY_TIES and _FLAG not in given and any(map(find_spec, _GPU_PACKAGES)):
        os.environ["XLA_FLAGS"] = f"{given} --{_FLAG}=true".strip()
