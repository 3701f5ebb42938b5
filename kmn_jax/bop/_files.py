"""The single files of a BOP dataset: strict JSON, depth images and masks, each fault with its file and entry."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped, UInt16

from kmn_jax.errors import InputError
from kmn_jax.io import ImageHeader, image_header, read_image
from kmn_jax.limits import check_bytes, parse_json
from kmn_jax.units import METRES, check_unit

SATURATED = 65535  # a 16-bit depth that did not fit, such as the background of BlenderProc: not a measurement
_T = TypeVar("_T")
_MOST_DIGITS = 18  # of an id
_DEPTH_MODES = ("I;16", "I;16L", "I;16B", "I", "F")


class BopFault(InputError):
    """A part of a dataset that cannot be used: a file, the entry in it ("" for all of it), and what is wrong.

    The ids are those of the frame, `image_id` None for all of a scene, both None for what concerns neither.
    """

    def __init__(
        self, file: Path, entry: str, what: str, scene_id: int | None = None, image_id: int | None = None
    ) -> None:
        super().__init__(file, entry, what, scene_id, image_id)
        self.file, self.entry, self.what, self.scene_id, self.image_id = file, entry, what, scene_id, image_id

    def __str__(self) -> str:
        return f"{self.file}: {self.entry}: {self.what}" if self.entry else f"{self.file} {self.what}"

    def of_frame(self, scene_id: int, image_id: int | None = None) -> BopFault:
        """Return the fault as that of a frame, or of a whole scene."""
        return BopFault(self.file, self.entry, self.what, scene_id, image_id)


@dataclass(frozen=True)
class Entry:
    """A JSON object, its file, and the name that messages give it. Its readers raise BopFault."""

    file: Path
    name: str
    values: Any

    def __post_init__(self) -> None:
        if not isinstance(self.values, dict):
            raise self.fault("must be a JSON object with named values")

    def fault(self, what: str) -> BopFault:
        """Return what is wrong with this entry, to be raised."""
        return BopFault(self.file, self.name, what)

    def make(self, kind: Callable[..., _T], *values: Any, **named: Any) -> _T:
        """Return what `kind` makes of values of this entry; an InputError becomes a fault of the entry."""
        try:
            return kind(*values, **named)
        except InputError as error:
            raise self.fault(str(error)) from None

    def numbers(self, key: str, count: int) -> Float[np.ndarray, " count"]:
        """Return a list of exactly `count` finite numbers."""
        value = self._value(key)
        if not isinstance(value, list) or len(value) != count:
            has = f"{len(value)} values" if isinstance(value, list) else "no list"
            raise self.fault(f"{key} must hold {count} numbers, but has {has}")
        return np.array([self._finite(key, number) for number in value], dtype=np.float64)

    def number(self, key: str) -> float:
        """Return a finite number."""
        return self._finite(key, self._value(key))

    def integer(self, key: str) -> int:
        """Return a whole number."""
        number = self.number(key)
        if number != int(number):
            raise self.fault(f"{key} is {number:g}, but must be a whole number")
        return int(number)

    def pose(self, frames: str, factor: float) -> Float[np.ndarray, "4 4"]:
        """Return the pose under the names of `pose_keys`, its lengths multiplied by `factor`."""
        rotation, translation = pose_keys(frames)
        pose = np.eye(4)
        pose[:3, :3] = self.numbers(rotation, 9).reshape(3, 3)
        pose[:3, 3] = self.numbers(translation, 3) * factor
        with np.errstate(over="ignore", invalid="ignore"):
            product, determinant = pose[:3, :3].T @ pose[:3, :3], np.linalg.det(pose[:3, :3])
        if not np.allclose(product, np.eye(3), rtol=0, atol=5e-3) or not determinant > 0:
            raise self.fault(f"{rotation} is not a rotation: its rows must be orthonormal and right-handed")
        return pose

    def _value(self, key: str) -> Any:
        if key not in self.values:
            raise self.fault(f"{key} is missing")
        return self.values[key]

    def _finite(self, key: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.fault(f"{key} holds {str(value)[:40]!r}, which is not a number")
        if not abs(value) <= sys.float_info.max:
            raise self.fault(f"{key} holds NaN, infinity or a number beyond them")
        return float(value)


def pose_keys(frames: str) -> tuple[str, str]:
    """Return the names of a pose's row-wise rotation and its translation, such as those from "m2c", model to camera."""
    return f"cam_R_{frames}", f"cam_t_{frames}"


def pose_entry(frames: str, pose: Float[np.ndarray, "4 4"], factor: float) -> dict[str, list[float]]:
    """Return a pose, its lengths multiplied by `factor`, under the names of `pose_keys`: what `Entry.pose` reads."""
    rotation, translation = pose_keys(frames)
    pose = pose.astype(np.float64)
    return {rotation: pose[:3, :3].ravel().tolist(), translation: (pose[:3, 3] * factor).tolist()}


def of_sensor(name: str, sensor: str | None, suffix: str = "") -> str:
    """Return the name of a file or folder, one of those of a sensor if the scene has several."""
    return f"{name}_{sensor}{suffix}" if sensor else f"{name}{suffix}"


def millimetres(unit: str) -> float:
    """Return how many millimetres one `unit` is, or raise InputError for an unknown one."""
    return METRES[check_unit(unit)] / METRES["mm"]


def read_json(file: Path) -> Any:
    """Return what a JSON file holds, NaN included, which `Entry` refuses by name; two values of one key are refused."""
    content = _content(file)
    try:
        return parse_json(content, _object)
    except ValueError as error:
        raise BopFault(file, "", f"is not valid JSON ({error}): write it again") from None


def read_json_by_id(file: Path) -> dict[int, Any]:
    """Return the entries of a JSON file whose keys are the ids of images or objects, in the order of the ids."""
    content = read_json(file)
    if not isinstance(content, dict):
        raise BopFault(file, "", "must hold a JSON object with an entry for each id")
    entries: dict[int, Any] = {}
    for key, value in content.items():
        if not (key.isascii() and key.isdigit()):
            raise BopFault(file, f"key {key[:40]!r}", "must be an id, a whole number")
        if len(key) > _MOST_DIGITS:
            raise BopFault(file, f"key {key[:40]!r}...", f"has more than {_MOST_DIGITS} digits, but must be an id")
        if int(key) in entries:
            raise BopFault(file, f"key {key[:40]!r}", "stands there twice")
        entries[int(key)] = value
    return dict(sorted(entries.items()))


def json_by_id(entries: Mapping[int, Any]) -> bytes:
    """Return a JSON file with one line for each id, keys sorted, and every float with all its digits."""
    lines = [f'  "{key}": {json.dumps(entries[key], sort_keys=True, allow_nan=False)}' for key in sorted(entries)]
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def files_by_id(folder: Path, suffixes: tuple[str, ...], prefix: str = "") -> dict[int, Path]:
    """Return a folder's files by the number between `prefix` and suffix; none if there is no such folder."""
    if not folder.is_dir():
        return {}
    files = {}
    for path in sorted(folder.iterdir()):
        number = path.stem.removeprefix(prefix)
        if path.suffix.lower() in suffixes and path.stem.startswith(prefix) and number.isascii() and number.isdigit():
            files[int(number)] = path
    return files


def image_size(file: Path) -> tuple[int, int]:
    """Return the width and height that an image file announces, without decoding it."""
    checked_file(file)
    header = _image_or_fault(image_header, file, file)
    return header.width, header.height


def read_depth(file: Path, factor: float) -> Float32[np.ndarray, "h w"]:
    """Return a depth image times `factor`, with 0 where nothing was measured: 0, saturated, negative or not finite.

    That is also what a factor makes of it which is too large for float32.
    """
    (mode, kind, *_), values = _read_image(file)
    if mode not in _DEPTH_MODES or values.ndim != 2:
        raise BopFault(file, "", f"has {mode} pixels, but a depth image has one channel of 16 or 32 bits")
    depth = values.astype(np.float64)
    measured = np.isfinite(depth) & (depth > 0)
    if mode.startswith("I;16") or kind == "PNG":
        measured &= depth != SATURATED
    with np.errstate(over="ignore"):
        found = (np.where(measured, depth, 0) * factor).astype(np.float32)
    return np.where(np.isfinite(found), found, np.float32(0))


def read_mask(file: Path) -> Bool[np.ndarray, "h w"]:
    """Return where a mask image is not black."""
    (mode, *_), values = _read_image(file)
    if values.ndim != 2:
        raise BopFault(file, "", f"has {mode} pixels, but a mask has one channel")
    return values != 0


def png_bytes(values: UInt16[np.ndarray, "h w"] | Bool[np.ndarray, "h w"]) -> bytes:
    """Return a PNG file: 16 bits for numbers, 0 and 255 for booleans. The same pixels give the same bytes."""
    from PIL import Image

    if values.dtype == np.bool_:
        values = np.where(values, np.uint8(255), np.uint8(0))
    file = io.BytesIO()
    Image.fromarray(values).save(file, "PNG", optimize=False, compress_level=6)
    return file.getvalue()


def pixels(file: Path) -> Shaped[np.ndarray, "..."]:
    """Return the stored values of an image file of any kind."""
    return _read_image(file)[1]


def _read_image(file: Path) -> tuple[ImageHeader, Shaped[np.ndarray, "..."]]:
    return _image_or_fault(read_image, _content(file), file)


def _image_or_fault(read: Callable[..., _T], source: Path | bytes, file: Path) -> _T:
    try:
        return read(source)
    except InputError as error:
        raise BopFault(file, "", f"{str(error).removeprefix('it ')}: write it again") from None


def _content(file: Path) -> bytes:
    try:
        check_bytes(checked_file(file).stat().st_size)
        return file.read_bytes()
    except BopFault:
        raise
    except InputError as error:
        raise BopFault(file, "", str(error).removeprefix("it ")) from None
    except OSError as error:
        raise BopFault(file, "", f"cannot be read: {error.strerror}") from None


def checked_file(file: Path) -> Path:
    """Return the path of a file that is there and not empty."""
    try:
        size = file.stat().st_size
    except FileNotFoundError:
        raise BopFault(file, "", "is missing") from None
    except OSError as error:
        raise BopFault(file, "", f"cannot be read: {error.strerror}") from None
    if size == 0:
        raise BopFault(file, "", "is empty (0 bytes): write it again")
    return file


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"two values for the key {next(key for key in keys if keys.count(key) > 1)[:80]!r}")
    return result
