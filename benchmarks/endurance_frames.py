"""Frames for a run of many detections: parts, scans of several sizes and sensors as files, and faults of them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from kmn_jax.detection import PoseEstimator
from kmn_jax.objects import Part

_ASSETS = Path(__file__).parent.parent / "experiments" / "assets"
_PARTS = ("gear_motor", "idler", "shaft", "timing_pulley")  # of the CAD files that the repository carries
_SIZES = (600, 1500, 3000)  # points of a copy
_CELLS = 48  # of the grid that hides what lies behind, along a diameter
FAULTS = ("all NaN", "empty", "truncated", "another part")


@dataclass(frozen=True)
class Frame:
    """What a detection is called with; `at` are places to search, None for the whole scan."""

    name: str
    part: str
    scan: Path
    at: Float[np.ndarray, "k 3"] | None = None
    camera: Path | None = None
    unit: str = "mm"


def parts_of(estimator: PoseEstimator) -> dict[str, Part]:
    """Prepare the parts."""
    return {name: estimator.prepare(_ASSETS / "industrial" / f"{name}.stl") for name in _PARTS}


def small_frames(parts: dict[str, Part], folder: Path, random: np.random.Generator) -> list[Frame]:
    """Write scans of one or two copies of each part in several sizes, and return searches at places of them."""
    frames = []
    for name, part in parts.items():
        for number, size in enumerate(_SIZES):
            clouds = [_seen(part, size, copy, random) for copy in range(1 + number % 2)]
            points = np.concatenate(clouds).astype(np.float32)
            unit = ("mm", "m", "mm")[number]
            scan = folder / f"{name}_{size}.npy" if number else folder / f"{name}_{size}.xyz"
            points *= 0.001 if unit == "m" else 1
            if scan.suffix == ".npy":
                np.save(scan, points)
            else:
                np.savetxt(scan, points, fmt="%.5f")
            frames.append(Frame(scan.stem, name, scan, points[:1].astype(np.float64), unit=unit))
    return frames


def bin_frames(folder: Path) -> list[Frame]:
    """Copy the gear motors' depth images of the small test set, and return searches of all of them and of places."""
    data, frames = _ASSETS / "small_test_set" / "test" / "000002", []
    truth, cameras = (
        json.loads((data / f"scene_{name}.json").read_text(encoding="utf-8")) for name in ("gt", "camera")
    )
    for image in sorted((data / "depth").glob("*.png")):
        scan, camera = Path(shutil.copyfile(image, folder / image.name)), folder / f"{image.stem}.json"
        camera.write_text(json.dumps(cameras[str(int(image.stem))]))
        poses = truth[str(int(image.stem))]
        high = min((np.array(pose["cam_t_m2c"]) for pose in poses), key=lambda place: place[2])
        whole = Frame(f"bin {image.stem}", "gear_motor", scan, None, camera)
        frames += [whole, replace(whole, name=f"place in bin {image.stem}", at=high[None])]
    return frames


def faulty(frame: Frame, fault: str, folder: Path, parts: dict[str, Part]) -> Frame:
    """Return a frame with a fault; its file is written into the folder."""
    scan = folder / f"faulty{frame.scan.suffix}"
    match fault:
        case "another part":
            names = list(parts)
            return replace(frame, part=names[(names.index(frame.part) + 1) % len(names)])
        case "truncated":
            content = frame.scan.read_bytes()
            scan.write_bytes(
                content[: len(content) // 2] if scan.suffix != ".xyz" else content[: len(content) // 2 - 3]
            )
            if scan.suffix == ".xyz":  # a text is cut within a line: what is whole of it could be a scan
                scan.write_bytes(scan.read_bytes().rpartition(b"\n")[0] + b"\n1.0 2")
        case _:
            _write_void(frame, scan, np.nan if fault == "all NaN" else 0.0)
    return replace(frame, scan=scan)


def _write_void(frame: Frame, scan: Path, value: float) -> None:
    if scan.suffix == ".png":
        from PIL import Image

        with Image.open(frame.scan) as image:
            # Images of whole numbers have no NaN: what a sensor did not measure is zero or saturated.
            Image.fromarray(np.full(image.size[::-1], 65535 if np.isnan(value) else 0, dtype=np.uint16)).save(scan)
    elif scan.suffix == ".npy":
        np.save(scan, np.full((500, 3) if np.isnan(value) else (0, 3), value, dtype=np.float32))
    else:
        scan.write_text("nan nan nan\n" * 500 if np.isnan(value) else "")


def schedule(
    frames: list[Frame], bins: list[Frame], detections: int, random: np.random.Generator
) -> Iterator[tuple[Frame, str | None]]:
    """Yield frames, mostly small ones, and a fault for some of them; whole bins are few, as they take long."""
    places = [frame for frame in bins if frame.at is not None]
    wholes = [frame for frame in bins if frame.at is None]
    for _ in range(detections):
        kind = random.random()
        chosen = wholes if kind < 0.02 else places if kind < 0.1 else frames
        fault = str(random.choice(FAULTS)) if random.random() < 0.1 else None
        yield chosen[int(random.integers(len(chosen)))], fault


def _seen(part: Part, size: int, copy: int, random: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Return points of a turned copy in front of the sensor, without those on its back and behind others."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.random(random_state=int(random.integers(2**31))).as_matrix()
    center = np.array([1.5 * copy, 0.2 * copy, 6]) * part.diameter
    middle = (part.minimum + part.maximum) / 2
    points = (part.points - middle) @ turn.T + center
    normals = part.normals @ turn.T
    points = points[(points * normals).sum(axis=1) < 0]
    cell = np.floor((points[:, :2] / points[:, 2:]) * 6 * _CELLS).astype(int)
    _, group = np.unique(cell, axis=0, return_inverse=True)
    nearest = np.full(group.max() + 1, np.inf)
    np.minimum.at(nearest, group.ravel(), points[:, 2])
    points = points[points[:, 2] < nearest[group.ravel()] + 0.05 * part.diameter]
    noisy = points + random.normal(scale=0.002 * part.diameter, size=points.shape)
    order = np.argsort(np.linalg.norm(noisy[:, :2] - center[:2], axis=1))  # the middle first: it is searched at
    kept = np.append(order[:1], random.permutation(order[1:])[: size - 1])
    return np.asarray(noisy[kept])
