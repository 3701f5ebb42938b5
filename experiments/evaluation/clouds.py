"""Somebody else's scans with poses: clouds or depth images in a folder, and a file of poses for each of them.

A file of poses belongs to the scan of the same name, or of the same number (`Scene3.pcd`, `trans3.txt`); one that is
alone belongs to a scan that is alone. It is text of 4 x 4 numbers, pose after pose, or JSON: a list of matrices, or an
object whose "poses" are matrices or objects with "T_scene_object". Poses map the CAD file's points into the scan.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from kmn_jax.errors import InputError, rigid_pose

_SCANS = {".ply", ".pcd", ".xyz", ".npy", ".npz", ".png", ".tif", ".tiff", ".exr"}
_POSES = {".txt", ".json"}
_MESHES = {".stl", ".obj", ".glb", ".step", ".stp"}
_CAMERA = "camera.json"


def scans_with_poses(folder: Path, cad: Path | None = None) -> list[tuple[Path, Float[np.ndarray, "i 4 4"]]]:
    """Return scans of a folder, but for the CAD file, in the order of their numbers, with poses in their files' unit.

    Raises InputError if there are none, or if it is not clear which file of poses belongs to a scan.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: name one that holds scans with files of poses")
    files = sorted(folder.iterdir(), key=_numbers)
    meshes = [cad.resolve()] if cad is not None else []
    scans = [path for path in files if path.suffix.lower() in _SCANS and path.resolve() not in meshes]
    texts = [path for path in files if path.suffix.lower() in _POSES and path.name != _CAMERA and not _is_note(path)]
    if not scans or not texts:
        what = "scan (PLY, PCD, XYZ, NPY, NPZ, PNG, TIFF, EXR)" if not scans else "file of poses (TXT, JSON)"
        raise InputError(f"{folder} holds no {what}")
    return [(scan, read_poses(_poses_of(scan, scans, texts))) for scan in scans]


def mesh_of(folder: Path) -> Path:
    """Return the only CAD file of a folder. Raises InputError if there is none, or more than one."""
    found = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in _MESHES]
    if len(found) != 1:
        raise InputError(f"{folder} holds {len(found)} CAD files, but there must be one: name it with --object")
    return found[0]


def camera_of(folder: Path) -> Path | None:
    """Return the folder's camera file, if there is one."""
    return folder / _CAMERA if (folder / _CAMERA).is_file() else None


def read_poses(path: Path) -> Float[np.ndarray, "i 4 4"]:
    """Read a file of poses. Raises InputError if it holds none, or what is no rigid pose."""
    try:
        text = path.read_text(encoding="utf-8")
        numbers = _from_json(json.loads(text)) if path.suffix.lower() == ".json" else _from_text(text)
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(f"{path} holds no poses that can be read ({str(error)[:80]})") from None
    if numbers.ndim != 3 or numbers.shape[1:] != (4, 4) or not len(numbers):
        raise InputError(f"{path} holds numbers of shape {numbers.shape}, but must hold matrices of 4 x 4")
    for row, pose in enumerate(numbers):
        try:
            rigid_pose(pose, f"pose {row + 1}")
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    return numbers


def _from_text(text: str) -> np.ndarray:
    numbers = np.array([float(word) for word in re.split(r"[\s,;]+", text) if word])
    return numbers.reshape(-1, 4, 4) if len(numbers) % 16 == 0 else numbers


def _from_json(content: Any) -> np.ndarray:
    listed = content["poses"] if isinstance(content, dict) else content
    return np.array([one["T_scene_object"] if isinstance(one, dict) else one for one in listed], dtype=np.float64)


def _poses_of(scan: Path, scans: list[Path], texts: list[Path]) -> Path:
    for found in (
        [path for path in texts if path.stem == scan.stem],
        [path for path in texts if _numbers(path)[0] == _numbers(scan)[0] != ()],
        texts if len(scans) == 1 else [],
    ):
        if len(found) == 1:
            return found[0]
    raise InputError(f"it is not clear which file of poses belongs to {scan}: give it the same name or number")


def _numbers(path: Path) -> tuple[tuple[int, ...], str]:
    return tuple(int(digits) for digits in re.findall(r"\d+", path.stem)), path.name


def _is_note(path: Path) -> bool:
    return path.suffix.lower() == ".txt" and path.stem.lower() in ("readme", "license", "notes")
