"""The test sets: 7 electronic and 7 industrial objects, each in 20 bins of 1 to 20 copies, rendered by ray casting.

They are BOP datasets, `outputs/test_sets/electronics` and `.../industrial`, one scene an object, one image a bin. They
are not part of the repository; `assets/test_sets.json` holds their digests with the versions that made them.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from experiments.kicad import catalogue_sources
from kmn_jax.bop import BopDataset, dataset_digest, finest_depth_scale, write_camera, write_models, write_scene
from kmn_jax.data import PackConfig, Source, bin_scenes, one_thread_a_process, rendered_frame
from kmn_jax.errors import InputError
from kmn_jax.files import write_whole
from kmn_jax.objects import ObjectModel, load_object
from kmn_jax.report import processor
from kmn_jax.simulate import PERFECT, RayMesh, SensorConfig, collision_shape

ASSETS = Path(__file__).parent / "assets"
DIGESTS = ASSETS / "test_sets.json"
SPLIT = "test"
CONFIG = PackConfig(random_seed=1)  # another seed than the training pack's
VALIDATION_CONFIG = PackConfig(random_seed=2, drops=6)
_LIBRARIES = ("cascadio", "jax", "mujoco", "numpy", "open3d", "scipy", "trimesh")


def industrial_sources() -> list[Source]:
    """Return the committed industrial parts."""
    return [Source(path.stem, "test", path) for path in sorted((ASSETS / "industrial").glob("*.stl"))]


def electronics_sources(models: Path | None, cache: Path) -> list[Source]:
    """Return the held-out electronic components; see `catalogue_sources`."""
    return [source for source in catalogue_sources(models, cache, None)[0] if source.split == "test"]


def validation_sources(models: Path | None, cache: Path) -> list[Source]:
    """Return the validation components of the training pack: what probabilities are fitted on."""
    return [source for source in catalogue_sources(models, cache, None)[0] if source.split == "validation"]


def build_test_set(
    folder: Path,
    sources: list[Source],
    config: PackConfig = CONFIG,
    sensor: SensorConfig = PERFECT,
    workers: int | None = None,
) -> str:
    """Write a test set, but for scenes that exist, and return its digest.

    Raises InputError if the folder cannot be written to or holds a test set of another recipe.
    """
    claim(folder, {"config": asdict(config), "sensor": asdict(sensor)})
    scenes = {object_id: (config, sensor, source) for object_id, source in enumerate(sources, start=1)}
    write_scenes(folder, _write_scene, scenes, [source.path for source in sources], workers)
    return dataset_digest(folder)


def write_scenes(
    folder: Path,
    write: Callable[..., None],
    scenes: Mapping[int, tuple[Any, ...]],
    parts: list[Path],
    workers: int | None,
) -> None:
    """Write a dataset's scenes, but for those that exist, then its models, numbered from 1, and its camera.

    A scene is written in a process of its own, by `write(folder, scene_id, *arguments)`.
    """
    from tqdm import tqdm

    missing = {scene_id: own for scene_id, own in scenes.items() if not (folder / SPLIT / f"{scene_id:06d}").exists()}
    one_thread_a_process()
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        made = [pool.submit(write, folder, scene_id, *own) for scene_id, own in missing.items()]
        for future in tqdm(as_completed(made), total=len(made), unit="scene", desc=folder.name):
            future.result()
        write_models(folder, dict(enumerate(pool.map(metric_model, parts), start=1)))
    frame = BopDataset(folder, SPLIT)[0]
    write_camera(folder, frame.camera, finest_depth_scale(float(frame.depth.max()), "mm"))


def claim(folder: Path, recipe: dict[str, Any], made: str = SPLIT, what: str = "a test set of another recipe") -> None:
    """Make the folder, or see that what it holds is of the same recipe; the recipe's file is hidden from digests.

    It holds something if `made` is in it. Raises InputError, which says `what`, if that is of another recipe, and if
    the folder cannot be written to.
    """
    text = json.dumps(recipe, indent=1) + "\n"
    file = folder / ".recipe.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / made).exists() and (not file.exists() or file.read_text(encoding="utf-8") != text):
            raise InputError(f"{folder} holds {what}: choose another folder, or delete it")
    except OSError as error:
        raise InputError(f"{folder} cannot be written to: {error.strerror}") from None
    write_whole(file, text.encode())


def verdict(name: str, digest: str) -> str:
    """Say how a set's digest compares with the one that the repository holds."""
    record = _record()
    recorded = record["sets"].get(name)
    if recorded is None:
        return f"{DIGESTS.name} has no digest to compare it with"
    if recorded == digest:
        return "as recorded"
    differing = {key: value for key, value in made_with().items() if record["made_with"].get(key) != value}
    reason = f"made with others ({differing})" if differing else "with the same versions: please report it"
    return f"differs from {DIGESTS.name}, {reason}"


def is_unexplained(name: str, digest: str) -> bool:
    """Tell whether a digest differs from the recorded one though the versions are the same."""
    record = _record()
    return record["sets"].get(name, digest) != digest and record["made_with"] == made_with()


def _record() -> dict[str, dict[str, str]]:
    if not DIGESTS.exists():
        return {"sets": {}, "made_with": {}}
    record: dict[str, dict[str, str]] = json.loads(DIGESTS.read_text(encoding="utf-8"))
    return record


def record_digests(digests: dict[str, str]) -> None:
    """Write digests into the repository, with the versions that they hold for; those of other versions go."""
    made, record = made_with(), _record()
    kept = record["sets"] if record["made_with"] == made else {}
    DIGESTS.write_text(json.dumps({"made_with": made, "sets": kept | digests}, indent=1) + "\n", encoding="utf-8")


def made_with() -> dict[str, str]:
    """Return what decides the last bit of a scene: library versions and the processor, which sums in its own order.

    Processors of one name may differ in how many numbers they add at once.
    """
    found = np.show_config(mode="dicts").get("SIMD Extensions", {}).get("found", [])
    made = {"machine": platform.machine(), "processor": processor(), "vectors": " ".join(found)}
    return made | {name: version(name) for name in _LIBRARIES}


def metric_model(path: Path) -> ObjectModel:
    """Return a part in metres; files that state no unit are in millimetres."""
    return load_object(path).in_unit("m").centred()


def _write_scene(folder: Path, object_id: int, config: PackConfig, sensor: SensorConfig, source: Source) -> None:
    model = metric_model(source.path)
    mesh = RayMesh(model.vertices, model.triangles)
    shape = collision_shape(model.vertices, model.triangles, config.hulls)
    scenes, _ = bin_scenes(shape, config, int(model.digest[:8], 16))
    noise = np.random.default_rng((config.random_seed, object_id)).spawn(len(scenes))
    frames = [rendered_frame(mesh, scene, object_id, sensor, rng) for scene, rng in zip(scenes, noise, strict=True)]
    farthest = max(float(frame.depth.max()) for frame in frames)
    write_scene(folder, SPLIT, object_id, frames, "m", finest_depth_scale(farthest, "m"))
