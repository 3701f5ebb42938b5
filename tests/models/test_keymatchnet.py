from __future__ import annotations

from dataclasses import asdict, replace
from functools import cache, partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from benchmarks.reference import dense_jax
from kmn_jax.errors import InputError
from kmn_jax.models import (
    KeyMatchNet,
    KeyMatchNetConfig,
    Model,
    create_model,
    encode_object,
    encode_scene,
    match,
    released_object,
    released_scene,
)
from tests.reference.clouds import box_cloud, scene_crop
from tests.reference.networks import signed

# Sizes of clouds are few, since programs are compiled for each.
SMALL = {
    "edge_width": 32,
    "embedding_width": 64,
    "scene_width": 64,
    "object_width": 32,
    "pair_width": 64,
    "num_neighbors": 8,
}
KEYPOINTS = np.arange(12) * 15


@cache
def small_model(seed: int = 0, **changes) -> Model:
    """Return a narrow network with GroupNorm weights of both signs."""
    config = KeyMatchNetConfig(**(SMALL | changes))
    return Model(*nnx.split(signed(lambda: KeyMatchNet(config, rngs=nnx.Rngs(0)), seed, bias=0.3)))


def logits(model: Model, crop: np.ndarray, cloud: np.ndarray, length=None, mask=None, keypoints=KEYPOINTS) -> list:
    part = encode_object(model, cloud, keypoints, length)
    return [np.asarray(x) for x in match(model, encode_scene(model, crop, length, mask), part)]


def assert_close(got: list, want: list, tolerance: float = 1e-4) -> None:
    for a, b in zip(got, want, strict=True):
        np.testing.assert_allclose(a, b, atol=tolerance * np.ptp(b))


@partial(jax.jit, static_argnames="static")
def dense_logits(parameters: dict, crop: jax.Array, cloud: jax.Array, static: bool) -> tuple[jax.Array, jax.Array]:
    """Return those of normalisation "released", of the coordinates' graph if it is static."""
    with jax.numpy_rank_promotion("allow"):
        scene, part = released_scene(crop, None), released_object(cloud)
        graphs = [[dense_jax.neighbours(x[:, :3], 8)] * 3 if static else None for x in (scene, part)]
        return dense_jax.match(
            dense_jax.encode_scene(scene, parameters, 8, graphs[0]),
            dense_jax.encode_object(part, KEYPOINTS, parameters, 8, graphs[1]),
            parameters,
        )


@pytest.mark.parametrize("seed", range(2))
def test_forward_is_the_dense_one(seed: int) -> None:
    model = small_model(seed, normalization="released")
    crop, cloud = scene_crop(seed, 150), box_cloud(seed + 10, 180)
    want = dense_logits(nnx.to_pure_dict(model.parameters), crop, cloud, static=False)
    assert_close(logits(model, crop, cloud), [np.asarray(x) for x in want])


def coarse(attention: str) -> dict[str, object]:
    return {"num_coarse_points": 24, "attention": attention}


@pytest.mark.parametrize(
    ("inputs", "real", "changes"),
    [
        *((inputs, real, {}) for inputs in ("raw", "invariant", "chiral") for real in (100, 30, 5)),
        ("raw", 5, coarse("none")),
        *(("chiral", real, coarse("both")) for real in (30, 2)),
    ],
)
def test_padded_crop_equals_the_unpadded_one(inputs: str, real: int, changes: dict) -> None:
    """5 real points are fewer than the 8 neighbours asked for, 2 than the 3 coarse points that tell each other one."""
    model = small_model(normalization="metric", inputs=inputs, **changes)
    crop, cloud = scene_crop(1, 150), box_cloud(11, 180)
    crop[real:] = np.nan
    mask = np.arange(150) < real
    got = logits(model, crop, cloud, 50.0, mask)
    assert_close([x[:real] for x in got], logits(model, crop[:real], cloud, 50.0))
    assert (got[0][real:].argmax(axis=1) == 0).all()
    assert all(np.isfinite(x).all() for x in got)


def test_padding_may_lie_between_real_points() -> None:
    model = small_model(normalization="metric", inputs="invariant")
    crop, cloud = scene_crop(1, 150), box_cloud(11, 180)
    mask = np.arange(150) % 3 != 1
    want = logits(model, crop[mask], cloud, 50.0)
    crop[~mask] = np.inf
    assert_close([x[mask] for x in logits(model, crop, cloud, 50.0, mask)], want)


def test_released_normalisation_ignores_padding_too() -> None:
    model = small_model(normalization="released")
    crop, cloud = scene_crop(2, 180), box_cloud(12, 180)
    crop[150:] = 1e4
    got = logits(model, crop, cloud, None, np.arange(180) < 150)
    assert_close([x[:150] for x in got], logits(model, crop[:150], cloud))


@pytest.mark.parametrize("changes", [{}, coarse("both")], ids=["fine", "coarse"])
def test_vmap_equals_one_by_one(changes: dict) -> None:
    model = small_model(**changes)
    crops = np.stack([scene_crop(seed, 150) for seed in range(4)])
    masks = np.arange(150) < np.array([[150], [120], [75], [140]])
    part = encode_object(model, box_cloud(3, 180), KEYPOINTS, 50.0)
    batched = jax.vmap(lambda crop, mask: match(model, encode_scene(model, crop, 50.0, mask), part))(crops, masks)
    for index in range(4):
        single = match(model, encode_scene(model, crops[index], 50.0, masks[index]), part)
        assert_close([np.asarray(x)[index] for x in batched], [np.asarray(x) for x in single])


def test_one_scene_against_several_objects() -> None:
    model = small_model()
    scene = encode_scene(model, scene_crop(4, 100), 50.0)
    parts = [encode_object(model, box_cloud(seed, 180), KEYPOINTS, 50.0) for seed in (5, 6)]
    stacked = jax.tree.map(lambda *x: np.stack(x), *parts)
    batched = jax.vmap(lambda part: match(model, scene, part))(stacked)
    for index, part in enumerate(parts):
        assert_close([np.asarray(x)[index] for x in batched], [np.asarray(x) for x in match(model, scene, part)])


def test_metric_scaling_does_not_know_the_unit() -> None:
    model = small_model(normalization="metric")
    crop, cloud = scene_crop(5, 100), box_cloud(15, 180)
    metres = np.float32([1e-3] * 3 + [1] * 3)
    assert_close(logits(model, crop * metres, cloud * metres, 0.05), logits(model, crop, cloud, 50.0))


def test_object_length_defaults_to_its_diameter() -> None:
    cloud = box_cloud(6, 180)
    distances = np.linalg.norm(cloud[:, None, :3] - cloud[None, :, :3], axis=-1)
    part = encode_object(small_model(), cloud, KEYPOINTS)
    np.testing.assert_allclose(part.length, distances.max(), rtol=1e-5)
    np.testing.assert_array_equal(part.keypoints, cloud[KEYPOINTS])


def rotated(x: np.ndarray) -> np.ndarray:
    rotation, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    rotation = (rotation * np.sign(np.linalg.det(rotation))).astype(np.float32)
    return np.concatenate([x[:, :3] @ rotation.T, x[:, 3:] @ rotation.T], axis=1)


@pytest.mark.parametrize(
    "changes", [{"inputs": "invariant"}, {"inputs": "chiral"}, {"inputs": "chiral"} | coarse("both")]
)
def test_invariant_inputs_do_not_know_the_rotation(changes: dict) -> None:
    model = small_model(graph="static", **changes)
    crop, cloud = scene_crop(7, 100), box_cloud(17, 180)
    assert_close(logits(model, rotated(crop), rotated(cloud), 50.0), logits(model, crop, cloud, 50.0), 1e-3)


@pytest.mark.parametrize("inputs", ["invariant", "chiral"])
def test_invariant_inputs_hardly_know_the_rotation_in_a_dynamic_graph(inputs: str) -> None:
    model = small_model(inputs=inputs)
    crop, cloud = scene_crop(7, 100), box_cloud(17, 180)
    a, b = logits(model, rotated(crop), rotated(cloud), 50.0), logits(model, crop, cloud, 50.0)
    assert (np.abs(a[0] - b[0]) < 1e-2 * np.ptp(b[0])).mean() > 0.98  # a feature-space near-tie may flip


def test_static_graph_is_the_dense_network_on_the_coordinates_graph() -> None:
    model = small_model(normalization="released", graph="static")
    crop, cloud = scene_crop(8, 150), box_cloud(18, 180)
    want = dense_logits(nnx.to_pure_dict(model.parameters), crop, cloud, static=True)
    assert_close(logits(model, crop, cloud), [np.asarray(x) for x in want], 1e-5)


def test_bfloat16_stays_close() -> None:
    crop, cloud = scene_crop(9, 150), box_cloud(19, 180)
    exact = logits(small_model(graph="static"), crop, cloud, 50.0)
    model = small_model(graph="static", compute="bfloat16")
    half = logits(model, crop, cloud, 50.0)
    assert encode_scene(model, crop, 50.0).dtype == jnp.bfloat16
    for a, b in zip(half, exact, strict=True):
        assert a.dtype == np.float32
        assert np.sqrt(np.mean((a - b) ** 2)) < 0.02 * np.ptp(b)


@pytest.mark.parametrize(
    "changes",
    [{"pair_dropout": "shared"}, {"pair_dropout": "per_pair"}, {"inputs": "chiral"} | coarse("both")],
    ids=str,
)
def test_training_forward_has_finite_keyed_gradients(changes: dict) -> None:
    model = small_model(**changes)
    crop, cloud = jnp.asarray(scene_crop(10, 64)), jnp.asarray(box_cloud(20, 64))
    length = jnp.float32(50)

    @jax.jit
    def gradient(key):
        def loss(parameters):
            outputs = nnx.merge(model.graphdef, parameters)(crop, cloud, jnp.arange(10), length, None, key)
            return sum((x**2).mean() for x in outputs)

        return jax.tree.leaves(jax.grad(loss)(model.parameters))

    first, again, other = ([np.asarray(x) for x in gradient(jax.random.key(seed))] for seed in (0, 0, 1))
    assert all(np.isfinite(x).all() for x in first)
    assert all((a == b).all() for a, b in zip(first, again, strict=True))
    assert any((a != b).any() for a, b in zip(first, other, strict=True))
    assert all((x != 0).any() for x in first), "every parameter takes part"


def test_parameter_count_is_the_published_one() -> None:
    model = create_model(KeyMatchNetConfig(), jax.random.key(0))
    assert sum(x.size for x in jax.tree.leaves(model.parameters)) == 2_026_240


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"edge_width": 33}, "multiple of groups"),
        ({"groups": 0}, "at least 1"),
        ({"num_neighbors": 2.5}, "whole number"),
        ({"num_neighbors": 200, "num_scene_points": 128}, "num_neighbors is 200, but clouds have only 128 points"),
        ({"compute": "float16"}, "one of float32, tf32, bfloat16"),
        ({"normalization": "relased"}, "one of metric, released"),
        ({"dropout": 1.0}, r"in \[0, 1\)"),
        ({"inputs": "invariant", "normalization": "released"}, 'need normalization "metric"'),
        ({"num_keypoints": 50, "num_object_points": 40}, "cannot be drawn"),
        ({"num_coarse_points": -1}, "at least 0"),
        ({"num_coarse_points": 2.5}, "whole number"),
        ({"attention": "object", "num_coarse_points": 8}, "one of none, scene, both"),
        ({"attention": "scene"}, "needs num_coarse_points above 0"),
        ({"attention": "both", "num_coarse_points": 8, "object_width": 30, "groups": 2}, "multiples of its 4 heads"),
    ],
)
def test_contradictory_configs_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        KeyMatchNetConfig.__post_init__(SimpleNamespace(**(asdict(KeyMatchNetConfig()) | changes)))


def test_networks_of_before_are_called_what_they_were_called() -> None:
    """Digests of networks are of what their configs are called."""
    assert repr(KeyMatchNetConfig(num_keypoints=7)).endswith("object_digest='', compute='float32')")
    some, more = (KeyMatchNetConfig(num_coarse_points=count, attention="scene") for count in (16, 32))
    assert repr(some).endswith("compute='float32', num_coarse_points=16, attention='scene')")
    assert repr(more) != repr(some) != repr(replace(some, attention="both"))


def test_bad_input_gets_one_clear_error() -> None:
    model = small_model()
    crop, cloud = scene_crop(0, 30), box_cloud(0, 180)
    broken = crop.copy()
    broken[7, 2] = np.nan
    infinite = cloud.copy()
    infinite[3, 0] = np.inf
    part = encode_object(model, cloud, KEYPOINTS)
    cases = [
        (lambda: encode_scene(model, broken), r"scene_crop holds 1 values .* \(7, 2\)"),
        (lambda: encode_object(model, infinite, KEYPOINTS), "object_cloud holds 1 values"),
        (lambda: encode_scene(model, crop[:, :3]), r"shape \(30, 3\), but must have shape \(any, 6\)"),
        (lambda: encode_scene(model, crop[None]), "must have shape"),
        (lambda: encode_scene(model, crop[:0]), "empty"),
        (lambda: encode_scene(model, crop[0]), "must have shape"),
        (lambda: encode_scene(model, crop.astype(bool)), "floating point"),
        (lambda: encode_scene(model, crop.astype(str)), "not an array of numbers|floating point"),
        (lambda: encode_scene(model, crop[:1] * 0), "no extent"),
        (lambda: encode_scene(model, crop, -1.0), "above zero"),
        (lambda: encode_scene(model, crop, np.nan), "NaN"),
        (lambda: encode_scene(model, crop, mask=np.zeros(30, bool)), "no real point"),
        (lambda: encode_scene(model, crop, mask=np.zeros(29, bool)), "mask has shape"),
        (lambda: encode_scene(model, crop, mask=np.ones(30)), "must be bool"),
        (lambda: encode_object(model, cloud, [0, 180]), r"outside of \[0, 180\)"),
        (lambda: encode_object(model, cloud, [0.5]), "integers"),
        (lambda: encode_object(model, cloud, np.zeros(0, int)), "empty"),
        (lambda: encode_object(model, np.ones_like(cloud), KEYPOINTS), "no extent"),
        (lambda: match(model, crop, part), "scene_width"),
        (lambda: match(model, encode_scene(model, crop) * np.nan, part), "NaN"),
        (lambda: match(model, encode_scene(model, crop), part._replace(features=part.features * np.nan)), "NaN"),
        (lambda: match(model, encode_scene(model, crop), part._replace(features=part.features[None])), "shape"),
        (lambda: match(model, encode_scene(model, crop), crop), "must come from encode_object"),
        (lambda: encode_scene(None, crop), r"the pair \(graphdef, parameters\)"),
        (lambda: encode_scene(model, [[1.0] * 6, [1.0] * 5], mask=[True, True]), "not an array"),
        (lambda: encode_scene(model, crop * np.float32(1e25)), "too large for float32"),
        (lambda: encode_object(model, cloud * np.float32(1e25), KEYPOINTS), "too large for float32"),
    ]
    for call, message in cases:
        with pytest.raises(InputError, match=message):
            call()


def test_degenerate_crops_stay_finite() -> None:
    model = small_model()
    cloud = box_cloud(0, 180)
    one = scene_crop(0, 1) + np.float32([1, 0, 0, 0, 0, 0])
    duplicated = np.repeat(scene_crop(0, 3), 10, axis=0)
    for given in (model, small_model(inputs="chiral", **coarse("both"))):
        for crop in (one, duplicated):
            assert all(np.isfinite(x).all() for x in logits(given, crop, cloud, 50.0))
