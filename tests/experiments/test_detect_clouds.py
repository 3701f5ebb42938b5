"""Whole scans of somebody else's: what was measured of each copy, and what counts as found."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from experiments.detect_clouds import Options, measured_shares, run
from experiments.solids import box
from kmn_jax.detection import PoseEstimator
from kmn_jax.errors import InputError
from kmn_jax.io import Scan
from kmn_jax.objects import ObjectConfig, Part, load_object, object_from_mesh
from tests.reference.meshes import pose
from tests.reference.parts import part_of

SIZE = np.array([40.0, 24.0, 16.0])
MESH = box((0, 0, 0), tuple(SIZE))
TOP = pose((0.0, 0.0, 500.0), np.diag([1.0, -1.0, -1.0]))  # looked at from above: its upper face, and nothing else
BESIDE = pose((200.0, 0.0, 500.0), np.diag([1.0, -1.0, -1.0]))


def upper_face(T: np.ndarray, share: float = 1.0) -> np.ndarray:
    """Return points on such a share of a copy's upper face, 1 mm apart."""
    x, y = np.meshgrid(np.arange(0, share * SIZE[0]), np.arange(0, SIZE[1]))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, SIZE[2])], axis=1)
    return points @ T[:3, :3].T + T[:3, 3]


def test_the_share_of_a_copy_that_was_measured() -> None:
    model = object_from_mesh("box", *MESH, "mm", ObjectConfig(num_points=4096))
    poses, sensor = np.stack([TOP, BESIDE]), TOP[:3, 3] + [20.0, -12.0, -5000.0]
    for share in (1.0, 0.5):
        measured = measured_shares(model, poses, upper_face(TOP, share), sensor)
        np.testing.assert_allclose(measured, [share, 0.0], atol=0.05)
    assert measured_shares(model, poses, np.concatenate([upper_face(TOP), upper_face(BESIDE)]), sensor).min() > 0.7


def test_scans_in_another_unit_are_counted_in_theirs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Centimetres: of two copies one was measured; it is found, and something that is none."""
    trimesh.Trimesh(MESH[0] / 10, MESH[1]).export(tmp_path / "box.stl")
    np.savetxt(tmp_path / "scan_1.xyz", upper_face(TOP) / 10)
    in_cm = [T.copy() for T in (TOP, BESIDE)]
    for T in in_cm:
        T[:3, 3] /= 10
    np.savetxt(tmp_path / "poses_1.txt", np.concatenate(in_cm))
    wrong = pose((0.0, 100.0, 500.0), np.eye(3))

    class Estimator:
        config = SimpleNamespace(accepted=0.8)

        def prepare(self, path: Path, unit: str) -> Part:
            return part_of(load_object(path, unit, ObjectConfig(num_points=2048)))

        def detect(self, part: Part, scan: Scan, sensor: Any) -> Any:
            assert scan.unit == part.unit == "mm"
            np.testing.assert_allclose(sensor, [20.0, -12.0, -4500.0])
            poses = [SimpleNamespace(T_scene_object=T, probability=p) for T, p in ((wrong, 0.3), (TOP, 0.95))]
            return SimpleNamespace(poses=poses, timing=SimpleNamespace(stages={"search": 2.0}))

    monkeypatch.setattr(PoseEstimator, "from_pretrained", lambda *_: Estimator())
    everything, scan = run(Options(tmp_path, sensor="2,-1.2,-450", units="cm"))
    assert scan["scan"] == "scan_1.xyz"
    for row in (everything, scan):
        numbers = [row[key] for key in ("copies", "listed", "recall", "accepted", "precision", "most probable wrong")]
        assert numbers == [1, 1, 1.0, 1, 1.0, 0.3]
        assert row["median s"] == 2.0


def test_a_folder_without_scans_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no scan"):
        run(Options(tmp_path))
