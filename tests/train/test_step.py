"""How labels of keypoints are spread in a step; whole steps are tested by test_loop.py and test_sharding.py."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from kmn_jax.data import CropConfig, Pack, SampleIndex, StackedPack, stack_pack
from kmn_jax.models import LossConfig, create_model
from kmn_jax.train import ExampleConfig
from kmn_jax.train._step import StepConfig, Sums, eval_step, sum_gradients
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
    rows = jnp.array([0, 0, 1, 1], dtype=jnp.int32)
    return SampleIndex(rows, jnp.arange(4, dtype=jnp.int32), jnp.asarray(keys), jnp.ones(4, dtype=bool))


def test_labels_are_spread_in_training_and_not_in_validation() -> None:
    stacked: StackedPack = stack_pack(Pack(PACK), "train")
    graphdef, parameters = create_model(TINY, jax.random.key(0))
    dropout = jax.random.split(jax.random.key(1), 2)

    def trained(config: StepConfig) -> Sums:
        given = partial(sum_gradients, graphdef, config)
        sums: Sums = jax.jit(given)(parameters, stacked.arrays, samples(), dropout)[1]
        return sums

    plain, widely = trained(CONFIG), trained(spread(1.0))
    assert float(plain.num_crops) > 0
    np.testing.assert_allclose(widely.segmentation_loss, plain.segmentation_loss, rtol=1e-5)
    np.testing.assert_array_equal(widely.keypoint_right, plain.keypoint_right)
    assert abs(float(widely.keypoint_loss - plain.keypoint_loss)) > 1e-3 * float(plain.keypoint_loss)

    def validated(config: StepConfig) -> str:
        return str(jax.make_jaxpr(partial(eval_step, graphdef, config))(parameters, stacked.arrays, samples()))

    assert validated(spread(1.0)) == validated(CONFIG)
