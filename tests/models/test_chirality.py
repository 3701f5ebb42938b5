from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.models import KeyMatchNetConfig, Model, encode_object, encode_scene, model_structure, with_chiral_inputs
from tests.models.test_keymatchnet import KEYPOINTS, SMALL, assert_close, logits, small_model
from tests.reference.clouds import box_cloud, scene_crop


def mirrored(cloud: np.ndarray) -> np.ndarray:
    return cloud * np.float32([-1, 1, 1, -1, 1, 1])


def features(model: Model, crop: np.ndarray, cloud: np.ndarray) -> list[np.ndarray]:
    part = encode_object(model, cloud, KEYPOINTS, 50.0)
    return [np.asarray(encode_scene(model, crop, 50.0)), np.asarray(part.features)]


def largest_change(got: list, want: list) -> list[float]:
    return [np.abs(a - b).max() / np.ptp(b) for a, b in zip(got, want, strict=True)]


def test_only_chiral_inputs_tell_a_shape_from_its_mirror_image() -> None:
    crop, cloud = scene_crop(1, 100), box_cloud(11, 180)
    blind, seeing = (small_model(inputs=inputs, graph="static") for inputs in ("invariant", "chiral"))
    assert_close(features(blind, mirrored(crop), mirrored(cloud)), features(blind, crop, cloud), 1e-3)
    assert min(largest_change(features(seeing, mirrored(crop), mirrored(cloud)), features(seeing, crop, cloud))) > 0.02


def test_pair_volumes_are_those_of_a_determinant() -> None:
    from kmn_jax.models._invariants import raw_inputs, scene_invariants

    crop = scene_crop(3, 40)
    graph = np.random.default_rng(3).integers(0, 40, (40, 5))

    @jax.jit
    def volumes(crop: jax.Array, graph: jax.Array, rows: jax.Array | None = None) -> jax.Array:
        return scene_invariants(crop, None, chiral=True).pair_features(graph, True, rows)

    got = np.asarray(volumes(crop, graph))
    for i, row in enumerate(graph):
        for place, j in enumerate(row):
            d = crop[j, :3] - crop[i, :3]
            d = d / max(np.linalg.norm(d), 1e-9)
            want = [np.linalg.det([crop[i, 3:], crop[j, 3:], d]), np.linalg.det([crop[i, 3:], d, crop[i, :3]])]
            np.testing.assert_allclose(got[i, place, 4:], want, atol=1e-4 * max(1, np.linalg.norm(crop[i, :3])))
    some = np.array([5, 9])
    np.testing.assert_allclose(volumes(crop, graph[some], some), got[some], atol=1e-5)
    assert raw_inputs(jnp.asarray(crop)).pair_features(jnp.asarray(graph), True) is None


def test_grown_network_answers_as_before() -> None:
    model = small_model(inputs="invariant", graph="static")
    grown = with_chiral_inputs(model)
    assert grown.config.inputs == "chiral"
    crop, cloud = scene_crop(1, 150), box_cloud(11, 180)
    mask = np.arange(150) < 120
    assert_close(logits(grown, crop, cloud, 50.0, mask), logits(model, crop, cloud, 50.0, mask))
    fresh = model_structure(grown.config)
    shapes = [[leaf.shape for leaf in jax.tree.leaves(m.parameters)] for m in (grown, fresh)]
    assert shapes[0] == shapes[1]


def test_other_networks_cannot_be_given_chiral_inputs() -> None:
    with pytest.raises(InputError, match='only one of "invariant" inputs'):
        with_chiral_inputs(small_model(inputs="raw"))
    learned = KeyMatchNetConfig(**SMALL, inputs="invariant", object_branch="learned")
    with pytest.raises(InputError, match='"learned" object branch'):
        with_chiral_inputs(model_structure(learned))
    with pytest.raises(InputError, match="a coarse level cannot be given chiral inputs"):
        with_chiral_inputs(small_model(inputs="invariant", num_coarse_points=8))
