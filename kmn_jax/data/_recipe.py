"""From one CAD file to its scenes: model, collision shape, drops, views; then visibility bits for a pack, or images."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int, UInt8

from kmn_jax.bop import BopFrame, scene_frame
from kmn_jax.data._pack import Drop, PackedObject, quantised
from kmn_jax.errors import InputError
from kmn_jax.objects import ObjectConfig, load_object
from kmn_jax.simulate import (
    PERFECT,
    BinConfig,
    BinScene,
    CameraConfig,
    CollisionShape,
    DropResult,
    HullConfig,
    RayMesh,
    SensorConfig,
    collision_shape,
    pack_bits,
    place_camera,
    render,
    sense,
    settle,
    visible_bin_surfels,
    visible_surfels,
)


@dataclass(frozen=True)
class PackConfig:
    """The recipe of a pack."""

    surfels: int = 4096  # a multiple of 8
    bin_surfels: int = 8192  # likewise
    drops: int = 20  # 0: surfels alone, for worlds that are made inside of the training step
    copies: tuple[int, int] = (1, 20)  # of the first and of the last drop, evenly spaced between
    visibility: bool = True
    hulls: HullConfig = field(default_factory=HullConfig)
    bins: BinConfig = field(default_factory=BinConfig)
    cameras: CameraConfig = field(default_factory=CameraConfig)
    random_seed: int = 0

    def __post_init__(self) -> None:
        if self.surfels < 8 or self.surfels % 8 or self.bin_surfels < 8 or self.bin_surfels % 8:
            raise InputError(f"surfels = {self.surfels} and bin_surfels = {self.bin_surfels} must be multiples of 8")
        if self.drops < 0 or not 1 <= self.copies[0] <= self.copies[1] <= 255:
            raise InputError(f"drops = {self.drops} must be 0 or more, copies = {self.copies} a range within 1 to 255")

    @property
    def copies_per_drop(self) -> Int[np.ndarray, " d"]:
        """How many copies each drop has."""
        return np.rint(np.linspace(*self.copies, self.drops)).astype(int)


def pack_object(
    path: str | Path, name: str, split: str, config: PackConfig, scenes: int = 0
) -> tuple[PackedObject, dict[str, Any]]:
    """Make a pack's object of a CAD file: the surfels, and `config.drops` accepted scenes with their views.

    Beside it come facts for JSON: seconds by stage, and for each drop what physics reports, penetrations in diagonals.
    The same file, name, config and number of `scenes` give the same bits on one machine. Raises InputError if the file
    is broken or a drop is not accepted.
    """
    times = [time.perf_counter()]
    made = load_object(path, config=ObjectConfig(num_points=config.surfels, random_seed=config.random_seed))
    model = made.in_unit("m").centred()
    times.append(time.perf_counter())
    shape = collision_shape(model.vertices, model.triangles, config.hulls) if config.drops else None
    times.append(time.perf_counter())
    drops, results = bin_scenes(shape, config, int(model.digest[:8], 16) + scenes) if shape else ([], [])
    times.append(time.perf_counter())
    item = PackedObject(
        name=name,
        split=split,
        diameter=model.diameter,
        area=model.area,
        points=model.points,
        normals=model.normals,
        drops=tuple(Drop(scene) for scene in drops),
        digest=model.digest,
    )
    if config.visibility and drops:
        mesh, exact = RayMesh(model.vertices, model.triangles), quantised(item)
        bits = [visibility_bits(mesh, exact, drop.scene, config.bin_surfels) for drop in exact.drops]
        item = replace(item, drops=tuple(Drop(scene, *pair) for scene, pair in zip(drops, bits, strict=True)))
    times.append(time.perf_counter())
    return item, {
        "seconds": dict(zip(("model", "hulls", "physics", "visibility"), np.diff(times).tolist(), strict=True)),
        "hidden_share": model.hidden_share,
        "hulls": len(shape.parts) if shape else 0,
        "penetrations": [result.penetration for result in results],
        "capped": [result.capped for result in results],
        "attempts": [result.attempts for result in results],
        "floor_shares": [result.floor_share for result in results],
    }


def bin_scenes(shape: CollisionShape, config: PackConfig, object_seed: int) -> tuple[list[BinScene], list[DropResult]]:
    """Drop copies into bins as the recipe says and put a camera above each. Raises InputError where one fails."""
    scenes, results = [], []
    for index, copies in enumerate(config.copies_per_drop.tolist()):
        random_seed = (config.random_seed, object_seed, index)
        result = settle(shape, copies, config.bins, random_seed)
        if not result.accepted:
            raise InputError(
                f"{copies} copies found no acceptable rest in {result.attempts} attempts: {result.rejected[-1]}"
            )
        camera, T_camera_bin = place_camera(
            result.bin, shape.diagonal, config.cameras, np.random.default_rng((*random_seed, 1))
        )
        scenes.append(BinScene(result.bin, result.T_bin_object, camera, T_camera_bin))
        results.append(result)
    return scenes, results


def visibility_bits(
    mesh: RayMesh, item: PackedObject, scene: BinScene, bin_surfels_count: int
) -> tuple[UInt8[np.ndarray, "n m8"], UInt8[np.ndarray, " b8"]]:
    """Return the exact visibility of the object's surfels and of the bin's, as a pack holds it."""
    import jax.numpy as jnp

    from kmn_jax.simulate import bin_surfels

    size = jnp.array([scene.bin.length, scene.bin.width, scene.bin.height], dtype=jnp.float32)
    floor = bin_surfels(size, bin_surfels_count)
    return (
        pack_bits(visible_surfels(mesh, scene, item.points, item.normals)),
        pack_bits(visible_bin_surfels(mesh, scene, np.asarray(floor.points), np.asarray(floor.normals))),
    )


def rendered_frame(
    mesh: RayMesh, scene: BinScene, object_id: int, sensor: SensorConfig, rng: np.random.Generator
) -> BopFrame:
    """Render a scene by ray casting, as a frame of a BOP dataset in the scene's unit.

    Masks and visible fractions are exact; the depth is what the sensor makes of it.
    """
    seen = render(mesh, scene)
    depth = seen.depth if sensor == PERFECT else sense(mesh, scene, seen, sensor, rng)
    return scene_frame(scene, object_id, depth, seen.instances, seen.total_pixels, seen.total_boxes)
