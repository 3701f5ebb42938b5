"""A pack's arrays on a device: rows as the files have them, damage by name, scenes as the splatting takes them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Float

from kmn_jax.data import CropConfig, DevicePack, Pack, PackedObject, draw_crop, stack_pack, take_scene, visible_points
from kmn_jax.data._pack import Drop, write_manifest, write_object
from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera
from kmn_jax.simulate import Bin, BinScene, SplatConfig

SURFELS, BIN_SURFELS = 256, 64
RADIUS = 0.02  # metres
CAMERA = Camera(500.0, 510.0, 199.5, 149.5, 400, 300)


def ball_points(count: int) -> Float[np.ndarray, "n 3"]:
    index = np.arange(count) + 0.5
    z, angle = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def scene(copies: int) -> BinScene:
    """Return balls in a row on the floor of a bin, straight below the camera."""
    T_bin_object = np.tile(np.eye(4), (copies, 1, 1))
    T_bin_object[:, :3, 3] = [[2.5 * RADIUS * (i - (copies - 1) / 2), 0, RADIUS] for i in range(copies)]
    T_camera_bin = np.diag([1.0, -1, -1, 1])
    T_camera_bin[2, 3] = 0.4
    return BinScene(Bin(0.2, 0.15, 0.05, 0.002), T_bin_object, CAMERA, T_camera_bin)


def ball(name: str, split: str = "train", copies: tuple[int, ...] = (1, 3), visibility: bool = True) -> PackedObject:
    """Return a ball whose upper half is marked as visible."""
    normals = ball_points(SURFELS).astype(np.float32)
    rng = np.random.default_rng(len(name))
    upper = np.packbits(normals[:, 2] > 0.15, bitorder="little")
    drops = [
        Drop(
            scene(count),
            np.tile(upper, (count, 1)) if visibility else None,
            rng.integers(0, 256, BIN_SURFELS // 8, dtype=np.uint8) if visibility else None,
        )
        for count in copies
    ]
    return PackedObject(
        name=name,
        split=split,
        diameter=2 * RADIUS,
        area=4 * np.pi * RADIUS**2,
        points=normals * np.float32(RADIUS),
        normals=normals,
        drops=tuple(drops),
        digest="0" * 64,
    )


def write_pack(folder: Path, *items: PackedObject) -> Pack:
    write_manifest(folder, [write_object(folder, item) for item in items])
    return Pack(folder)


@pytest.fixture
def pack(tmp_path: Path) -> Pack:
    return write_pack(
        tmp_path,
        ball("a/one"),
        ball("a/two", copies=(2,)),
        ball("b/three", "validation"),
        ball("b/four", copies=(4, 1)),
    )


def on_device(arrays: DevicePack) -> DevicePack:
    placed: DevicePack = jax.tree.map(jnp.asarray, arrays)
    return placed


def test_stacks_a_split_as_the_files_have_it(pack: Pack) -> None:
    stacked = stack_pack(pack, "train")
    arrays = stacked.arrays
    assert stacked.names == ("a/one", "a/two", "b/four")
    assert stacked.problems == ()
    assert arrays.num_drops.tolist() == [2, 1, 2]
    assert arrays.num_copies.tolist() == [[1, 3], [2, 0], [4, 1]]
    assert arrays.T_camera_object.shape == (3, 2, 4, 4, 4)
    assert arrays.bits.shape == (3, 2, 4, SURFELS // 8)
    for row, name in enumerate(stacked.names):
        item = pack.load(name)
        np.testing.assert_array_equal(arrays.points[row], item.points)
        np.testing.assert_array_equal(arrays.normals[row], item.normals)
        np.testing.assert_allclose([arrays.area[row], arrays.diameter[row]], [item.area, item.diameter], rtol=1e-6)
        for column, drop in enumerate(item.drops):
            count = len(drop.scene.T_bin_object)
            poses = arrays.T_camera_object[row, column]
            np.testing.assert_allclose(poses[:count], drop.scene.T_camera_object, atol=1e-6)
            assert not poses[count:].any()
            np.testing.assert_array_equal(arrays.bits[row, column, :count], drop.bits)
            np.testing.assert_array_equal(arrays.bin_bits[row, column], drop.bin_bits)
            np.testing.assert_allclose(arrays.T_camera_bin[row, column], drop.scene.T_camera_bin, atol=1e-6)
            np.testing.assert_allclose(arrays.bin_size[row, column], [0.2, 0.15, 0.05], rtol=1e-6)
            assert arrays.camera[row, column].tolist() == [500.0, 510.0, 199.5, 149.5, 400.0, 300.0]


def test_named_objects_keep_their_order_and_bits_can_stay_away(pack: Pack) -> None:
    stacked = stack_pack(pack, ["b/three", "a/one"], visibility=False)
    assert stacked.names == ("b/three", "a/one")
    assert stacked.arrays.bits is None
    assert stacked.arrays.bin_bits is None
    assert stack_pack(pack, ["a/one", "b/three"], visibility=False).digest != stacked.digest
    assert stack_pack(pack, ["b/three", "a/one"], visibility=False).digest == stacked.digest


@pytest.mark.parametrize("kind", ["objects", "visibility"])
def test_damaged_object_is_named_and_the_rest_usable(pack: Pack, kind: str) -> None:
    path = pack.folder / kind / "a/two.safetensors"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    stacked = stack_pack(pack, "train")
    assert stacked.names == ("a/one", "b/four")
    assert len(stacked.arrays.points) == 2
    (problem,) = stacked.problems
    assert problem.startswith("a/two: ")
    assert str(path) in problem
    assert "checksum" in problem
    if kind == "visibility":  # the poses are whole
        assert stack_pack(pack, "train", visibility=False).problems == ()


def test_objects_without_bits_or_drops_are_named(tmp_path: Path) -> None:
    bare = replace(ball("bare"), drops=())
    pack = write_pack(tmp_path, ball("blind", visibility=False), ball("seen"), bare)
    stacked = stack_pack(pack, "train")
    assert stacked.names == ("seen",)
    assert [problem.split(": ")[0] for problem in stacked.problems] == ["blind", "bare"]
    assert stack_pack(pack, "train", visibility=False).names == ("blind", "seen")


def test_what_cannot_be_stacked_is_refused(tmp_path: Path, pack: Pack) -> None:
    with pytest.raises(InputError, match="gives no objects: it has none of 'test'"):
        stack_pack(pack, "test")
    with pytest.raises(InputError, match="has no object 'c'"):
        stack_pack(pack, ["a/one", "c"])
    with pytest.raises(InputError, match="asked for one object twice"):
        stack_pack(pack, ["a/one", "a/one"])
    with pytest.raises(InputError, match="split 'a/one' is not known"):
        stack_pack(pack, "a/one")
    small = ball("small", visibility=False)
    small = replace(small, points=small.points[:64], normals=small.normals[:64])
    mixed = write_pack(tmp_path / "mixed", ball("large", visibility=False), small)
    with pytest.raises(InputError, match=r"large has 256 surfels, but small 64"):
        stack_pack(mixed, "train", visibility=False)
    blind = write_pack(tmp_path / "blind", ball("blind", visibility=False))
    with pytest.raises(InputError, match="blind: it has no visibility bits"):
        stack_pack(blind, "train")
    arrays = stack_pack(blind, "train", visibility=False).arrays
    with pytest.raises(InputError, match="no visibility bits"):
        jax.eval_shape(lambda row: visible_points(take_scene(arrays, row, row)), jnp.int32(0))


def test_scenes_are_taken_inside_jit(pack: Pack) -> None:
    arrays = stack_pack(pack, "train").arrays
    rows, drops = np.array([2, 0, 1]), np.array([0, 1, 0])
    scenes = jax.jit(jax.vmap(take_scene, (None, 0, 0)))(on_device(arrays), rows, drops)
    scenes = jax.tree.map(np.asarray, scenes)
    assert scenes.copies.sum(axis=1).tolist() == [4, 3, 2]
    np.testing.assert_array_equal(scenes.surfels.points, arrays.points[rows])
    np.testing.assert_array_equal(scenes.T_camera_object, arrays.T_camera_object[rows, drops])
    np.testing.assert_array_equal(scenes.camera.fy, np.full(3, 510, np.float32))
    np.testing.assert_array_equal(scenes.bin_in_view.T_camera_bin, arrays.T_camera_bin[rows, drops])


def test_bits_and_splatting_see_the_upper_halves(pack: Pack) -> None:
    arrays = on_device(stack_pack(pack, "train").arrays)
    config = SplatConfig(resolution=128, num_bin_surfels=256)

    @jax.jit
    def fractions(row: jax.Array, drop: jax.Array) -> tuple[jax.Array, jax.Array]:
        scene = take_scene(arrays, row, drop)
        return visible_points(scene).visible_fraction, visible_points(scene, config).visible_fraction

    by_bits, by_splatting = map(np.asarray, fractions(jnp.int32(0), jnp.int32(1)))
    # Balls beside one another hide little of what faces the camera.
    assert (by_bits[:3] > 0.85).all()
    assert (by_splatting[:3] > 0.85).all()
    assert by_bits[3] == by_splatting[3] == 0


def test_a_crop_comes_from_a_batch_row(pack: Pack) -> None:
    arrays = stack_pack(pack, "train").arrays
    placed = on_device(arrays)
    config = CropConfig(num_points=64, max_noise=0.0, normals="surface", include_bin=False)

    @jax.jit
    def crop(row: jax.Array, drop: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        scene = take_scene(placed, row, drop)
        made = draw_crop(
            key, visible_points(scene), scene.surfels.points[:8], scene.T_camera_object, scene.diameter, config
        )
        return made.points + made.seed[None], made.is_object, made.valid

    points, is_object, valid = map(np.asarray, crop(jnp.int32(1), jnp.int32(0), np.array([1, 2], dtype=np.uint32)))
    assert valid
    assert is_object.any()
    centers = arrays.T_camera_object[1, 0, :2, :3, 3]
    distances = np.linalg.norm(points[:, None] - centers[None], axis=2).min(axis=1)
    np.testing.assert_allclose(distances[is_object], RADIUS, rtol=1e-3)
