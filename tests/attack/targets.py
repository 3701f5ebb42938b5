"""What is attacked: for each format a folder of valid files, the ones that are damaged, and what reads them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.bins import read_targets
from experiments.evaluation.clouds import read_poses
from experiments.evaluation.predictions import Export
from kmn_jax.bop import BopDataset, bop_scan, bop_sizes
from kmn_jax.data import Pack
from kmn_jax.detection._calibration import calibration_beside, load_probabilities
from kmn_jax.detection._evidence import EVIDENCE
from kmn_jax.errors import InputError
from kmn_jax.io import read_mesh, read_pose, read_scan
from kmn_jax.io._meshes import CLOUD_SUFFIXES
from kmn_jax.io._scans import read_camera
from kmn_jax.models import load_model, load_released, released_file
from kmn_jax.objects import ObjectConfig, load_grasps, load_object, load_part
from kmn_jax.train import read_metrics
from kmn_jax.train._checkpoint import Checkpoints
from tests.attack import containers, mutations, samples
from tests.attack.mutations import Mutation
from tests.attack.trees import (
    bop_folder,
    checkpoint_folder,
    evaluation_folder,
    journal_folder,
    pack_folder,
    read_journal,
    targets_folder,
)

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Target:
    """A format. `share` is how many cases it gets beside the others: the slower, the fewer."""

    name: str
    prepare: Callable[[Path], None]  # writes valid files into an empty folder
    files: tuple[str, ...]  # of the folder, as patterns: each case damages one of them
    read: Callable[[Path, Path], Any]  # of the folder and the damaged file; raises InputError or returns finite values
    share: float = 1.0
    mutations: tuple[Mutation, ...] = ()  # beside those of bytes
    sign: Callable[[Path, Path], None] | None = None  # makes checksums fit what was damaged


def _sample(name: str) -> Callable[[Path], None]:
    def prepare(folder: Path) -> None:
        (folder / name).write_bytes(samples.samples()[name])
        (folder / "camera.json").write_text(samples.CAMERA)

    return prepare


def _mesh(folder: Path, path: Path) -> Any:
    mesh = read_mesh(path)
    assert len(mesh.vertices) > 0
    if len(mesh.triangles):
        assert 0 <= mesh.triangles.min() <= mesh.triangles.max() < len(mesh.vertices)
    else:
        assert path.suffix in CLOUD_SUFFIXES
    return mesh


def _scan(folder: Path, path: Path) -> Any:
    scan = read_scan(path, "mm", folder / "camera.json")
    assert len(scan.points) > 0
    return scan


def _object(folder: Path, path: Path) -> Any:
    found = load_object(path, config=ObjectConfig(num_points=64))
    assert found.diameter > 0
    return found


def _bop(folder: Path, path: Path) -> Any:
    data = BopDataset(folder, "test")
    problems = data.problems()
    assert all(str(problem) and "\n" not in str(problem) for problem in problems)
    frames = [data.frame(*key, masks=True) for key in data.usable()]
    models = [data.model(number) for number in (data.object_ids or ()) if not problems]
    image = folder / "test" / "000000" / "depth" / "000001.png"
    return frames, models, bop_scan(image), bop_sizes(image)


def _pack(folder: Path, path: Path) -> Any:
    pack = Pack(folder)
    for problem in pack.problems():
        raise InputError(problem)
    return [pack.load(name) for name in pack.names()]


def _sign_pack(folder: Path, path: Path) -> None:
    if path.suffix != ".safetensors":
        return
    manifest = json.loads((folder / "manifest.json").read_text())
    for entry in manifest["objects"]:
        for shard in filter(None, (entry["objects"], entry["visibility"])):
            content = (folder / shard["path"]).read_bytes()
            shard |= {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    (folder / "manifest.json").write_text(json.dumps(manifest))


def _checkpoint(folder: Path, path: Path) -> Any:
    from tests.train.snapshot_sample import abstract_state

    found = Checkpoints(folder / "checkpoints", report=lambda message: None).latest(abstract_state())
    assert found is not None  # the one before is whole
    return int(found.state.step), found.facts


def _sign_checkpoint(folder: Path, path: Path) -> None:
    record = path
    while record.parent.parent != folder / "checkpoints":
        record = record.parent
    record = record.parent / "record.json"
    if path == record:
        content = json.loads(record.read_bytes().decode("utf-8", "replace"))["content"]
    else:
        inner = json.loads(json.loads(record.read_text())["content"])
        inner["files"][str(path.relative_to(record.parent))] = hashlib.sha256(path.read_bytes()).hexdigest()
        content = json.dumps(inner)
    record.write_text(json.dumps({"sha256": hashlib.sha256(content.encode()).hexdigest(), "content": content}))


def _predictions(folder: Path, path: Path) -> Any:
    exported = Export.open(folder, {"data": "a", "methods": {"ours": {"rounds": 1}}}, overwrite=False)
    return exported.truth("box", 0.0), exported.read("ours", "box", 0.0)


def _card(folder: Path, path: Path) -> Any:
    part = load_part(path)
    return part, part.in_unit("m")


def _calibration(path: Path) -> None:
    """Write the released probabilities with few trees: damage strikes what is around them, too."""
    models = json.loads(calibration_beside(released_file()).read_bytes())
    for model in models.values():
        model |= {name: model[name][:3] for name in ("columns", "thresholds", "values")}
    path.write_text(json.dumps(models))


def _one(write: Callable[[Path], None], name: str) -> Callable[[Path], None]:
    return lambda folder: write(folder / name)


_NAME = "T_base_camera"
_POSE = [[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]
_TEXT = (mutations.mutated_numbers, mutations.mutated_lines)
_JSON = (mutations.mutated_tree, mutations.mutated_tree, mutations.mutated_numbers)
_ROWS = (mutations.mutated_rows, mutations.mutated_rows, mutations.mutated_numbers)
_HEADER = (mutations.mutated_header,)
_ZIP = (containers.mutated_zip, containers.mutated_zip)
_TENSORS = (containers.mutated_tensors, containers.mutated_tensors)
_FLOATS = (containers.mutated_floats,)
# What damages a file of samples beside bytes.
_MEANS: dict[str, tuple[Mutation, ...]] = {
    "text.stl": _TEXT,
    "binary.stl": _FLOATS,
    "mesh.obj": _TEXT,
    "text.ply": _TEXT,
    "binary.ply": _HEADER,
    "big.ply": _HEADER,
    "mixed.ply": _HEADER,
    "mesh.glb": (containers.mutated_glb, containers.mutated_glb),
    "binary_cloud.ply": _HEADER,
    "text_cloud.ply": _TEXT,
    "binary.pcd": _HEADER,
    "compressed.pcd": _HEADER,
    "text.pcd": _TEXT,
    "cloud.xyz": _TEXT,
    "cloud.xyzn": _TEXT,
    "points.npy": _HEADER,
    "organised.npy": _HEADER,
    "depth.npy": _HEADER,
    "points.npz": _ZIP,
    "depth.npz": _ZIP,
    "depth.png": (containers.mutated_png, containers.mutated_png),
    "depth.tiff": (),
    "lzw.tif": (),
    "deflate.tif": (),
}
_MESHES = ("binary.stl", "text.stl", "mesh.obj", "text.ply", "binary.ply", "big.ply", "mixed.ply", "mesh.glb")
_CLOUDS = ("binary_cloud.ply", "text_cloud.ply", "binary.pcd", "compressed.pcd", "text.pcd", "cloud.xyz", "cloud.xyzn")
_ARRAYS = tuple(_MEANS)[15:]


def _dashed(name: str) -> str:
    return name.replace(".", "-").replace("_", "-")


def targets() -> dict[str, Target]:
    """Return all formats by name."""
    shapes = [Target(f"mesh-{_dashed(name)}", _sample(name), (name,), _mesh, 1, _MEANS[name]) for name in _MESHES]
    clouds = [Target(f"cloud-{_dashed(name)}", _sample(name), (name,), _mesh, 0.5, _MEANS[name]) for name in _CLOUDS]
    scans = [
        Target(f"scan-{_dashed(name)}", _sample(name), (name,), _scan, 1, _MEANS[name]) for name in (*_CLOUDS, *_ARRAYS)
    ]
    objects = [
        Target(f"object-{_dashed(name)}", _sample(name), (name,), _object, 0.02, _MEANS.get(name, _TEXT))
        for name in ("binary.stl", "mesh.glb", "text.ply", "dense.xyz")
    ]
    torch = [
        Target(f"torch-{suffix}", _one(samples.authors_network, f"model.{suffix}"), (f"model.{suffix}",), read, 1, _ZIP)
        for suffix, read in (("pt", _released), ("t7", _released))
    ]
    bop = {
        "scene-gt": "test/000000/scene_gt.json",
        "scene-camera": "test/000000/scene_camera.json",
        "scene-gt-info": "test/000000/scene_gt_info.json",
        "scene-bin": "test/000000/scene_bin.json",
        "models-info": "models/models_info.json",
        "object-names": "models/object_names.json",
        "camera": "camera.json",
        "depth": "test/000000/depth/*.png",
        "mask": "test/000000/mask/*.png",
    }
    datasets = [
        Target(f"bop-{name}", bop_folder, (file,), _bop, 0.4, _JSON if file.endswith("json") else _MEANS["depth.png"])
        for name, file in bop.items()
    ]
    others = [
        Target("mesh-step", _sample("solid.step"), ("solid.step",), _mesh, 0.06, _TEXT),
        Target("scan-exr", _sample("depth.exr"), ("depth.exr",), _scan, 0.15, _HEADER),
        Target("camera", _sample("camera.json"), ("camera.json",), lambda _, path: read_camera(path), 1, _JSON),
        Target("camera-matrix", _sample("matrix.json"), ("matrix.json",), lambda _, path: read_camera(path), 1, _JSON),
        Target("card", _one(samples.card, "ball.kmn"), ("ball.kmn",), _card, 1.5, _TENSORS),
        Target("model", _one(samples.network, "model.safetensors"), ("*.safetensors",), _model, 1, _TENSORS),
        Target("authors", _one(samples.authors_network, "model.safetensors"), ("*",), _released, 0.6, _TENSORS),
        Target("calibration", _one(_calibration, "a.json"), ("a.json",), _probabilities, 1, _JSON),
        Target("pack-manifest", pack_folder, ("manifest.json",), _pack, 0.6, _JSON),
        Target("pack-shard", pack_folder, ("*/*.safetensors",), _pack, 0.8, _TENSORS, _sign_pack),
        Target("checkpoint", checkpoint_folder, ("checkpoints/step-00000020/**/*",), _checkpoint, 0.15, _JSON),
        Target("bop-targets", targets_folder, ("*.json",), lambda folder, _: read_targets(folder), 0.4, _JSON),
        Target("pack-journal", journal_folder, ("*",), lambda folder, _: read_journal(folder).records, 0.4, _ROWS),
        Target(
            "checkpoint-signed",
            checkpoint_folder,
            ("checkpoints/step-00000020/**/*",),
            _checkpoint,
            0.15,
            _JSON,
            _sign_checkpoint,
        ),
        Target("metrics", _one(_metrics, "metrics.jsonl"), ("*",), lambda folder, _: read_metrics(folder), 0.3, _ROWS),
        Target("predictions", evaluation_folder, ("*/*.safetensors",), _predictions, 0.6, _TENSORS),
        Target("recipe", evaluation_folder, ("recipe.json",), _predictions, 0.4, _JSON),
        Target("pose", _one(_pose, "a.json"), ("a.json",), lambda _, path: read_pose(path, _NAME), 0.5, _JSON),
        Target("pose-xyzw", _one(_place, "a.json"), ("a.json",), lambda _, path: read_pose(path, _NAME), 0.5, _JSON),
        Target("grasps", _one(_grasps, "a.json"), ("a.json",), lambda _, path: load_grasps(path), 1, _JSON),
        Target("poses-json", _one(_poses, "a.json"), ("a.json",), lambda _, path: read_poses(path), 0.4, _JSON),
        Target("poses-txt", _one(_poses, "a.txt"), ("a.txt",), lambda _, path: read_poses(path), 0.3, _TEXT),
    ]
    return {target.name: target for target in (*shapes, *clouds, *scans, *objects, *torch, *datasets, *others)}


def _model(folder: Path, path: Path) -> Any:
    return load_model(path).parameters


def _released(folder: Path, path: Path) -> Any:
    return load_released(path, samples.AUTHORS).parameters


def _probabilities(folder: Path, path: Path) -> Any:
    return load_probabilities(path, EVIDENCE)


def _metrics(path: Path) -> None:
    rows = [{"step": step, "split": "train", "loss": 1 / step} for step in (1, 2, 3)]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def _poses(path: Path) -> None:
    text = " ".join(str(number) for row in _POSE for number in row)
    path.write_text(json.dumps({"poses": [{"T_scene_object": _POSE}, _POSE]}) if path.suffix == ".json" else text)


def _pose(path: Path) -> None:
    path.write_text(json.dumps({_NAME: _POSE, "unit": "mm"}))


def _place(path: Path) -> None:
    path.write_text(json.dumps({"xyz": [0.5, 0, 1], "xyzw": [1, 0, 0, 0], "unit": "m"}))


def _grasps(path: Path) -> None:
    gripper = {
        "boxes": [{"center": [0, 0, -25], "size": [10, 10, 50]}],
        "fingers": {"size": [4, 12, 40], "reach": 3},
        "approach": 80,
    }
    ways = [
        {"name": "side", "width": 20, "xyz": [18, 0, -10], "xyzw": [0, 0, 0, 1]},
        {"width": 30, "T_object_grasp": _POSE},
    ]
    path.write_text(json.dumps({"unit": "mm", "gripper": gripper, "grasps": ways}))
