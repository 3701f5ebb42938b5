"""How labels of keypoints are spread in a step; whole steps are tested by test_loop.py and test_sharding.py."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from kmn_jax.data import CropConfig, Pack, SampleIndex, StackedPack, stack_pack
from kmn_jax.models import LossConfig, model_structure
from kmn_jax.train import ExampleConfig
from kmn_jax.train._examples import Group
from kmn_jax.train._step import StepConfig, _label_shares, eval_step, sum_gradients
from tests.reference.networks import TINY

PACK = Path(__file__).parent.parent.parent / "experiments" / "assets" / "small_pack"
CONFIG = StepConfig(
    network=TINY,
    examples=ExampleConfig(crops=CropConfig(num_points=64, normals="surface")),
    loss=LossConfig(),
    crops_per_object=2,
    crops_at_once=None,
    average_decay=0.0,
    random_seed=0,
)


def spread(deviation: float) -> StepConfig:
    return replace(CONFIG, loss=LossConfig(keypoint_spread=deviation))


def samples() -> SampleIndex:
    keys = np.random.default_rng(0).integers(0, 2**32, (4, 2), dtype=np.uint32)
    rows, drops = np.array([[0, 0, 1, 1], [0, 1, 2, 3]], dtype=np.int32)
    return SampleIndex(*map(jnp.asarray, (rows, drops, keys, np.ones(4, dtype=bool))))


def test_labels_are_spread_in_training_and_not_in_validation() -> None:
    """By the programs of both, as compiling them takes longer."""
    stacked: StackedPack = stack_pack(Pack(PACK), "train")
    graphdef, parameters = model_structure(TINY)
    dropout = jax.random.split(jax.random.key(1), 2)

    def trained(config: StepConfig) -> str:
        of = partial(sum_gradients, graphdef, config)
        return str(jax.make_jaxpr(of)(parameters, stacked.arrays, samples(), dropout))

    def validated(config: StepConfig) -> str:
        of = partial(eval_step, graphdef, config)
        return str(jax.make_jaxpr(of)(parameters, stacked.arrays, samples()))

    assert spread(0.0) == CONFIG
    plain = trained(CONFIG)
    assert not re.search("0x[0-9a-f]{8}", plain)  # an address would differ each time
    assert plain != trained(spread(1.0))
    assert validated(spread(1.0)) == validated(CONFIG)


def test_labels_are_spread_over_shares_of_the_crops_radius() -> None:
    cloud = np.zeros((1, 5, 6), dtype=np.float32)
    cloud[0, 3, 0] = 30
    nothing = np.zeros((1, 1, 1, 6), dtype=np.float32)
    flags = np.zeros((1, 1, 1), dtype=bool)
    indices, length = np.array([[0, 3]], dtype=np.int32), np.array([60], dtype=np.float32)
    group = Group(cloud, indices, length, nothing, flags, flags, flags.astype(np.int32), flags[..., 0])
    assert _label_shares(group, LossConfig()) is None
    shares = np.asarray(jax.jit(_label_shares, static_argnames="config")(group, LossConfig(keypoint_spread=0.5)))
    np.testing.assert_allclose(shares[0, 0, 1] / shares[0, 0, 0], np.exp(-0.5), rtol=1e-5)  # half a radius away
