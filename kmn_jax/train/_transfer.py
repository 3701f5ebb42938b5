"""A run in a few small files, to be carried to another machine."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from kmn_jax.errors import InputError
from kmn_jax.files import write_whole
from kmn_jax.train._snapshot import Snapshot, as_bytes, join, pack, read_layout, unpack
from kmn_jax.train._step import TrainState

MANIFEST = "manifest.json"
FILE_LIMIT = 2**24  # bytes: every file is smaller

_FORMAT = "kmn_jax export 1"
_PIECE = 15 * 2**20  # bytes of arrays in a file; the rest is for its header
_PIECE_NAME = re.compile(r"state-\d+-of-\d+\.safetensors")


def export_snapshot(snapshot: Snapshot, folder: str | Path) -> list[Path]:
    """Write a snapshot as safetensors files and a manifest with their SHA-256; return their paths.

    Every file is smaller than `FILE_LIMIT`; arrays that are larger are cut. The manifest comes last: without it there
    is no export. Of several processes, one is to call this.

    Raises:
        InputError: the folder cannot be written to or holds an export already, or the facts are too long for a file.
    """
    folder, packed = Path(folder), pack(snapshot)
    if (folder / MANIFEST).exists():
        raise InputError(f"{folder} holds an export already: choose another folder")
    pieces = [save(piece) for piece in _pieces(packed.arrays)]
    files = {f"state-{number}-of-{len(pieces)}.safetensors": piece for number, piece in enumerate(pieces, start=1)}
    listed = [
        {"name": name, "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        for name, content in files.items()
    ]
    files[MANIFEST] = json.dumps({"format": _FORMAT, "record": packed.record(), "files": listed}, indent=1).encode()
    for name, content in files.items():
        if len(content) >= FILE_LIMIT:
            raise InputError(
                f"{name} would have {len(content)} bytes, but less than {FILE_LIMIT} are allowed: shorten the facts"
            )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}") from None
    for name, content in files.items():
        write_whole(folder / name, content)
    return [folder / name for name in files]


def import_snapshot(folder: str | Path, like: TrainState) -> Snapshot:
    """Return the snapshot that was exported to a folder; its arrays are placed as those of `like`.

    `like` is a state of the same config, concrete or abstract.

    Raises:
        InputError: a file is missing, damaged or of another export (all such are named), or the run is of another
            network or optimizer than `like`.
    """
    folder = Path(folder)
    record, files = _read_manifest(folder / MANIFEST)
    contents, problems = [], []
    for file in files:
        try:
            contents.append(_read_piece(folder, file))
        except InputError as error:
            problems.append(str(error))
    if problems:
        raise InputError(f"{folder} does not hold a whole export: {'; '.join(problems)}: copy these files again")
    try:
        packed = join(record, _arrays(contents, record))
    except InputError as error:
        raise InputError(f"{folder / MANIFEST} does not fit its files: {error}") from None
    try:
        return unpack(packed, like)
    except InputError as error:
        raise InputError(f"{folder}: {error}") from None


def _pieces(arrays: dict[str, np.ndarray]) -> list[dict[str, np.ndarray]]:
    """Share the arrays out among files: whole where they fit, else as stretches of bytes named `name#0`, `name#1`."""
    pieces: list[dict[str, np.ndarray]] = [{}]
    room = _PIECE
    for name, array in arrays.items():
        if array.nbytes <= _PIECE and array.dtype.kind != "V":  # safetensors wants dtypes of NumPy's own
            stretches = {name: array}
        else:
            content = as_bytes(array)
            stretches = {
                f"{name}#{i}": content[i * _PIECE : (i + 1) * _PIECE] for i in range(-(-array.nbytes // _PIECE))
            }
        for key, stretch in stretches.items():
            if stretch.nbytes > room:
                pieces.append({})
                room = _PIECE
            pieces[-1][key] = stretch
            room -= stretch.nbytes
    return pieces


def _arrays(contents: list[dict[str, np.ndarray]], record: dict[str, Any]) -> dict[str, np.ndarray]:
    layout = read_layout(record)
    stretches: dict[str, dict[int, bytes]] = {name: {} for name in layout}
    for content in contents:
        for key, stretch in content.items():
            name, _, number = key.partition("#")
            if name not in stretches:
                raise InputError(f"{name} is unknown to it")
            stretches[name][int(number or 0)] = as_bytes(stretch).tobytes()
    arrays = {}
    for name, (dtype, shape) in layout.items():
        joined = b"".join(stretches[name][number] for number in sorted(stretches[name]))
        if len(joined) != dtype.itemsize * int(np.prod(shape, dtype=np.int64)):
            raise InputError(f"{name} is cut short or missing")
        arrays[name] = np.frombuffer(joined, dtype).reshape(shape)
    return arrays


def _read_manifest(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    try:
        manifest = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{path} does not exist: give the folder of an exported run") from None
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{path} is damaged ({error}): copy it again") from None
    try:
        if manifest["format"] != _FORMAT:
            raise ValueError(f"its format is {manifest['format']!r}, not {_FORMAT!r}")
        files = [{"name": file["name"], "bytes": file["bytes"], "sha256": file["sha256"]} for file in manifest["files"]]
        strange = [file["name"] for file in files if not _PIECE_NAME.fullmatch(file["name"])]
        if strange:
            raise ValueError(f"it names {strange[0]!r}, which is no piece of an export")
        return dict(manifest["record"]), files
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is no manifest of an exported run, or is damaged: {error}") from None


def _read_piece(folder: Path, file: dict[str, Any]) -> dict[str, np.ndarray]:
    path = folder / file["name"]
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path.name} is missing") from None
    except OSError as error:
        raise InputError(f"{path.name} cannot be read ({error.strerror})") from None
    if len(content) != file["bytes"]:
        raise InputError(f"{path.name} has {len(content)} bytes instead of {file['bytes']}")
    if hashlib.sha256(content).hexdigest() != file["sha256"]:
        raise InputError(f"{path.name} is damaged or of another export (its SHA-256 differs)")
    try:
        arrays: dict[str, np.ndarray] = load(content)
        return arrays
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path.name} is no safetensors file ({error})") from None
