"""Detection in somebody else's scans with poses: `python -m experiments.detect_clouds FOLDER [--sensor X,Y,Z]`.

The folder is one as `python -m experiments.evaluate clouds` takes: scans, a CAD file, and a file of poses for each scan
(see experiments/evaluation/clouds.py). The whole scan is given and nothing else. A pose is right if its ADI is below a
tenth of the diameter; recall is that of copies of which enough was measured. All copies have to have poses in the
files, those that are hardly seen too: what is found of one without counts as wrong.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from jaxtyping import Float
from tqdm import tqdm

from experiments.bins import TrueImage
from experiments.detect_bins import Tally
from experiments.evaluation.clouds import camera_of, mesh_of, scans_with_poses
from experiments.evaluation.sources import OBJECT
from kmn_jax.bop import FrameKey
from kmn_jax.detection import PoseEstimator
from kmn_jax.errors import InputError, number_list
from kmn_jax.io import read_scan
from kmn_jax.objects import ObjectModel, load_object
from kmn_jax.programs import call_in_place
from kmn_jax.released import RELEASED
from kmn_jax.report import check_target, print_table, write_json
from kmn_jax.simulate import RayMesh
from kmn_jax.units import METRES

_UNIT = "mm"
_NEAR = 0.03  # diameters: a point of a copy's surface that is so near to a measured one was measured
_LEAST_COSINE = 0.05  # between a surface's normal and the way to the sensor: flatter views measure nothing
_ALL = "all"


@dataclass(frozen=True)
class Options:
    """What to detect in, by what."""

    folder: Annotated[Path, tyro.conf.Positional]
    object: Path | None = None  # the CAD file; the only one in the folder unless given
    camera: Path | None = None  # of depth images; camera.json in the folder unless given
    sensor: str | None = None  # of clouds: X,Y,Z in their frame; the origin unless given
    units: Literal["mm", "cm", "m", "in"] = "mm"  # of scans, poses, sensor and CAD file
    weights: str = RELEASED
    json: Path | None = None


def measured_shares(
    model: ObjectModel,
    poses: Float[np.ndarray, "i 4 4"],
    points: Float[np.ndarray, "n 3"],
    sensor: Float[np.ndarray, "3"],
) -> Float[np.ndarray, " i"]:
    """Return which share was measured of what a sensor would see of each copy if it were alone, by area in the picture.

    All is in one frame and unit. What lies upon a copy and was measured close above it counts as the copy's own.
    """
    from scipy.spatial import cKDTree

    mesh, tree = RayMesh(model.vertices, model.triangles), cKDTree(points)
    shares = []
    for pose in poses:
        surface = model.points @ pose[:3, :3].T + pose[:3, 3]
        normals = model.normals @ pose[:3, :3].T
        rays = sensor - surface
        length = np.linalg.norm(rays, axis=1)
        cosine = (rays * normals).sum(axis=1) / np.maximum(length, np.finfo(float).tiny)
        seen = cosine > _LEAST_COSINE
        lifted = surface[seen] + _NEAR / 10 * model.diameter * normals[seen]  # off the triangle that it is on
        seen[seen] = ~mesh.blocks(pose, lifted, sensor)
        measured = np.isfinite(tree.query(surface, distance_upper_bound=_NEAR * model.diameter)[0])
        area = np.where(seen, cosine / length**2, 0.0)
        shares.append(area[measured].sum() / max(area.sum(), np.finfo(float).tiny))
    return np.array(shares)


def run(options: Options) -> list[dict[str, Any]]:
    """Detect, print and return the numbers."""
    check_target(options.json)
    scans = scans_with_poses(options.folder, options.object)
    cad = options.object or mesh_of(options.folder)
    camera = options.camera or camera_of(options.folder)
    scale = METRES[options.units] / METRES[_UNIT]
    sensor = None if options.sensor is None else np.array(number_list(options.sensor, "sensor", 3)) * scale
    estimator = PoseEstimator.from_pretrained(options.weights)
    part = estimator.prepare(cad, options.units).in_unit(_UNIT)
    model = load_object(cad, options.units, OBJECT).in_unit(_UNIT)
    tallies = {_ALL: Tally()}
    for row, (path, poses) in enumerate(tqdm(scans, unit="scan")):
        truth = poses.copy()
        truth[:, :3, 3] *= scale
        scan = read_scan(path, options.units, camera).in_unit(_UNIT)
        shares = measured_shares(model, truth, scan.points, np.zeros(3) if sensor is None else sensor)
        found = estimator.detect(part, scan, sensor=sensor)
        tallies[path.name] = Tally.of(TrueImage(FrameKey(0, row), part, (), truth, shares), found)
        tallies[_ALL].extend(tallies[path.name])
    rows = [_row(name, tally, estimator.config.accepted) for name, tally in tallies.items()]
    print_table(f"Detection in {options.folder.name}", rows)
    write_json(options.json, {"scans": rows})
    return rows


def _row(name: str, tally: Tally, accepted: float) -> dict[str, Any]:
    """Return what was found, and how exactly."""
    right, probability = np.array(tally.right, dtype=bool), np.array(tally.probability)
    numbers = tally.row(name, "", accepted)
    return {
        "scan": name,
        "copies": tally.copies,
        "listed": tally.num_found(0.0),
        "recall": numbers["recall"],
        "accepted": numbers["accepted"],
        "precision": numbers["precision"],
        "most probable wrong": float(probability[~right].max(initial=0.0)),
        **{key: numbers[key] for key in ("turned, degrees, median", "shifted, mm, median", "median s")},
    }


if __name__ == "__main__":
    call_in_place()
    try:
        run(tyro.cli(Options))
    except InputError as problem:
        sys.exit(f"error: {problem}")
