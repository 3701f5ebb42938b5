"""A pack as one set of stacked arrays, for scenes that are made inside of a training step."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int32, UInt8

from kmn_jax.data._pack import Drop, Pack, PackedObject
from kmn_jax.errors import InputError
from kmn_jax.geometry import Intrinsics
from kmn_jax.simulate import BinInView, SplatConfig, Surfels, VisiblePoints, visible_by_splatting, visible_from_bits
from kmn_jax.typing import Scalar

# A pack's 8,192 bin surfels lie a twentieth of the object's diagonal apart; crops draw points from four times as many,
# nearly as dense as those on objects, so that background is not told by its density.
BIN_SPLITS = 2

_Any = np.ndarray | Array  # on the host as stacked, on a device once put there


class DevicePack(NamedTuple):
    """o objects of m surfels, with up to d drops of up to c copies; lengths in metres. Padding is zero.

    1,507 objects of 4,096 surfels with 20 drops of up to 20 copies take 190 MB, with visibility 530 MB.
    """

    points: Float32[_Any, "o m 3"]
    normals: Float32[_Any, "o m 3"]
    area: Float32[_Any, " o"]
    diameter: Float32[_Any, " o"]
    num_drops: Int32[_Any, " o"]
    T_camera_object: Float32[_Any, "o d c 4 4"]
    num_copies: Int32[_Any, "o d"]
    camera: Float32[_Any, "o d 6"]  # fx, fy, cx, cy, width, height
    bin_size: Float32[_Any, "o d 3"]
    T_camera_bin: Float32[_Any, "o d 4 4"]
    bits: UInt8[_Any, "o d c m8"] | None = None
    bin_bits: UInt8[_Any, "o d b8"] | None = None


class PackedScene(NamedTuple):
    """One drop of one object of a `DevicePack`, as the functions of `kmn_jax.simulate._splat` take it."""

    surfels: Surfels
    diameter: Scalar
    T_camera_object: Float[Array, "c 4 4"]
    copies: Bool[Array, " c"]
    camera: Intrinsics
    bin_in_view: BinInView
    bits: UInt8[Array, "c m8"] | None
    bin_bits: UInt8[Array, " b8"] | None


@dataclass(frozen=True)
class StackedPack:
    """The arrays of a pack, on the host, the names of their rows, and one sentence for each object left out."""

    arrays: DevicePack
    names: tuple[str, ...]
    problems: tuple[str, ...]
    digest: str  # SHA-256 of the names and the files' checksums, in the order of the rows


def stack_pack(pack: Pack, objects: str | Sequence[str], visibility: bool = True, scenes: bool = True) -> StackedPack:
    """Read the objects of a split, or those of the given names, in the manifest's or the given order, and stack them.

    Without `visibility` there are no bits, and scenes must be splatted; without `scenes` there are surfels alone.
    Objects that are damaged, or lack drops or bits, are left out and named. Raises InputError if none is left, if a
    name is unknown or twice there, or if objects differ in their numbers of surfels.
    """
    wanted = pack.names(objects) if isinstance(objects, str) else list(objects)
    unknown = [name for name in wanted if name not in pack.entries]
    if unknown or len(set(wanted)) < len(wanted):
        what = f"has no object {unknown[0]!r}" if unknown else "was asked for one object twice"
        raise InputError(f"{pack.folder} {what}: name each object once, as its manifest does")
    items: list[PackedObject] = []
    problems = []
    for name in wanted:
        try:
            item = pack.load(name, visibility and scenes)
            items.append(_usable(item, visibility) if scenes else replace(item, drops=()))
        except InputError as error:
            problems.append(f"{name}: {error}")
    if not items:
        reason = f"none of {len(wanted)} can be used; {problems[0]}" if problems else f"it has none of {objects!r}"
        raise InputError(f"{pack.folder} gives no objects: {reason}")
    for what, counts in (
        ("surfels", [len(item.points) for item in items]),
        ("bytes of bits for the bin", [_num_bin_bits(item.drops[0]) if item.drops else 0 for item in items]),
    ):
        other = next((row for row, count in enumerate(counts) if count != counts[0]), None)
        if other is not None:
            raise InputError(
                f"{pack.folder}: {items[0].name} has {counts[0]} {what}, but {items[other].name} {counts[other]}:"
                " build the pack by one recipe"
            )
    kept = tuple(item.name for item in items)
    entries = (pack.entries[name] for name in kept)
    lines = (f"{e.name} {e.objects.sha256} {e.visibility.sha256 if e.visibility else ''}\n" for e in entries)
    digest = hashlib.sha256("".join(lines).encode()).hexdigest()
    return StackedPack(_stack(items, visibility and scenes), kept, tuple(problems), digest)


def take_scene(pack: DevicePack, object: Int32[Array, ""], drop: Int32[Array, ""]) -> PackedScene:
    """Return one scene, inside jit; rows beyond the pack are those at its end."""

    def of_drop(array: _Any) -> Array:
        return jnp.asarray(array)[object, drop]

    capacity = pack.T_camera_object.shape[2]
    points, normals, area, diameter = (
        jnp.asarray(array)[object] for array in (pack.points, pack.normals, pack.area, pack.diameter)
    )
    return PackedScene(
        surfels=Surfels(points, normals, area),
        diameter=diameter,
        T_camera_object=of_drop(pack.T_camera_object),
        copies=jnp.arange(capacity, dtype=jnp.int32) < of_drop(pack.num_copies),
        camera=Intrinsics(*of_drop(pack.camera)),
        bin_in_view=BinInView(of_drop(pack.bin_size), of_drop(pack.T_camera_bin)),
        bits=None if pack.bits is None else of_drop(pack.bits),
        bin_bits=None if pack.bin_bits is None else of_drop(pack.bin_bits),
    )


def visible_points(scene: PackedScene, splat: SplatConfig | None = None) -> VisiblePoints:
    """Return what the scene's camera sees of copies and bin: by the scene's bits, or with a config by splatting.

    Raises InputError if there are neither.
    """
    poses, copies = scene.T_camera_object, scene.copies
    if splat is not None:
        return visible_by_splatting(scene.surfels, poses, copies, scene.camera, scene.bin_in_view, splat)
    if scene.bits is None:
        raise InputError("the scene has no visibility bits: stack the pack with visibility=True, or give a SplatConfig")
    splits = 1 if scene.bin_bits is None else BIN_SPLITS
    return visible_from_bits(scene.surfels, poses, copies, scene.bits, scene.bin_in_view, scene.bin_bits, splits)


def _usable(item: PackedObject, visibility: bool) -> PackedObject:
    if not item.drops:
        raise InputError("it has no drops: build it again")
    if not visibility:
        return item
    for drop in item.drops:
        if drop.bits is None or drop.bin_bits is None:
            raise InputError("it has no visibility bits: build the pack with them, or leave visibility off and splat")
        fits = drop.bits.shape == (len(drop.scene.T_bin_object), len(item.points) // 8)
        if not fits or _num_bin_bits(drop) != _num_bin_bits(item.drops[0]):
            raise InputError("its visibility bits do not fit its surfels, copies and bins: build it again")
    return item


def _num_bin_bits(drop: Drop) -> int:
    return 0 if drop.bin_bits is None else len(drop.bin_bits)


def _stack(items: Sequence[PackedObject], visibility: bool) -> DevicePack:
    num_drops = np.array([len(item.drops) for item in items], dtype=np.int32)
    shape = (len(items), int(num_drops.max()))
    capacity = max((len(drop.scene.T_bin_object) for item in items for drop in item.drops), default=0)
    poses = np.zeros((*shape, capacity, 4, 4), dtype=np.float32)
    num_copies = np.zeros(shape, dtype=np.int32)
    cameras, sizes = np.zeros((*shape, 6), dtype=np.float32), np.zeros((*shape, 3), dtype=np.float32)
    bin_poses = np.zeros((*shape, 4, 4), dtype=np.float32)
    bits = bin_bits = None
    if visibility:
        bits = np.zeros((*shape, capacity, len(items[0].points) // 8), dtype=np.uint8)
        bin_bits = np.zeros((*shape, _num_bin_bits(items[0].drops[0])), dtype=np.uint8)
    for row, item in enumerate(items):
        for column, drop in enumerate(item.drops):
            scene, place = drop.scene, (row, column)
            count = len(scene.T_bin_object)
            num_copies[place], poses[place][:count] = count, scene.T_camera_object
            camera, size = scene.camera, scene.bin
            cameras[place] = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
            sizes[place], bin_poses[place] = (size.length, size.width, size.height), scene.T_camera_bin
            if bits is not None and bin_bits is not None and drop.bits is not None and drop.bin_bits is not None:
                bits[place][:count], bin_bits[place] = drop.bits, drop.bin_bits
    return DevicePack(
        points=np.stack([item.points for item in items]),
        normals=np.stack([item.normals for item in items]),
        area=np.array([item.area for item in items], dtype=np.float32),
        diameter=np.array([item.diameter for item in items], dtype=np.float32),
        num_drops=num_drops,
        T_camera_object=poses,
        num_copies=num_copies,
        camera=cameras,
        bin_size=sizes,
        T_camera_bin=bin_poses,
        bits=bits,
        bin_bits=bin_bits,
    )
