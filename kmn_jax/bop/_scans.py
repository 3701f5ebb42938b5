"""One image of a BOP dataset as a scan: its camera is in the files of its scene, and so may be its true poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from kmn_jax.bop._files import millimetres, of_sensor
from kmn_jax.bop._frames import BopInstance
from kmn_jax.bop._models import read_models
from kmn_jax.bop._reader import FrameReader, Scene
from kmn_jax.errors import InputError
from kmn_jax.io import DepthCamera, Scan, depth_scan

_SUFFIXES = (".png", ".tif", ".tiff")
_SAME_SIZE = 0.03  # between the lengths of a part and of the same one in a dataset


def is_bop_image(path: str | Path) -> bool:
    """Tell whether a file is a depth image in the folder of a BOP scene, by its place alone: it may be broken."""
    return _scene_of(Path(path)) is not None


def bop_scan(path: str | Path, unit: str = "mm") -> tuple[Scan, tuple[BopInstance, ...] | None]:
    """Read DATASET/SPLIT/SCENE/depth/IMAGE.png with the scene's scene_camera.json; return it with its true poses.

    Lengths are in `unit`: those of the dataset are millimetres, by its format. The poses are those of scene_gt.json in
    the camera frame, None without that file. In a folder `depth_SENSOR` the image is one of that sensor, and the files
    are scene_camera_SENSOR.json and scene_gt_SENSOR.json. Raises InputError if the path is no such image, if anything
    of it is missing or broken, or if nothing in it was measured.
    """
    path = Path(path)
    factor, place = 1 / millimetres(unit), _scene_of(path)
    if place is None:
        raise InputError(
            f"{path} is not a depth image of a BOP scene: those lie in SCENE/depth/, beside SCENE/scene_camera.json"
        )
    folder, sensor = place
    scene = Scene(folder, sensor, ground_truth=(folder / of_sensor("scene_gt", sensor, ".json")).exists())
    reader = FrameReader(scene, int(path.stem), factor)
    if reader.depth_file.name != path.name and reader.depth_file.exists():
        other = f"{path} and {reader.depth_file.name} are both image {int(path.stem)} of their scene"
        raise InputError(f"{other}: remove one of them")
    frame = reader.read(masks=False)
    faults = [*scene.faults, *reader.faults]
    if faults or frame is None:
        raise InputError(f"{path} cannot be used: {faults[0]}")
    camera = frame.camera
    intrinsics = DepthCamera(camera.fx, camera.fy, camera.cx, camera.cy, 1.0, (camera.width, camera.height))
    try:
        return depth_scan(frame.depth, intrinsics, unit), frame.instances
    except InputError as error:
        raise InputError(f"{path} cannot be used: {error}") from None


def bop_files(path: str | Path) -> tuple[Path, ...]:
    """Return the files that are read with an image of a BOP scene; none for another scan."""
    place = _scene_of(Path(path))
    if place is None:
        return ()
    folder, sensor = place
    named = [folder / of_sensor(name, sensor, ".json") for name in ("scene_camera", "scene_gt")]
    return (*named, folder.parent.parent / "models" / "models_info.json")


def bop_scene_id(path: str | Path) -> int:
    """Return the number of an image's scene: the name of its folder, 0 if that is no number."""
    place = _scene_of(Path(path))
    name = "" if place is None else place[0].name
    return int(name) if name.isascii() and name.isdigit() else 0


def bop_sizes(path: str | Path) -> dict[int, tuple[float, float, float, float]]:
    """Return diameter and extents, in ascending order (mm), of the objects of an image's dataset.

    Those of which its models_info.json does not tell are left out.
    """
    place = _scene_of(Path(path))
    if place is None:
        return {}
    models, _ = read_models(place[0].parent.parent / "models", "mm")
    return {number: (model.diameter, *np.sort(model.size).tolist()) for number, model in models.items()}


def bop_object(
    path: str | Path,
    instances: tuple[BopInstance, ...] | None,
    diameter: float,
    extents: Float[np.ndarray, "3"],
) -> int | None:
    """Return which of the objects in an image a part of this diameter and extents (mm) is.

    One of another size, by the dataset's models_info.json, is not the part; of several that may be, none is known to
    be.
    """
    sizes, own = bop_sizes(path), (diameter, *np.sort(extents))
    objects = {instance.object_id for instance in instances or ()}
    alike = [number for number in objects if np.allclose(sizes.get(number, own), own, rtol=_SAME_SIZE)]
    return alike[0] if len(alike) == 1 else None


def _scene_of(path: Path) -> tuple[Path, str | None] | None:
    """Return the folder of an image's scene and the name of its sensor, None for a path of another kind."""
    path = path.absolute()  # it may be relative to a folder of the scene
    kind, _, sensor = path.parent.name.partition("_")
    if kind != "depth" or path.suffix.lower() not in _SUFFIXES or not (path.stem.isascii() and path.stem.isdigit()):
        return None
    folder = path.parent.parent
    return (folder, sensor or None) if (folder / of_sensor("scene_camera", sensor, ".json")).is_file() else None
