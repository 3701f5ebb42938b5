"""The work behind requests: preparing parts, and searching scans as `kmn detect` does."""

from __future__ import annotations

import hashlib
import secrets
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, Literal

import numpy as np

from kmn_jax.detection import (
    Clock,
    Detections,
    Effort,
    ForegroundOptions,
    OrientedBox,
    PoseEstimator,
    Scene,
    as_json,
    config_of,
)
from kmn_jax.errors import InputError, check_whole, number_list
from kmn_jax.objects import Part
from kmn_jax.serve._parts import PartStore
from kmn_jax.units import Unit, check_unit

_MOST_PICTURES = 16  # the last ones, which can be fetched
_PIECE = 1 << 20  # bytes
_LONGEST = 30  # letters of a file's name, and of its suffix: of up to 4 bytes each, where 255 bytes are allowed


@dataclass(frozen=True)
class Upload:
    """A file as it came: what it is called there, and its content."""

    name: str
    content: BinaryIO

    def digest(self) -> str:
        """Return the SHA-256 of the content."""
        digest = hashlib.sha256()
        for piece in self.pieces():
            digest.update(piece)
        return digest.hexdigest()

    def pieces(self) -> Iterator[bytes]:
        """Yield the content in pieces."""
        self.content.seek(0)
        while piece := self.content.read(_PIECE):
            yield piece


@dataclass(frozen=True)
class Question:
    """What to look for and where, as the flags of `kmn detect` of the same names say it."""

    scene: Upload
    camera: Upload | None = None
    background: Upload | None = None
    at: tuple[str, ...] = ()
    units: str = "auto"
    random_seed: int = 0
    roi: str | None = None
    plane: Literal["auto", "always", "never"] = "auto"
    effort: Effort = "usual"
    sensor: str | None = None
    top: int | None = None
    picture: bool = False


class Searches:
    """An estimator, the parts that it knows, and the pictures that it drew last. One thread at a time searches."""

    def __init__(self, estimator: PoseEstimator, weights: str, store: PartStore, folder: Path) -> None:
        """Uploaded files are written into `folder` alone, and only while they are read."""
        self.estimator, self.weights, self.store = estimator, weights, store
        self._folder = folder
        self._pictures: OrderedDict[str, bytes] = OrderedDict()

    def prepare(self, upload: Upload, units: str) -> Part:
        """Make a part of a CAD file, a cloud or a card."""
        with self._written(upload, "part") as path:
            return self.estimator.prepare(path, None if units == "auto" else check_unit(units))

    def part_of(self, upload: Upload, units: str) -> tuple[str, Part]:
        """Make a part of a file that came with a scan, or remember it; return also what it is called from then on."""
        called = f"{upload.name} {units}".encode()  # the file's name is the part's
        key = hashlib.sha256(called + upload.digest().encode()).hexdigest()
        part = self.store.find(key)
        if part is None:
            part = self.prepare(upload, units)
            self.store.remember(key, part)
        return key, part

    def search(self, part: Part, object_name: str, asked: Question) -> tuple[dict[str, Any], str | None]:
        """Return the poses of a part as JSON values, and what the picture is called if one was asked for."""
        if asked.top is not None:
            check_whole(asked.top, "top", 1)
        clock = Clock()
        with clock("scene"):
            scene, places = self._scene(part, asked)
        estimator = self.estimator
        if asked.effort != "usual":
            estimator = replace(estimator, config=config_of(asked.effort))
        found = estimator.detect(part, scene, at=places, random_seed=asked.random_seed, top=asked.top, clock=clock)
        facts = {"seed": asked.random_seed, "weights": self.weights, "model": part.model_digest}
        result = as_json(found, object_name, asked.scene.name, facts)
        return result, self._draw(scene, part, found) if asked.picture else None

    def picture(self, name: str) -> bytes | None:
        """Return a picture (PNG) that is still kept."""
        return self._pictures.get(name)

    def _scene(self, part: Part, asked: Question) -> tuple[Scene, np.ndarray | None]:
        places = [number_list(text, "at", 3) for text in asked.at]
        region: Any = None if asked.roi is None else tuple(number_list(asked.roi, "roi", 6, 9))
        if region is not None and len(region) == 9:
            region = OrientedBox.of_numbers(region)
        sensor = None if asked.sensor is None else np.array(number_list(asked.sensor, "sensor", 3))
        at = np.array(places) if places else None
        units: Unit | Literal["auto"] = "auto" if asked.units == "auto" else check_unit(asked.units)
        with self._written(asked.camera, "camera") as camera:
            empty = None
            if asked.background is not None:
                with self._written(asked.background, "background") as path:
                    empty = self.estimator.read(path, part, units, camera)
            options = ForegroundOptions(empty, region, asked.plane)
            with self._written(asked.scene, "scene") as path:
                scene = self.estimator.scene(
                    path, part, unit=units, camera=camera, sensor=sensor, at=at, background=options
                )
        return scene, at

    def _draw(self, scene: Scene, part: Part, found: Detections) -> str:
        from kmn_jax.viz import save_picture

        with TemporaryDirectory(dir=self._folder) as folder:
            path = Path(folder, "picture.png")
            save_picture(path, scene, part, found)
            name = secrets.token_urlsafe(16)
            self._pictures[name] = path.read_bytes()
        while len(self._pictures) > _MOST_PICTURES:
            self._pictures.popitem(last=False)
        return name

    @contextmanager
    def _written(self, upload: Upload | None, what: str) -> Iterator[Any]:
        """Write an upload where readers find it, and let errors call it by its own name."""
        if upload is None:
            yield None
            return
        with TemporaryDirectory(dir=self._folder) as folder:
            path = Path(folder, stored_name(upload.name, what))
            with path.open("xb") as file:
                file.writelines(upload.pieces())
            try:
                yield path
            except InputError as error:
                raise InputError(str(error).replace(f"{folder}/", "")) from None


def stored_name(name: str, otherwise: str) -> str:
    """Return a name that is safe as that of a file and as like to the one given as may be: readers go by its suffix."""
    last = name.replace("\\", "/").rpartition("/")[2]
    safe = "".join(letter if letter.isprintable() and letter != ":" else "_" for letter in last)
    stem, _, suffix = safe.rpartition(".") if "." in safe else (safe, "", "")
    stem = stem.lstrip(". ")[-_LONGEST:] or otherwise
    return f"{stem}.{suffix[:_LONGEST]}" if suffix else stem
