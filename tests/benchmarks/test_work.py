"""Counts of operations against what XLA counts in the same program, and against sums by hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from flax import nnx

from benchmarks import work
from benchmarks.network_cases import make_case
from benchmarks.timing import Ceilings
from kmn_jax.geometry import squared_distances
from kmn_jax.pose import IcpConfig, MatchConfig, RansacConfig


def counted(function: Callable[..., Any], *arguments: Any) -> float:
    """Return XLA's count of a compiled function's operations."""
    return float(jax.jit(function).lower(*arguments).compile().cost_analysis()["flops"])


def test_layers_count_as_xla_counts_them() -> None:
    case = make_case(1)
    config = case.model.config
    local, graph = jnp.zeros((2048, 192)), jnp.zeros((2048, 20), dtype=jnp.int32)
    scene, part = jnp.zeros((2048, 512)), jnp.zeros((20, 128))

    def of_network(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda parameters, *arguments: function(nnx.merge(case.model.graphdef, parameters), *arguments)

    stages = work.scene_stages(config, 2048)
    # Normalisation and activation, which floors leave out, are the difference; loops XLA counts once.
    blocks = of_network(lambda net, x, g: net.scene.edge2(x, g, "float32"))
    assert stages["EdgeConv 2"].flops == pytest.approx(counted(blocks, case.parameters, local[:, :64], graph), rel=0.25)
    layers = of_network(lambda net, x: net.scene._with_global(x, "float32", None))
    assert stages["global and output layers"].flops == pytest.approx(counted(layers, case.parameters, local), rel=0.1)
    head = of_network(lambda net, s, o: net.match(s, o))
    without_pairs = stages["pair head"].flops - 3 * 2048 * 20 * 256
    assert without_pairs == pytest.approx(counted(head, case.parameters, scene, part), rel=0.1)


def test_distances_count_as_xla_counts_them() -> None:
    for width in (3, 64):
        x = jnp.zeros((256, width))
        found = counted(lambda x: squared_distances(x, x), x)
        assert work.neighbors(256, width, 20).flops == pytest.approx(found, rel=0.1)


def test_a_static_graph_has_one_search_for_neighbors() -> None:
    from configs import find_config

    assert sum(name.startswith("kNN") for name in work.scene_stages(find_config("small").network, 512)) == 1
    assert sum(name.startswith("kNN") for name in work.scene_stages(find_config("paper").network, 2048)) == 3


def test_floors_are_the_larger_of_arithmetic_and_memory() -> None:
    ceilings = Ceilings(matmul_flops=1e9, matmul_bfloat16_flops=4e9, copy_bytes=1e8)
    products = work.Work(flops=1e9, moved=1e6, matrix=True)
    assert products.floor_ms(ceilings) == pytest.approx(1000)
    assert products.floor_ms(ceilings, low_precision=True) == pytest.approx(250)
    assert products.bound(ceilings) == "arithmetic"
    copy = work.Work(flops=1e3, moved=1e8)
    assert copy.floor_ms(ceilings, low_precision=True) == pytest.approx(1000)
    assert copy.bound(ceilings) == "memory"
    both = products + copy
    assert both == work.Work(1e9 + 1e3, 1e6 + 1e8, matrix=False)
    assert both.times(2).intensity == pytest.approx(both.intensity)


def test_pose_stages_grow_with_what_they_do() -> None:
    few, many = RansacConfig(num_hypotheses=100, num_candidates=1000), RansacConfig(num_hypotheses=1000)
    assert work.ransac(1024, 1, many).flops > 8 * work.ransac(1024, 1, few).flops
    assert work.icp(1024, 512, IcpConfig(iterations=20)).flops == pytest.approx(
        20 * work.icp(1024, 512, IcpConfig(iterations=1)).flops
    )
    assert work.matches(512, 20, MatchConfig(capacity=1024)).moved < work.matches(512, 20, MatchConfig()).moved
