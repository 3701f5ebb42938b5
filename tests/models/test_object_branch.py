"""Networks of one object: learned features, whatever the cloud; gradients, files, and keypoints that differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from kmn_jax.errors import InputError
from kmn_jax.models import Model, create_model, encode_object, load_model, model_structure, save_model
from tests.reference.clouds import box_cloud
from tests.reference.networks import TINY

LEARNED = replace(TINY, object_branch="learned", object_digest="1" * 64)


@pytest.fixture(scope="module")
def model() -> Model:
    return create_model(LEARNED, jax.random.key(0))


def test_the_cloud_counts_for_nothing_and_the_keypoints_are_its_own(model: Model) -> None:
    clouds = [box_cloud(seed, 64).astype(np.float32) for seed in range(2)]
    one, other = (encode_object(model, cloud, np.arange(4)) for cloud in clouds)
    assert one.features.shape == (4, 8)
    np.testing.assert_array_equal(one.features, other.features)
    np.testing.assert_array_equal(one.keypoints, clouds[0][:4])
    with pytest.raises(InputError, match="3 keypoints given, but this network was trained for one object and its 4"):
        encode_object(model, clouds[0], np.arange(3))


def test_it_has_no_object_branch_and_its_features_get_gradients(model: Model) -> None:
    sizes = [sum(leaf.size for leaf in jax.tree.leaves(one.parameters)) for one in (model, model_structure(TINY))]
    assert sizes[0] < sizes[1]
    crop = jnp.asarray(box_cloud(2, 64))

    def loss(parameters: nnx.State) -> jax.Array:
        network = nnx.merge(model.graphdef, parameters)
        segmentation, logits = network(crop, crop, jnp.arange(4), jnp.float32(1))
        return segmentation[:, 1].sum() + (logits[:, 0] - logits[:, 1]).sum()

    gradient = jax.jit(jax.grad(loss))(model.parameters)
    assert np.abs(gradient["keypoints"][...]).max() > 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_files_keep_it(model: Model, tmp_path: Path) -> None:
    save_model(model, tmp_path / "one.safetensors")
    again = load_model(tmp_path / "one.safetensors")
    assert again.config == LEARNED
    np.testing.assert_array_equal(again.parameters["keypoints"][...], model.parameters["keypoints"][...])


def test_a_network_of_any_object_names_none() -> None:
    with pytest.raises(ValueError, match="object_digest"):
        replace(TINY, object_digest="1" * 64)
