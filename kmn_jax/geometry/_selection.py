"""The largest of each row: on accelerators without a full sort, which a promised order of ties would take there."""

from __future__ import annotations

import inspect
import os
from functools import partial
from importlib.util import find_spec

import jax
from jaxtyping import Array, Int, Shaped

# From version 0.11 on JAX takes a promise back; before that, XLA has to be told: see `ask_for_fast_selection`.
_ANY_TIES = {"is_stable": False} if "is_stable" in inspect.signature(jax.lax.top_k).parameters else {}
_FLAG = "xla_gpu_experimental_use_raft_select_k"
_GPU_PACKAGES = ("jax_cuda12_plugin", "jax_cuda13_plugin")


def largest(values: Shaped[Array, "... n"], k: int) -> tuple[Shaped[Array, "... k"], Int[Array, "... k"]]:
    """Return the k largest of each row, in order, and their places; on CPUs, the first of equal ones come first."""
    return jax.lax.platform_dependent(
        values, cpu=lambda values: tuple(jax.lax.top_k(values, k)), default=partial(largest_in_any_order, k=k)
    )


def largest_in_any_order(values: Shaped[Array, "... n"], k: int) -> tuple[Shaped[Array, "... k"], Int[Array, "... k"]]:
    """Return the k largest of each row, in order but for equal ones, and their places."""
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
