"""Devices that programs are compiled for without one being there, and the ceilings from which their times follow."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any

import jax

from benchmarks.compiled_counts import Counts, Kernel, Unit
from kmn_jax.errors import InputError

# What XLA's compiler asks about the card: limits of compute capability 9.0 and the vendor's sizes of an H200.
_H200 = """
gpu_device_info {
  cuda_compute_capability { major: 9 minor: 0 feature_extension: ACCELERATED_FEATURES }
  name: "NVIDIA H200" device_vendor: "NVIDIA Corporation"
  core_count: 132 fpus_per_core: 128 clock_rate_ghz: 1.98
  memory_bandwidth: 4800000000000 device_memory_size: 151397597184 l2_cache_size: 52428800
  threads_per_warp: 32 threads_per_block_limit: 1024 threads_per_core_limit: 2048
  thread_dim_limit_x: 1024 thread_dim_limit_y: 1024 thread_dim_limit_z: 64
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535
  registers_per_core_limit: 65536 registers_per_block_limit: 65536
  shared_memory_per_core: 233472 shared_memory_per_block: 49152 shared_memory_per_block_optin: 232448
  device_address_bits: 64
  driver_version: "13.0.0" runtime_version: "12.9.0" compile_time_toolkit_version: "12.9.0" dnn_version: "9.10.0"
}
platform_name: "CUDA"
dnn_version_info { major: 9 minor: 10 }
device_description_str: "NVIDIA H200"
"""

# There is no device to try algorithms of products on, and without trials those of Triton find no tiles for edges. What
# comes after the program that is counted, machine code, need not be good.
_CUDA_FLAGS = {
    "xla_gpu_experimental_use_raft_select_k": "true",  # as kmn_jax.geometry.ask_for_fast_selection does
    "xla_gpu_autotune_level": "0",
    "xla_gpu_enable_triton_gemm": "false",
    "xla_backend_optimization_level": "0",
    "xla_gpu_disable_gpuasm_optimizations": "true",
    "xla_llvm_disable_expensive_passes": "true",
}


@dataclass(frozen=True)
class Rates:
    """What a device does in a second at most, and what each start and each wait of its host costs at least."""

    memory_bytes: float
    operations: dict[Unit, float]
    shared_bytes: float  # through the memory in which rows are sorted
    link_bytes: float  # out of a device to others, while as much comes in
    launch_s: float  # between the starts of two small kernels
    wait_s: float  # of a host that reads a condition before it can start what follows
    selected: float | None = None  # elements that a library's selection takes; None: it is bound by memory alone


@dataclass(frozen=True)
class Target:
    """Devices to compile for. `floor` holds the vendor's ceilings, `expected` what programs like these may reach."""

    platform: str
    topology: str
    devices: int
    floor: Rates
    expected: Rates


# Vendor: 4.8 TB/s; dense products of 989 TFLOP/s in bfloat16, 495 in tf32; 67 in float32; NVLink 450 GB/s each way.
# Shared memory: 128 bytes a clock in each of 132 cores at 1.98 GHz. The times of starts and waits are no vendor's, but
# those of CUDA graphs and of a read of one word that are commonly reported.
_H200_FLOOR = Rates(
    4.8e12, {"plain": 67e12, "float32": 67e12, "tf32": 495e12, "bfloat16": 989e12}, 33e12, 450e9, 1.5e-6, 8e-6
)
# Guesses, to be held against the first measurement: 70% of the copies' 4.3 TB/s measured on such a card, as gathers and
# reductions seldom reach a copy; half of the products' 788 TFLOP/s, as these are narrow; a quarter of plain arithmetic,
# as half of it is no multiply-and-add and indices count too; and a library's selection as is reported of CUB's, 2^28
# numbers in 1.9 ms.
_H200_EXPECTED = Rates(
    3.0e12,
    {"plain": 17e12, "float32": 40e12, "tf32": 200e12, "bfloat16": 390e12},
    16e12,
    300e9,
    3e-6,
    15e-6,
    2**28 / 1.9e-3,
)
# Vendor: 819 GB/s, 197 TFLOP/s in bfloat16, 1,600 Gbit/s between chips in all four directions. A product of float32 is
# six of bfloat16. Arithmetic outside of products: 1,024 lanes of four units at 1.5 GHz. A program starts once.
_V5E_FLOOR = Rates(
    819e9, {"plain": 6e12, "float32": 197e12 / 6, "tf32": 197e12, "bfloat16": 197e12}, 5e12, 100e9, 0.5e-6, 0
)
_V5E_EXPECTED = Rates(600e9, {"plain": 1.5e12, "float32": 16e12, "tf32": 90e12, "bfloat16": 90e12}, 1e12, 70e9, 1e-6, 0)
# Vendor: 1,640 GB/s, 918 TFLOP/s in bfloat16, 3,584 Gbit/s.
_V6E_FLOOR = Rates(
    1640e9, {"plain": 7e12, "float32": 918e12 / 6, "tf32": 918e12, "bfloat16": 918e12}, 5e12, 224e9, 0.5e-6, 0
)
_V6E_EXPECTED = Rates(
    1100e9, {"plain": 2e12, "float32": 75e12, "tf32": 400e12, "bfloat16": 400e12}, 1e12, 150e9, 1e-6, 0
)

# The same chip as the H200's, with other memory: 3.35 TB/s by the vendor, 70% of copies of 3.0 TB/s.
_H100_FLOOR = replace(_H200_FLOOR, memory_bytes=3.35e12)
_H100_EXPECTED = replace(_H200_EXPECTED, memory_bytes=2.1e12)

TARGETS = {
    "h100": Target("cuda", "1x1x1", 1, _H100_FLOOR, _H100_EXPECTED),
    "h200": Target("cuda", "1x1x1", 1, _H200_FLOOR, _H200_EXPECTED),
    "h200x8": Target("cuda", "1x1x8", 8, _H200_FLOOR, _H200_EXPECTED),
    "v5e-1": Target("tpu", "v5e:2x2", 1, _V5E_FLOOR, _V5E_EXPECTED),
    "v5e-16": Target("tpu", "v5e:4x4", 16, _V5E_FLOOR, _V5E_EXPECTED),
    "v5e-256": Target("tpu", "v5e:16x16", 256, _V5E_FLOOR, _V5E_EXPECTED),
    "v6e-8": Target("tpu", "v6e:2x4", 8, _V6E_FLOOR, _V6E_EXPECTED),
}


def prepare(target: Target) -> None:
    """Set up JAX for compiling alone; call it before JAX is used for anything else."""
    jax.config.update("jax_platforms", "cpu")
    if target.platform == "cuda":
        os.environ |= {"JAX_SKIP_CUDA_CONSTRAINTS_CHECK": "1", "CUDA_VISIBLE_DEVICES": "-1"}
        given = os.environ.get("XLA_FLAGS", "")
        flags = [f"--{name}={value}" for name, value in _CUDA_FLAGS.items() if name not in given]
        os.environ["XLA_FLAGS"] = " ".join([given, *flags]).strip()
    else:
        # No chip is held, so that more than one process may have the compiler.
        os.environ |= {"TPU_SKIP_MDS_QUERY": "1", "ALLOW_MULTIPLE_LIBTPU_LOAD": "1"}


def devices_of(target: Target) -> list[Any]:
    """Return the devices that are not there. Raises InputError if the compiler for them is not installed."""
    from jax.experimental import topologies

    try:
        if target.platform == "cuda":
            made = topologies.get_topology_desc("h200", "cuda", target_config=_H200, topology=target.topology)
        else:
            made = topologies.get_topology_desc(target.topology, platform="tpu")
    except (RuntimeError, ValueError, NotImplementedError) as error:
        raise InputError(
            f"there is no compiler for {target.platform} here ({str(error).splitlines()[0]}): run `make compile-env`,"
            " and this command by .venv-compile/bin/python"
        ) from None
    return list(made.devices)[: target.devices]


def seconds_of(kernel: Kernel, rates: Rates, devices: int) -> float:
    """Return what one run of a kernel takes: the longest of its start, its bytes, its operations and its links."""
    sorting = 2 * kernel.sort_stages * 8.0 * kernel.sorted_elements / rates.shared_bytes
    selecting = kernel.sorted_elements / rates.selected if rates.selected and not kernel.sort_stages else 0.0
    linking = 2 * (devices - 1) / devices * kernel.collective_bytes / rates.link_bytes
    moving = kernel.bytes / rates.memory_bytes
    computing = sum(number / rates.operations[unit] for unit, number in kernel.operations.items())
    return max(rates.launch_s, moving, computing, sorting, selecting, linking)


def seconds(counts: Counts, rates: Rates, devices: int) -> float:
    """Return what a program takes whose kernels run one after the other."""
    waits = rates.wait_s * sum(counts.waits.values())
    return waits + sum(kernel.times * seconds_of(kernel, rates, devices) for kernel in counts.kernels)
