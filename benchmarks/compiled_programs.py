"""The programs that matter, as functions of arrays that need not be there: shapes alone are compiled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jax.sharding import NamedSharding, PartitionSpec

from benchmarks.stages import SEARCH
from configs import find_config
from kmn_jax.data import Pack, SampleIndex, stack_pack
from kmn_jax.detection import (
    EVIDENCE,
    BinPosesConfig,
    CalibrationArrays,
    DepthImage,
    DevicePart,
    bin_poses,
    calibration_beside,
    device_calibration,
    load_probabilities,
    poses_in_crop,
    search_crop,
)
from kmn_jax.geometry import Intrinsics, PaddedCloud
from kmn_jax.models import RELEASED_CONFIG, Compute, KeyMatchNetConfig, load_pretrained, model_structure, released_file
from kmn_jax.objects import PartArrays
from kmn_jax.released import RELEASED
from kmn_jax.simulate import Surfels
from kmn_jax.train import create_state, data_mesh, jit_train_step

_PACK = "experiments/assets/small_pack"
_OBJECTS = 1507  # of the training pack, of which the small one has a few
_CLOUD = 32_768  # points of a scan
_IMAGE = (600, 972)  # pixels of the small test set's images
_SURFELS = 2048  # of an object on the device
_SYMMETRIES, _LOOK_ALIKES = 1, 24
COMPUTES: tuple[Compute, ...] = ("float32", "tf32", "bfloat16")


@dataclass(frozen=True)
class Program:
    """What is compiled: a function, shapes of its arguments with their places, and how many items one call does."""

    name: str
    items: int
    item: str
    make: Callable[[list[Any]], tuple[Any, tuple[Any, ...]]]  # of the devices
    goes_on: bool = False  # whether its first result is the first argument of the next call, whose memory it reuses


def programs(devices: int) -> list[Program]:
    """Return the programs for so many devices, small ones first: of several, training alone."""
    found: list[Program] = []
    if devices == 1:
        found += [_forward(batch, compute) for batch in (1, 16, 64, 256) for compute in COMPUTES]
        found += [_crops(batch) for batch in (1, 64)] + [_bin(seeds) for seeds in (32,)]
        found += [_step(name, compute, batch, 1) for name, compute, batch in _steps()]
        return found
    return [_step("base", "bfloat16", each * devices, devices) for each in (16, 32, 128)]


def _steps() -> Iterator[tuple[str, Compute, int]]:
    yield "small", "float32", 64
    yield "wide_long", "float32", 128
    yield "paper", "float32", 14
    yield "paper", "bfloat16", 14
    for compute in COMPUTES:
        yield "base", compute, 128


def _forward(batch: int, compute: Compute) -> Program:
    """The published network, with the object's features given."""
    model = model_structure(replace(RELEASED_CONFIG, compute=compute))

    def forward(parameters: nnx.State, crops: jax.Array, parts: jax.Array) -> Any:
        network = nnx.merge(model.graphdef, parameters)

        def one(crop: jax.Array, part: jax.Array) -> Any:
            return network.match(network.encode_scene(crop, jnp.float32(1)), part)

        return jax.vmap(one)(crops, parts)

    config = RELEASED_CONFIG
    crops = _array((batch, config.num_scene_points, 6), jnp.float32)
    parts = _array((batch, config.num_keypoints, config.object_width), jnp.float32)
    name = f"network, {batch} crops, {compute}"
    return Program(
        name, batch, "crop", lambda devices: (jax.jit(forward), _on(devices, (model.parameters, crops, parts)))
    )


def _crops(batch: int) -> Program:
    """The released network, from a scan's points to refined poses."""

    def make(devices: list[Any]) -> tuple[Any, tuple[Any, ...]]:
        model = load_pretrained()
        part = _part(model.config)
        config = replace(SEARCH.of_network(model.config), side_by_side=True)  # what a device would have it be

        def solve(parameters: nnx.State, part: Any, clouds: PaddedCloud, keys: jax.Array) -> Any:
            def one(cloud: PaddedCloud, key: jax.Array) -> Any:
                key = jax.random.wrap_key_data(key)
                crop = search_crop(cloud, 0, part.diameter, key, config)
                return poses_in_crop(model.graphdef, parameters, part, crop, key, config).poses

            return jax.vmap(one)(clouds, keys)

        clouds = PaddedCloud(_array((batch, _CLOUD, 3), jnp.float32), _array((batch, _CLOUD), jnp.bool_))
        keys = _array((batch, 2), jnp.uint32)
        return jax.jit(solve), _on(devices, (model.parameters, part, clouds, keys))

    return Program(f"crop to poses, {batch} crops, {RELEASED}", batch, "crop", make)


def _bin(seeds: int) -> Program:
    """The released network, from a depth image to ranked poses."""

    def make(devices: list[Any]) -> tuple[Any, tuple[Any, ...]]:
        model = load_pretrained()
        points = _array((_SURFELS, 3), jnp.float32)
        surfels = Surfels(points, points, _array((), jnp.float32))
        poses = _array((_SYMMETRIES, 4, 4), jnp.float32)
        rivals = _array((_LOOK_ALIKES, 4, 4), jnp.float32), _array((_LOOK_ALIKES,), jnp.bool_)
        part = DevicePart(_part(model.config), surfels, poses, _array((), jnp.float32), *rivals)
        search = BinPosesConfig().search.of_network(model.config)
        search = replace(search, crops=replace(search.crops, side_by_side=True))
        config = BinPosesConfig(num_seeds=seeds, search=search)

        def solve(parameters: nnx.State, part: Any, calibration: Any, image: Any, inside: Any, key: jax.Array) -> Any:
            key = jax.random.wrap_key_data(key)
            return bin_poses(model.graphdef, parameters, part, calibration, image, inside, key, config)

        number = _array((), jnp.float32)
        image = DepthImage(_array(_IMAGE, jnp.float32), Intrinsics(*[number] * 6))
        stored = load_probabilities(calibration_beside(released_file()), EVIDENCE)
        own = device_calibration(stored.found)
        calibration = CalibrationArrays(*(_array(leaf.shape, leaf.dtype) for leaf in own))
        inside, key = _array(_IMAGE, jnp.bool_), _array((2,), jnp.uint32)
        return jax.jit(solve), _on(devices, (model.parameters, part, calibration, image, inside, key))

    return Program(f"bin in one call, {seeds} seeds, {RELEASED}", 1, "bin", make)


def _part(config: KeyMatchNetConfig) -> PartArrays:
    """Return the shapes of an encoded object."""
    points = _array((config.num_object_points, 3), jnp.float32)
    features = _array((config.num_keypoints, config.object_width), jnp.float32)
    return PartArrays(points, points, features, _array((), jnp.float32))


def _step(name: str, compute: Compute, batch: int, devices: int) -> Program:
    """A training step with its data, sharded over all devices."""

    def make(devices: list[Any]) -> tuple[Any, tuple[Any, ...]]:
        config = find_config(name)
        config = replace(
            config,
            network=replace(config.network, compute=compute),
            pipeline=replace(config.pipeline, batch_size=batch),
            crops_at_once=None,
        )
        mesh = data_mesh(devices)
        whole, shared = (NamedSharding(mesh, PartitionSpec(*axes)) for axes in ((), mesh.axis_names))
        graphdef, state = create_state(config.step, config.optimizer.build(config.num_steps))
        scenes = config.examples.worlds is None
        pack = stack_pack(Pack(_PACK), "train", config.examples.visibility == "bits", scenes).arrays
        pack = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((_OBJECTS, *leaf.shape[1:]), leaf.dtype), pack)
        index, key = _array((batch,), jnp.int32), _array((batch, 2), jnp.uint32)
        samples = SampleIndex(index, index, key, _array((batch,), jnp.bool_))
        step = jit_train_step(graphdef, config.optimizer, config.num_steps, config.step, mesh)
        number = _array((), jnp.int32)
        return step, (*_placed((state, pack), whole), _placed(samples, shared), _placed(number, whole))

    return Program(f"training step, {name}, {batch} samples, {compute}", batch, "sample", make, True)


def _array(extents: tuple[int, ...], kind: Any) -> Any:
    """Return a shape, which takes the place of an array."""
    return jax.ShapeDtypeStruct(extents, kind)


def _on(devices: list[Any], arguments: Any) -> Any:
    """Return the shapes of arguments, all of them on the first device."""
    return _placed(arguments, NamedSharding(data_mesh(devices[:1]), PartitionSpec()))


def _placed(arguments: Any, sharding: NamedSharding) -> Any:
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), arguments)
