"""The inputs, weights, calls and rivals that the network benchmarks share."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from benchmarks.reference import dense_jax
from kmn_jax.geometry import space_filling_order
from kmn_jax.models import (
    RELEASED_CONFIG,
    Compute,
    Model,
    create_model,
    model_structure,
    released_object,
    released_scene,
    save_released,
)


class Case(NamedTuple):
    """A batch of scattered clouds (so that no flat face makes near-ties) and a network with drawn weights."""

    parameters: nnx.State
    crops: jax.Array  # (b, 2048, 6)
    clouds: jax.Array  # (b, 2048, 6)
    keypoint_indices: jax.Array  # (20,)
    length: jax.Array

    @property
    def model(self) -> Model:
        """The network in float32, as published."""
        return self.with_compute("float32")

    def with_compute(self, compute: Compute) -> Model:
        """The same network in another arithmetic."""
        config = replace(RELEASED_CONFIG, compute=compute)
        return Model(model_structure(config).graphdef, self.parameters)

    def first(self) -> Case:
        """The first example alone, as a batch of one."""
        return self._replace(crops=self.crops[:1], clouds=self.clouds[:1])


def make_case(batch: int) -> Case:
    """Draw clouds and weights, GroupNorm weights of both signs."""
    clouds = [jnp.stack([_cloud(1000 * kind + index) for index in range(batch)]) for kind in (1, 2)]
    model = create_model(RELEASED_CONFIG, jax.random.key(0))
    rng = np.random.default_rng(0)

    def draw(path: tuple, value: Any) -> Any:
        if path[-1] != "norm_scale":
            return value
        return value.replace(jnp.asarray(rng.uniform(0.5, 1.5, value.shape) * rng.choice([-1, 1], value.shape), "f4"))

    flat = {path: draw(path, value) for path, value in nnx.to_flat_state(model.parameters)}
    indices = jnp.asarray(rng.permutation(2048)[:20])
    return Case(nnx.from_flat_state(flat), clouds[0], clouds[1], indices, jnp.float32(1))


def map_crops(function: Callable[[Any], Any], batch: Any) -> Any:
    """Batch by vmap; on CPUs one after the other, as one crop fills the cores and many only outgrow the caches."""
    return jax.lax.map(function, batch) if jax.default_backend() == "cpu" else jax.vmap(function)(batch)


def encode_objects(graphdef: nnx.GraphDef, parameters: nnx.State, case: Case) -> jax.Array:
    """Return the keypoints' features of a case's objects (b, 20, 128)."""
    network = nnx.merge(graphdef, parameters)
    return map_crops(lambda cloud: network.encode_object(cloud, case.keypoint_indices, case.length), case.clouds)


def cached_forward(graphdef: nnx.GraphDef, parameters: nnx.State, crops: jax.Array, parts: jax.Array) -> Any:
    """Return both logits of crops (b, n, 6), each with an object that is encoded already."""
    network = nnx.merge(graphdef, parameters)

    def one(pair: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return network.match(network.encode_scene(pair[0], jnp.float32(1)), pair[1])

    return map_crops(one, (crops, parts))


def head_features(keypoints: int = 20) -> tuple[jax.Array, jax.Array]:
    """Return drawn features of 2048 points and of an object's keypoints, for the pair head alone."""
    return jax.random.normal(jax.random.key(0), (2048, 512)), jax.random.normal(jax.random.key(1), (keypoints, 128))


def points_in_order(count: int, width: int) -> jax.Array:
    """Return drawn points as the encoder orders them, or features (count, width) that vary smoothly in space."""
    points = jax.random.normal(jax.random.key(0), (count, 3))
    points = points[space_filling_order(points)[0]]
    return points if width == 3 else jnp.tanh(points @ jax.random.normal(jax.random.key(1), (3, width)))


def match(graphdef: nnx.GraphDef, parameters: nnx.State, scene: jax.Array, part: jax.Array) -> Any:
    """Return both logits of features."""
    return nnx.merge(graphdef, parameters).match(scene, part)


def dense_jax_forward(case: Case) -> tuple[jax.Array, jax.Array]:
    """Run the dense reference one example after the other: a batch of dense forwards needs 0.5 GB for each."""
    parameters = nnx.to_pure_dict(case.parameters)

    def one(clouds: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        scene = dense_jax.encode_scene(released_scene(clouds[0], None), parameters)
        part = dense_jax.encode_object(released_object(clouds[1]), case.keypoint_indices, parameters)
        return dense_jax.match(scene, part, parameters)

    return jax.lax.map(one, (case.crops, case.clouds))


def torch_forward(case: Case) -> Callable[[], tuple[np.ndarray, np.ndarray]] | None:
    """Return the dense PyTorch forward on the same inputs and weights, all cores; None without torch."""
    if importlib.util.find_spec("torch") is None:
        return None
    import tempfile
    from pathlib import Path

    import torch

    from benchmarks.reference.dense_torch import DenseKeyMatchNet

    device = "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"
    torch.set_num_threads(os.cpu_count() or 1)
    network = DenseKeyMatchNet().eval()
    with tempfile.TemporaryDirectory() as folder:
        save_released(case.model, Path(folder) / "weights.pt")
        network.load_state_dict(torch.load(Path(folder) / "weights.pt", weights_only=True))
    network = network.to(device)

    def scaled(function: Callable[[jax.Array], jax.Array], clouds: jax.Array) -> list[Any]:
        return [torch.from_numpy(np.array(function(cloud)).T[None].copy()).to(device) for cloud in clouds]

    scenes = scaled(lambda crop: released_scene(crop, None), case.crops)
    parts = scaled(released_object, case.clouds)
    keypoints = torch.from_numpy(np.array(case.keypoint_indices)).to(device)

    def forward() -> tuple[np.ndarray, np.ndarray]:
        with torch.inference_mode():
            outputs = [network(scene, part, keypoints) for scene, part in zip(scenes, parts, strict=True)]
        segmentation, logits = (torch.stack(values).cpu().numpy() for values in zip(*outputs, strict=True))
        return segmentation, logits

    return forward


def _cloud(seed: int) -> jax.Array:
    cloud = np.random.default_rng(seed).normal(size=(2048, 6))
    cloud[:, :3] *= 20
    cloud[:, 3:] /= np.linalg.norm(cloud[:, 3:], axis=1, keepdims=True)
    return jnp.asarray(cloud, dtype=jnp.float32)
