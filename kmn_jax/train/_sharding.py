"""Which device holds what: one mesh axis, `data`, over which a batch is split; all else is on every device.

No other module knows the mesh. Each device makes and computes its own groups of a batch; all that they exchange is the
sum of the gradients. (Left to the shardings of jit alone, XLA also gathers scenes and logits from all devices.)
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, TypeVar

import jax
import numpy as np
from flax import nnx
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from kmn_jax.data import DevicePack
from kmn_jax.errors import InputError
from kmn_jax.train._examples import Group
from kmn_jax.train._optimizer import OptimizerConfig
from kmn_jax.train._step import (
    Metrics,
    Samples,
    StepConfig,
    SumGradients,
    Sums,
    TrainState,
    eval_step,
    make_samples,
    train_step,
)

TrainStep = Callable[[TrainState, DevicePack, Samples, Int[Array, ""] | np.int32], tuple[TrainState, Metrics]]
EvalStep = Callable[[nnx.State, DevicePack, Samples], Sums]

_AXIS = "data"
_WHOLE, _SHARED = PartitionSpec(), PartitionSpec(_AXIS)
_COUNTS = ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")  # how many processes srun or mpirun has started
_KUBERNETES = "JOB_COMPLETION_INDEX"  # set in the pods of an indexed job
_T = TypeVar("_T")


def initialize_distributed(
    coordinator: str | None = None, processes: int | None = None, process: int | None = None
) -> bool:
    """Join the run's other processes and tell whether there are any; call it before JAX is used for anything else.

    Without arguments the processes that SLURM, MPI or an indexed job of Kubernetes has started find each other.
    Otherwise give the first one's host:port as `coordinator`, how many `processes` there are, and which `process` this
    is. Raises InputError if only some are given or they contradict each other, or if processes cannot be found.
    """
    if coordinator is not None and processes is not None and process is not None:
        if not 0 <= process < processes:
            raise InputError(f"process = {process} must be from 0 to below processes = {processes}")
    elif not coordinator and processes is None and process is None:
        started = any(os.environ.get(name, "1") != "1" for name in _COUNTS)
        if not started and _KUBERNETES not in os.environ:
            return False
    else:
        raise InputError(
            f"coordinator = {coordinator}, processes = {processes} and process = {process} belong together: give all"
        )
    try:
        jax.distributed.initialize(coordinator, processes, process)
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"this is one of several processes, but they cannot be joined ({error}): give coordinator, processes and"
            " process"
        ) from None
    return True


def split_cpu(shares: int) -> None:
    """Make every core of a CPU a device of its own, or as many as can take equal numbers of so many shares of a batch.

    Two devices of a core each make more samples than one of two cores (docs/throughput.md). Call it before JAX is used
    for anything else. Other accelerators are what they are; so are devices that XLA_FLAGS or a setting of JAX asks for.
    """
    flag = "xla_force_host_platform_device_count"
    if flag in os.environ.get("XLA_FLAGS", "") or jax.config.values["jax_num_cpu_devices"] > 0:
        return
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jax.config.update("jax_num_cpu_devices", max(n for n in range(1, cores + 1) if shares % n == 0))


def data_mesh(devices: Sequence[jax.Device] | None = None) -> Mesh:
    """Return the mesh over all devices of all processes, or over those given."""
    return Mesh(np.array(jax.devices() if devices is None else devices), (_AXIS,))


def check_batch(size: int, config: StepConfig, mesh: Mesh) -> None:
    """Raise InputError unless every device gets whole chunks of what it computes side by side."""
    unit = max(config.crops_per_object, config.crops_at_once or 1)
    if size % (unit * mesh.size):
        raise InputError(
            f"a batch of {size}, in groups of {config.crops_per_object} crops of one object, cannot be shared by"
            f" {mesh.size} devices that take {unit} at once: choose a batch_size that is a multiple of"
            f" {unit * mesh.size}"
        )


@lru_cache(maxsize=4)
def jit_train_step(
    graphdef: nnx.GraphDef, optimizer: OptimizerConfig, num_steps: int, config: StepConfig, mesh: Mesh
) -> TrainStep:
    """Return `train_step` of state, pack, batch and number, compiled for the mesh. The state's memory is reused."""

    def spread(function: SumGradients) -> SumGradients:
        def summed(*arguments: Any) -> tuple[nnx.State, Sums]:
            return jax.lax.psum(function(*arguments), _AXIS)

        return jax.shard_map(
            summed, mesh=mesh, in_specs=(_WHOLE, _WHOLE, _SHARED, _SHARED), out_specs=_WHOLE, check_vma=False
        )

    whole, shared = _shardings(mesh)
    return jax.jit(
        partial(train_step, graphdef, optimizer.build(num_steps), config, spread=spread),
        in_shardings=(whole, whole, shared, whole),
        out_shardings=whole,
        donate_argnums=0,
    )


@lru_cache(maxsize=4)
def jit_eval_step(graphdef: nnx.GraphDef, config: StepConfig, mesh: Mesh) -> EvalStep:
    """Return `eval_step` of parameters, pack and batch, compiled for the mesh."""

    def summed(*arguments: Any) -> Sums:
        return jax.lax.psum(eval_step(graphdef, config, *arguments), _AXIS)

    whole, shared = _shardings(mesh)
    step = jax.shard_map(summed, mesh=mesh, in_specs=(_WHOLE, _WHOLE, _SHARED), out_specs=_WHOLE, check_vma=False)
    return jax.jit(step, in_shardings=(whole, whole, shared), out_shardings=whole)


@lru_cache(maxsize=4)
def jit_make_samples(config: StepConfig, mesh: Mesh) -> Callable[[DevicePack, Samples], Group]:
    """Return what makes the examples of a batch, compiled for the mesh: the share of a step that is data."""
    whole, shared = _shardings(mesh)
    made = jax.shard_map(
        partial(make_samples, config), mesh=mesh, in_specs=(_WHOLE, _SHARED), out_specs=PartitionSpec(None, _AXIS)
    )
    return jax.jit(made, in_shardings=(whole, shared))


def put_whole(tree: _T, mesh: Mesh) -> _T:
    """Put arrays, the same in all processes, on every device."""
    return _put(tree, _shardings(mesh)[0])


def put_batch(samples: Samples, mesh: Mesh) -> Samples:
    """Spread a batch over the devices. Every process gives its own share."""
    return _put(samples, _shardings(mesh)[1])


def any_process(flag: bool, mesh: Mesh) -> Array | bool:
    """Return whether any process says so, as an array that need not be waited for. All must ask alike."""
    if jax.process_count() == 1:
        return flag
    whole, shared = _shardings(mesh)
    return _any(_put(np.full(mesh.local_mesh.size, flag), shared), whole)


def from_first_process(make: Callable[[], _T]) -> _T:
    """Return on all processes what `make` returns on the first, or raise what it raises there, elsewhere as InputError.

    All processes must call this; only the first calls `make`.
    """
    if jax.process_count() == 1:
        return make()
    made: _T | None = None
    error: Exception | None = None
    if jax.process_index() == 0:
        try:
            made = make()
        except Exception as caught:  # the others wait to hear of it
            error = caught
    value: _T
    value, problem = pickle.loads(_broadcast(pickle.dumps((made, error and str(error)))))
    if error is not None:
        raise error
    if problem is not None:
        raise InputError(problem)
    return value


def _broadcast(content: bytes) -> bytes:
    """Return the first process's content."""
    # Bytes, since the broadcast is a sum, which turns -0.0 into 0.0 and may touch NaN.
    size = int(multihost_utils.broadcast_one_to_all(np.int32(len(content))))
    own = np.frombuffer(content, np.uint8) if jax.process_index() == 0 else np.zeros(size, np.uint8)
    return np.asarray(multihost_utils.broadcast_one_to_all(own)).tobytes()


def _shardings(mesh: Mesh) -> tuple[NamedSharding, NamedSharding]:
    return NamedSharding(mesh, _WHOLE), NamedSharding(mesh, _SHARED)


def _put(tree: _T, sharding: NamedSharding) -> _T:
    if jax.process_count() == 1:
        return jax.device_put(tree, sharding)
    with jax.transfer_guard("allow"):  # explicit as it is, JAX takes it for an implicit transfer
        return jax.tree.map(lambda array: jax.make_array_from_process_local_data(sharding, np.asarray(array)), tree)


@partial(jax.jit, static_argnums=1)
def _any(flags: Array, sharding: NamedSharding) -> Array:
    return jax.lax.with_sharding_constraint(flags.any(), sharding)
