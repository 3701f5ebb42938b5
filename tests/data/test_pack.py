from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kmn_jax.data import Pack, PackedObject
from kmn_jax.data._pack import Drop, quantised, write_manifest, write_object
from kmn_jax.errors import InputError
from kmn_jax.files import read_safetensors, safetensors_bytes
from kmn_jax.geometry import Camera
from kmn_jax.simulate import Bin, BinScene

SIZE = 0.04  # metres


def packed_object(name: str = "Family/part_1,0", split: str = "train", seed: int = 0, drops: int = 3) -> PackedObject:
    """Return an object of random points far from its origin, with copies in bins and random visibility bits."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (64, 3)) * SIZE + [0.3, 0, -0.1]
    normals = rng.normal(size=(64, 3))
    scenes = [random_scene(rng, copies) for copies in range(1, drops + 1)]
    return PackedObject(
        name=name,
        split=split,
        diameter=SIZE,
        area=SIZE**2,
        points=points.astype(np.float32),
        normals=(normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        drops=tuple(
            Drop(
                scene,
                rng.integers(0, 256, (len(scene.T_bin_object), 8), dtype=np.uint8),
                rng.integers(0, 256, 4, dtype=np.uint8),
            )
            for scene in scenes
        ),
        digest="0" * 64,
    )


def random_scene(rng: np.random.Generator, copies: int) -> BinScene:
    T_bin_object = np.tile(np.eye(4), (copies, 1, 1))
    T_bin_object[:, :3, :3] = Rotation.random(copies, rng=rng).as_matrix()
    T_bin_object[:, :3, 3] = rng.uniform(-0.05, 0.05, (copies, 3)) - T_bin_object[:, :3, :3] @ [0.3, 0, -0.1]
    T_camera_bin = np.eye(4)
    T_camera_bin[:3, :3] = Rotation.from_euler("xyz", [170, 5, 20], degrees=True).as_matrix()
    T_camera_bin[:3, 3] = [0.01, -0.02, 0.3]
    camera = Camera(1000.0, 1001.0, 485.5, 299.5, 972, 600)
    return BinScene(Bin(0.14, 0.1, 0.05, 0.002), T_bin_object, camera, T_camera_bin)


def write_pack(folder: Path, *items: PackedObject) -> Pack:
    write_manifest(folder, [write_object(folder, item) for item in items], licence="none")
    return Pack(folder)


@pytest.fixture
def pack(tmp_path: Path) -> Pack:
    return write_pack(tmp_path, packed_object(), packed_object("Family/other", "test", seed=1))


def test_reads_back_what_was_written_to_16_and_8_bits(pack: Pack) -> None:
    item, read = packed_object(), pack.load("Family/part_1,0")
    assert (read.name, read.split, read.diameter, read.area, read.digest) == (
        (item.name, item.split, item.diameter, item.area, item.digest)
    )
    np.testing.assert_allclose(read.points, item.points, atol=SIZE / 2 / 32767)
    angles = np.degrees(np.arccos(np.clip((read.normals * item.normals).sum(axis=1), -1, 1)))
    assert angles.max() < 1.0  # degrees, of eight bits on the octahedron
    np.testing.assert_allclose(np.linalg.norm(read.normals, axis=1), 1, atol=1e-6)
    for there, here in zip(read.drops, item.drops, strict=True):
        np.testing.assert_array_equal(there.bits, here.bits)
        np.testing.assert_array_equal(there.bin_bits, here.bin_bits)
        assert there.scene.camera == here.scene.camera
        np.testing.assert_allclose(there.scene.T_camera_bin, here.scene.T_camera_bin, atol=1e-7)
        # What counts is where the surface goes: within 1e-4 of the object's size.
        there_points, here_points = (
            np.einsum("nij,pj->npi", pose[:, :3, :3], item.points) + pose[:, None, :3, 3]
            for pose in (there.scene.T_bin_object, here.scene.T_bin_object)
        )
        np.testing.assert_allclose(there_points, here_points, atol=1e-4 * SIZE)


def test_quantised_is_bitwise_what_is_read_back(pack: Pack) -> None:
    exact, read = quantised(packed_object()), pack.load("Family/part_1,0", visibility=False)
    np.testing.assert_array_equal(exact.points, read.points)
    np.testing.assert_array_equal(exact.normals, read.normals)
    for there, here in zip(read.drops, exact.drops, strict=True):
        np.testing.assert_array_equal(there.scene.T_bin_object, here.scene.T_bin_object)
        np.testing.assert_array_equal(there.scene.T_camera_bin, here.scene.T_camera_bin)
        assert there.scene.bin == here.scene.bin
        assert there.bits is None
        assert here.bits is None


def test_same_object_gives_the_same_bytes(tmp_path: Path) -> None:
    shards = [write_object(tmp_path / folder, packed_object()) for folder in ("a", "b")]
    assert shards[0] == shards[1]
    assert (tmp_path / "a" / shards[0].objects.path).stat().st_size == shards[0].objects.size


def test_normals_survive_on_all_octants_and_axes(tmp_path: Path) -> None:
    axes = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)])
    normals = (axes / np.linalg.norm(axes, axis=1, keepdims=True)).astype(np.float32)
    item = packed_object()
    item = replace(item, points=item.points[: len(normals)], normals=normals)
    read = quantised(item).normals
    assert (read * normals).sum(axis=1).min() > np.cos(np.radians(1.0))
    np.testing.assert_allclose(read[np.abs(axes).sum(axis=1) == 1], normals[np.abs(axes).sum(axis=1) == 1], atol=1e-7)


def test_lists_objects_by_split(pack: Pack) -> None:
    assert pack.names() == ["Family/part_1,0", "Family/other"]
    assert pack.names("test") == ["Family/other"]
    assert pack.names("validation") == []
    with pytest.raises(InputError, match="split 'tset' is not known"):
        pack.names("tset")
    with pytest.raises(InputError, match="has no object 'nothing'"):
        pack.load("nothing")


def test_pack_without_visibility(tmp_path: Path) -> None:
    item = packed_object()
    item = replace(item, drops=tuple(replace(drop, bits=None, bin_bits=None) for drop in item.drops))
    pack = write_pack(tmp_path, item)
    assert pack.entries[item.name].visibility is None
    assert all(drop.bits is None for drop in pack.load(item.name).drops)
    assert not (tmp_path / "visibility").exists()


def flip_a_byte(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (flip_a_byte, "does not match the manifest's checksum"),
        (lambda path: path.write_bytes(b""), r"checksum \(0 bytes"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1]), "does not match"),
        (Path.unlink, "cannot be read: No such file"),
    ],
)
@pytest.mark.parametrize("kind", ["objects", "visibility"])
def test_names_a_damaged_file_and_keeps_the_rest(
    pack: Pack, kind: str, damage: Callable[[Path], object], message: str
) -> None:
    damage(pack.folder / kind / "Family/other.safetensors")
    with pytest.raises(InputError, match=f"{kind}/Family/other.*{message}"):
        pack.load("Family/other")
    problems = pack.problems()
    assert len(problems) == 1
    assert f"{kind}/Family/other" in problems[0]
    assert len(pack.load("Family/part_1,0").drops) == 3
    if kind == "visibility":
        assert len(pack.load("Family/other", visibility=False).drops) == 3


def test_refuses_what_is_not_finite(pack: Pack) -> None:
    path = pack.folder / "objects/Family/other.safetensors"
    tensors, facts = read_safetensors(path)
    tensors["cameras"][0, 4] = np.nan
    path.write_bytes(safetensors_bytes(tensors, facts))
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    edit_manifest(pack.folder, lambda manifest: manifest["objects"][1]["objects"].update(sha256=digest))
    with pytest.raises(InputError, match=r"other.safetensors is not an object of a pack .*not finite"):
        Pack(pack.folder).load("Family/other")


def edit_manifest(folder: Path, change: Callable[[dict], object]) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(version=2), "has version 2, but this kmn_jax reads version 1"),
        (lambda m: m.update(format="other"), "is not the manifest of a pack"),
        (lambda m: m.pop("objects"), "has no list 'objects'"),
        (lambda m: m["objects"][1].pop("split"), "an entry of 'objects' is broken.*split"),
        (lambda m: m["objects"][1].update(split="all"), "split 'all' is not one of"),
        (lambda m: m["objects"][1]["objects"].update(path="../../secret"), "leaves the pack"),
        (lambda m: m["objects"][1]["objects"].update(path="/etc/passwd"), "leaves the pack"),
        (lambda m: m["objects"][1]["objects"].update(path="\0"), "cannot be that of a file"),
        (lambda m: m["objects"][1].update(objects=None), "is broken"),
        (lambda m: m["objects"].append(3), "is broken"),
    ],
)
def test_refuses_a_broken_manifest(pack: Pack, change: Callable[[dict], object], message: str) -> None:
    edit_manifest(pack.folder, change)
    with pytest.raises(InputError, match=f"manifest.json.*{message}"):
        Pack(pack.folder)


def test_refuses_an_object_that_the_manifest_calls_otherwise(pack: Pack) -> None:
    edit_manifest(pack.folder, lambda manifest: manifest["objects"][1].update(name="Family/renamed"))
    with pytest.raises(InputError, match=r"holds the object 'Family/\w+', but the manifest calls it 'Family/renamed'"):
        Pack(pack.folder).load("Family/renamed")


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe", b"[" * 10_000])
def test_refuses_a_manifest_that_is_not_json(pack: Pack, content: bytes) -> None:
    (pack.folder / "manifest.json").write_bytes(content)
    with pytest.raises(InputError, match=r"manifest\.json is not"):
        Pack(pack.folder)


def test_refuses_a_view_or_bin_without_a_size(tmp_path: Path) -> None:
    item = packed_object()
    scene = item.drops[0].scene
    huge = replace(scene, camera=replace(scene.camera, width=10**60))  # infinite as float32
    with np.errstate(over="ignore"):
        pack = write_pack(tmp_path, replace(item, drops=(replace(item.drops[0], scene=huge),)))
    with pytest.raises(InputError, match="is not an object of a pack"):
        pack.load(item.name)


def test_refuses_a_folder_without_a_manifest(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="name the folder of a pack"):
        Pack(tmp_path)


def test_refuses_to_write_outside_of_the_folder_or_what_is_not_finite(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.\./escaped\.safetensors' leaves the pack"):
        write_object(tmp_path / "pack", packed_object("../escaped"))
    item = packed_object()
    item.drops[1].scene.T_bin_object[0, 0, 3] = np.nan
    with pytest.raises(InputError, match="points, normals or poses hold NaN"):
        write_object(tmp_path / "pack", item)
    assert not (tmp_path / "pack").exists()
