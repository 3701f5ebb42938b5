"""Writing scenes as a BOP dataset: the same frames give the same bytes, and a scene appears whole or not at all."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt16

from kmn_jax.bop._files import SATURATED, json_by_id, millimetres, pixels, png_bytes
from kmn_jax.bop._frames import BopFrame, format_bin, format_camera, format_instance
from kmn_jax.errors import InputError, rigid_pose
from kmn_jax.files import write_whole
from kmn_jax.geometry import Camera

BIN_FILE = "scene_bin"  # ours: BOP knows no bins


def finest_depth_scale(farthest: float, unit: str) -> float:
    """Return the finest step of depth in mm, one of 1, 2 and 5 times a power of ten, that reaches as far as that."""
    wanted = float(farthest) * millimetres(unit) / (SATURATED - 1)
    if not 0 < wanted < math.inf:
        raise InputError(f"farthest is {farthest}, but must be a length above zero")
    power = math.floor(math.log10(wanted))
    steps = [float(f"{digit}e{exponent}") for exponent in range(power - 1, power + 2) for digit in (1, 2, 5)]
    return next(step for step in steps if step >= wanted)


def write_camera(folder: str | Path, camera: Camera, depth_scale: float) -> None:
    """Write camera.json, the sensor that scenes share."""
    values = {key: float(getattr(camera, key)) for key in ("fx", "fy", "cx", "cy")}
    sizes = {"width": int(camera.width), "height": int(camera.height)}
    content = json.dumps({**values, **sizes, "depth_scale": float(depth_scale)}, indent=2, sort_keys=True)
    write_whole(Path(folder) / "camera.json", f"{content}\n".encode())


def write_scene(
    folder: str | Path, split: str, scene_id: int, frames: Iterable[BopFrame], unit: str, depth_scale: float
) -> Path:
    """Write frames, whose lengths are in `unit`, as the images 0, 1, ... of a new scene, and return its folder.

    Depth is rounded to steps of `depth_scale` mm, so it is stored to half a step, and ends at 65,534 steps; see
    `finest_depth_scale`. Boxes, pixel counts and visible fractions that instances lack are taken from the frame's
    masks. Bins go to scene_bin.json, which other readers pass over. Raises InputError, and leaves nothing behind, for
    a scene that exists, a frame without instances, a pose that is not rigid, a depth that is negative, not finite or
    out of reach, and for masks that only some of the frames have.
    """
    factor, target = millimetres(unit), Path(folder) / split / f"{scene_id:06d}"
    if not 0 < depth_scale < math.inf:
        raise InputError(f"depth_scale is {depth_scale}, but must be above zero: it is the mm of one step")
    if scene_id < 0:
        raise InputError(f"scene_id is {scene_id}, but must be 0 or more")
    if target.exists():
        raise InputError(f"{target} exists already: remove it, or choose another scene_id")
    temporary = target.parent / f".{target.name}.writing"
    try:
        shutil.rmtree(temporary, ignore_errors=True)  # of a run that was killed
        (temporary / "depth").mkdir(parents=True)
        files: dict[str, dict[int, Any]] = {}
        for image_id, frame in enumerate(frames):
            try:
                entries = _write_frame(temporary, image_id, frame, factor, float(depth_scale))
            except InputError as error:
                raise InputError(f"scene {scene_id}, frame {image_id}: {error}") from None
            for name, entry in entries.items():
                files.setdefault(name, {})[image_id] = entry
        if not files:
            raise InputError(f"scene {scene_id} has no frames: give at least one")
        for name in ("mask", "mask_visib"):
            if name in files and len(files.pop(name)) < len(files["scene_gt"]):
                raise InputError(f"scene {scene_id}: only some frames have {name}: give it for all frames or for none")
        if not any(info for infos in files["scene_gt_info"].values() for info in infos):
            del files["scene_gt_info"]
        for name, images in files.items():
            (temporary / f"{name}.json").write_bytes(json_by_id(images))
        os.rename(temporary, target)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror}") from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return target


def dataset_digest(folder: str | Path) -> str:
    """Return the SHA-256 over the names and contents of all files under a folder, of images over their pixels.

    It does not depend on how a version of zlib compresses; an image that is damaged counts as its bytes are. Hidden
    files and folders, such as unfinished scenes, are passed over.
    """
    folder, digest = Path(folder), hashlib.sha256()
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    for name in (name for name in names if not any(part.startswith(".") for part in name.split("/"))):
        content = (folder / name).read_bytes()
        if name.endswith(".png"):
            with contextlib.suppress(InputError):
                image = pixels(folder / name)
                content = f"{image.shape} {image.dtype.str} ".encode() + image.tobytes()
        digest.update(f"{name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def _write_frame(scene: Path, image_id: int, frame: BopFrame, factor: float, depth_scale: float) -> dict[str, Any]:
    """Write a frame's images and return its entries by the name of the JSON file they belong to."""
    if frame.instances is None:
        raise InputError("it has no instances: a frame to be written needs them, if only ()")
    for index, instance in enumerate(frame.instances):
        if instance.object_id < 1:
            raise InputError(f"instance {index}: object_id is {instance.object_id}, but must be 1 or more")
        rigid_pose(instance.T_camera_object, f"instance {index}: T_camera_object")
    for name, pose in (("T_camera_world", frame.T_camera_world), ("T_camera_bin", frame.T_camera_bin)):
        if pose is not None:
            rigid_pose(pose, name)
    (scene / "depth" / f"{image_id:06d}.png").write_bytes(png_bytes(_depth_steps(frame.depth, factor, depth_scale)))
    formatted = [format_instance(instance, factor) for instance in frame.with_visibility().instances or ()]
    entries: dict[str, Any] = {
        "scene_camera": format_camera(frame, depth_scale, factor),
        "scene_gt": [truth for truth, _ in formatted],
        "scene_gt_info": [info for _, info in formatted],
    }
    if (bin_entry := format_bin(frame, factor)) is not None:
        entries[BIN_FILE] = bin_entry
    for name, masks in (("mask", frame.masks), ("mask_visib", frame.visible_masks)):
        if masks is not None:
            (scene / name).mkdir(exist_ok=True)
            for index, mask in enumerate(masks):
                (scene / name / f"{image_id:06d}_{index:06d}.png").write_bytes(png_bytes(mask))
            entries[name] = len(masks)
    return entries


def _depth_steps(depth: Float[np.ndarray, "h w"], factor: float, depth_scale: float) -> UInt16[np.ndarray, "h w"]:
    if not np.isfinite(depth).all() or (depth < 0).any():
        raise InputError("depth holds negative values, NaN or infinity: put 0 where nothing was measured")
    steps = np.round(depth.astype(np.float64) * (factor / depth_scale))
    if steps.max(initial=0) >= SATURATED or ((steps == 0) & (depth > 0)).any():
        raise InputError(
            f"depth reaches from {depth[depth > 0].min() * factor:g} to {depth.max() * factor:g} mm, but a depth_scale"
            f" of {depth_scale:g} mm can store {depth_scale:g} to {(SATURATED - 1) * depth_scale:g} mm: choose another"
        )
    return steps.astype(np.uint16)
