"""Training packs: objects as quantised surfels, with the poses of their copies in bins, on disk.

A pack is a folder: `manifest.json` names the objects with the size and SHA-256 of their files; `objects/` holds one
safetensors file an object (surfels, poses, bins, cameras), `visibility/` one more with visibility bits, which may be
left out where scenes are splatted instead. Positions take 16 bits a coordinate, directions 8.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int8, Int16, UInt8

from kmn_jax.errors import InputError, shown
from kmn_jax.files import read_safetensors, safetensors_bytes, write_whole
from kmn_jax.geometry import Camera
from kmn_jax.limits import parse_json
from kmn_jax.simulate import Bin, BinScene

FORMAT, VERSION = "kmn_jax pack", 1
SPLITS = ("train", "validation", "test")
_METADATA = "kmn_jax.pack"
_LEVELS = 32767


@dataclass(frozen=True, eq=False)
class Drop:
    """One bin scene of an object, and which surfels its camera sees: 8 a byte, the lowest bit first."""

    scene: BinScene
    bits: UInt8[np.ndarray, "n m8"] | None = None
    bin_bits: UInt8[np.ndarray, " b8"] | None = None  # of `kmn_jax.simulate._splat.bin_surfels`


@dataclass(frozen=True, eq=False)
class PackedObject:
    """An object of a pack. Lengths are in metres.

    The surfels are in farthest-point order: any first part of them covers the object evenly, so the first K are its
    keypoints.
    """

    name: str
    split: str
    diameter: float
    area: float
    points: Float[np.ndarray, "m 3"]
    normals: Float[np.ndarray, "m 3"]
    drops: tuple[Drop, ...]
    digest: str  # SHA-256 of the file that the object comes from


@dataclass(frozen=True)
class Shard:
    """A file of a pack: path within it, bytes, SHA-256."""

    path: str
    size: int
    sha256: str


@dataclass(frozen=True)
class Entry:
    """What the manifest says of an object."""

    name: str
    split: str
    objects: Shard
    visibility: Shard | None


class Pack:
    """A pack opened for reading; objects are read, checked against their checksum and decoded one at a time."""

    def __init__(self, folder: str | Path) -> None:
        """Read the manifest. Raises InputError if it is missing, broken, or of another format or version."""
        self.folder = Path(folder)
        self.manifest = _read_manifest(self.folder / "manifest.json")
        try:
            self.entries = {entry.name: entry for entry in map(read_entry, self.manifest["objects"])}
        except (KeyError, TypeError, ValueError) as error:
            reason = shown(repr(error))
            raise InputError(
                f"{self.folder / 'manifest.json'}: an entry of 'objects' is broken ({reason}): build the pack again"
            ) from None

    def names(self, split: str | None = None) -> list[str]:
        """Return the names of the objects, of one split or all, in the manifest's order."""
        if split not in (None, *SPLITS):
            raise InputError(f"split {split!r} is not known: use one of {', '.join(SPLITS)}")
        return [entry.name for entry in self.entries.values() if split in (None, entry.split)]

    def load(self, name: str, visibility: bool = True) -> PackedObject:
        """Return an object, with its visibility bits if the pack has them and they are asked for.

        Raises InputError naming the file if it is missing, or differs from its checksum.
        """
        if name not in self.entries:
            raise InputError(
                f"{self.folder} has no object {shown(repr(name))}: its manifest lists {len(self.entries)} others"
            )
        entry = self.entries[name]
        path = self.folder / entry.objects.path
        result = _decode(*read_safetensors(self._checked(entry.objects)), path)
        if result.name != name:
            raise InputError(
                f"{path} holds the object {shown(repr(result.name))}, but the manifest calls it {shown(repr(name))}:"
                " build or copy the pack again"
            )
        if not visibility or entry.visibility is None:
            return result
        tensors, _ = read_safetensors(self._checked(entry.visibility))
        try:
            drops = tuple(
                replace(drop, bits=tensors[f"bits{index}"], bin_bits=tensors[f"bin_bits{index}"])
                for index, drop in enumerate(result.drops)
            )
        except KeyError as error:
            raise InputError(f"{self.folder / entry.visibility.path} lacks {error}: build it again") from None
        return replace(result, drops=drops)

    def problems(self) -> list[str]:
        """Return what is wrong with the files of the pack: one sentence for each that is missing or damaged."""
        found = []
        for entry in self.entries.values():
            for shard in filter(None, (entry.objects, entry.visibility)):
                try:
                    self._checked(shard)
                except InputError as error:
                    found.append(str(error))
        return found

    def _checked(self, shard: Shard) -> Path:
        path = self.folder / shard.path
        try:
            content = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}, a file of the pack, cannot be read: {error.strerror}") from None
        if hashlib.sha256(content).hexdigest() != shard.sha256:
            raise InputError(
                f"{path} does not match the manifest's checksum ({len(content)} bytes, {shard.size} expected):"
                " it is damaged or of another build; build or copy it again"
            )
        return path


def quantised(item: PackedObject) -> PackedObject:
    """Return the object as it will be read back, without bits: visibility must be found for these surfels and poses."""
    return _decode(*_encode(item), Path(item.name))


def write_object(folder: str | Path, item: PackedObject) -> Entry:
    """Write the files of one object into a pack's folder and return its entry for the manifest.

    Give the object as it was made, not read back: rounding twice may differ from once. Raises InputError for a name
    that is not a path within the folder, and for values that are not finite.
    """
    _check_inside(f"{item.name}.safetensors")
    poses = [array for drop in item.drops for array in (drop.scene.T_bin_object, drop.scene.T_camera_bin)]
    if not all(np.isfinite(array).all() for array in (item.points, item.normals, *poses)):
        raise InputError(f"{item.name}: points, normals or poses hold NaN or infinite values")
    objects = _write_shard(Path(folder), "objects", item.name, *_encode(item))
    bits: dict[str, np.ndarray] = {}
    for index, drop in enumerate(item.drops):
        if drop.bits is None or drop.bin_bits is None:
            return Entry(item.name, item.split, objects, None)
        bits |= {f"bits{index}": drop.bits, f"bin_bits{index}": drop.bin_bits}
    return Entry(item.name, item.split, objects, _write_shard(Path(folder), "visibility", item.name, bits, {}))


def write_manifest(folder: str | Path, entries: list[Entry], **facts: Any) -> None:
    """Write the manifest of a pack: the entries, and facts such as the recipe, the licence and what was rejected."""
    content = {"format": FORMAT, "version": VERSION, "unit": "m", **facts, "objects": [asdict(e) for e in entries]}
    write_whole(Path(folder) / "manifest.json", json.dumps(content, indent=1).encode() + b"\n")


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): name the folder of a pack") from None
    except ValueError as error:
        raise InputError(f"{path} is not valid JSON ({error}): build or copy the pack again") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise InputError(f"{path} is not the manifest of a pack: its 'format' is not {FORMAT!r}")
    if manifest.get("version") != VERSION:
        raise InputError(
            f"{path} has version {shown(manifest.get('version'))}, but this kmn_jax reads version {VERSION}:"
            " build it again"
        )
    if not isinstance(manifest.get("objects"), list):
        raise InputError(f"{path} has no list 'objects': build or copy the pack again")
    return manifest


def read_entry(fields: dict[str, Any]) -> Entry:
    """Return an entry from its JSON. Raises KeyError, TypeError or ValueError if it is broken."""
    objects, visibility = fields["objects"], fields["visibility"]
    entry = Entry(
        fields["name"], fields["split"], Shard(**objects), None if visibility is None else Shard(**visibility)
    )
    for shard in filter(None, (entry.objects, entry.visibility)):
        _check_inside(shard.path)
    if entry.split not in SPLITS:
        raise ValueError(f"split {shown(repr(entry.split))} is not one of {', '.join(SPLITS)}")
    return entry


def _check_inside(path: str) -> None:
    if "\0" in path:
        raise InputError(f"path {shown(repr(path))} cannot be that of a file")
    if Path(path).is_absolute() or ".." in Path(path).parts:
        raise InputError(f"path {shown(repr(path))} leaves the pack")


def _write_shard(folder: Path, kind: str, name: str, tensors: dict[str, np.ndarray], metadata: dict[str, str]) -> Shard:
    content = safetensors_bytes(tensors, metadata)
    relative = Path(kind) / f"{name}.safetensors"
    (folder / relative).parent.mkdir(parents=True, exist_ok=True)
    write_whole(folder / relative, content)
    return Shard(relative.as_posix(), len(content), hashlib.sha256(content).hexdigest())


def _encode(item: PackedObject) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    from scipy.spatial.transform import Rotation

    low, high = item.points.min(axis=0).astype(np.float64), item.points.max(axis=0).astype(np.float64)
    middle, half = (low + high) / 2, float((high - low).max() / 2)
    scenes = [drop.scene for drop in item.drops]
    poses = np.concatenate([scene.T_bin_object for scene in scenes]) if scenes else np.zeros((0, 4, 4))
    # The object's own origin may lie far off; that of its bounding box stays in the bin.
    centers = poses[:, :3, :3] @ middle + poses[:, :3, 3]
    reach = max(float(np.abs(centers).max(initial=0)), half)
    cameras = np.stack([scene.T_camera_bin for scene in scenes]) if scenes else np.zeros((0, 4, 4))
    views = [[c.fx, c.fy, c.cx, c.cy, c.width, c.height] for c in (scene.camera for scene in scenes)]
    bins = [[b.length, b.width, b.height, b.thickness] for b in (scene.bin for scene in scenes)]
    tensors = {
        "surfel_positions": _steps(item.points - middle, half),
        "surfel_normals": _octahedral(item.normals),
        "copies": np.array([len(scene.T_bin_object) for scene in scenes], np.uint8),
        "rotations": _steps(Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True), 1.0),
        "positions": _steps(centers, reach),
        "cameras": np.concatenate(
            [Rotation.from_matrix(cameras[:, :3, :3]).as_quat(scalar_first=True), cameras[:, :3, 3]], axis=1
        ).astype(np.float32),
        "views": np.array(views, np.float32).reshape(-1, 6),
        "bins": np.array(bins, np.float32).reshape(-1, 4),
    }
    facts = {
        "name": item.name,
        "split": item.split,
        "diameter": item.diameter,
        "area": item.area,
        "middle": middle.tolist(),
        "half": half,
        "reach": reach,
        "digest": item.digest,
    }
    return tensors, {_METADATA: json.dumps(facts)}


def _decode(tensors: dict[str, np.ndarray], metadata: dict[str, str], path: Path) -> PackedObject:
    from scipy.spatial.transform import Rotation

    try:
        facts = parse_json(metadata[_METADATA])
        middle = np.array(facts["middle"])
        rotations = Rotation.from_quat(tensors["rotations"] / _LEVELS, scalar_first=True).as_matrix()
        centers = tensors["positions"] * (facts["reach"] / _LEVELS)
        poses = _poses(rotations, centers - rotations @ middle)
        cameras = tensors["cameras"].astype(np.float64)
        T_camera_bin = _poses(Rotation.from_quat(cameras[:, :4], scalar_first=True).as_matrix(), cameras[:, 4:])
        ends = np.cumsum(tensors["copies"], dtype=np.int64)
        drops = []
        for index, (end, copies) in enumerate(zip(ends, tensors["copies"], strict=True)):
            fx, fy, cx, cy, width, height = tensors["views"][index].tolist()
            camera = Camera(fx, fy, cx, cy, round(width), round(height))
            scene = BinScene(
                Bin(*tensors["bins"][index].tolist()), poses[end - copies : end], camera, T_camera_bin[index]
            )
            drops.append(Drop(scene))
        points = (tensors["surfel_positions"] * (facts["half"] / _LEVELS) + middle).astype(np.float32)
        numbers = (points, poses, T_camera_bin, tensors["views"], tensors["bins"], facts["diameter"], facts["area"])
        if not all(np.isfinite(values).all() for values in numbers):
            raise ValueError("values that are not finite")
        return PackedObject(
            name=facts["name"],
            split=facts["split"],
            diameter=facts["diameter"],
            area=facts["area"],
            points=points,
            normals=_from_octahedral(tensors["surfel_normals"]),
            drops=tuple(drops),
            digest=facts["digest"],
        )
    except (KeyError, IndexError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path} is not an object of a pack ({shown(repr(error))}): build it again") from None


def _poses(rotations: Float[np.ndarray, "n 3 3"], translations: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4 4"]:
    result = np.tile(np.eye(4), (len(rotations), 1, 1))
    result[:, :3, :3], result[:, :3, 3] = rotations, translations
    return result


def _steps(values: Float[np.ndarray, "n c"], reach: float) -> Int16[np.ndarray, "n c"]:
    return np.clip(np.rint(values * (_LEVELS / reach)), -_LEVELS, _LEVELS).astype(np.int16)


def _octahedral(normals: Float[np.ndarray, "m 3"]) -> Int8[np.ndarray, "m 2"]:
    """Map unit vectors to the square: the octahedron |x| + |y| + |z| = 1 with its lower half folded out."""
    flat = normals[:, :2] / np.abs(normals).sum(axis=1, keepdims=True)
    folded = (1 - np.abs(flat[:, ::-1])) * np.where(flat < 0, -1, 1)
    return np.rint(np.where(normals[:, 2:] < 0, folded, flat) * 127).astype(np.int8)


def _from_octahedral(codes: Int8[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
    flat = codes.astype(np.float32) / np.float32(127)
    z = 1 - np.abs(flat).sum(axis=1, keepdims=True)
    folded = (1 - np.abs(flat[:, ::-1])) * np.where(flat < 0, np.float32(-1), np.float32(1))
    vectors = np.concatenate([np.where(z < 0, folded, flat), z], axis=1)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
