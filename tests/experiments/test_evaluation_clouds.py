"""Folders of scans with poses, in other people's conventions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.evaluation.clouds import camera_of, mesh_of, read_poses, scans_with_poses
from kmn_jax.errors import InputError
from tests.reference.poses import some_poses


def write(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).write_bytes(b"")


def text_of(poses: np.ndarray) -> str:
    return "\n\n".join("\n".join(" ".join(f"{x:.9f}" for x in row) for row in pose) for pose in poses)


@pytest.mark.parametrize("name", ["a.txt", "a.json", "b.json", "c.json"])
def test_poses_are_read_from_text_and_json(tmp_path: Path, name: str) -> None:
    poses, path = some_poses(3), tmp_path / name
    content = {
        "a.txt": text_of(poses),
        "a.json": json.dumps(poses.tolist()),
        "b.json": json.dumps({"poses": poses.tolist()}),
        "c.json": json.dumps({"unit": "mm", "poses": [{"T_scene_object": pose.tolist()} for pose in poses]}),
    }
    path.write_text(content[name])
    np.testing.assert_allclose(read_poses(path), poses, atol=1e-8)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.txt", ""),
        ("a.txt", "1 2 3"),
        ("a.txt", "word " * 16),
        ("a.txt", "2 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1"),
        ("a.txt", "nan " * 16),
        ("a.json", "{"),
        ("a.json", "[]"),
        ("a.json", '{"poses": [{"pose": 1}]}'),
        ("a.json", '{"poses": 3}'),
        ("a.json", "[[1, 2], [3]]"),
        ("a.json", f"[[[1{'0' * 400}]]]"),
    ],
)
def test_what_is_no_pose_is_refused_with_the_file(tmp_path: Path, name: str, content: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError, match=name):
        read_poses(path)


def test_poses_belong_to_the_scan_of_the_same_name_or_number(tmp_path: Path) -> None:
    write(tmp_path, "Scene2.pcd", "Scene10.pcd", "pile.ply", "LICENSE", "NOTES.md", "part.STL", "readme.txt")
    poses = some_poses(6)
    for name, own in (("trans10.txt", poses[:1]), ("trans2.txt", poses[1:3]), ("pile.txt", poses[3:])):
        (tmp_path / name).write_text(text_of(own))
    found = {path.name: len(own) for path, own in scans_with_poses(tmp_path)}
    assert found == {"Scene2.pcd": 2, "Scene10.pcd": 1, "pile.ply": 3}
    assert mesh_of(tmp_path).name == "part.STL"
    assert camera_of(tmp_path) is None


def test_one_scan_needs_no_name(tmp_path: Path) -> None:
    write(tmp_path, "depth.png")
    (tmp_path / "camera.json").write_text("{}")
    (tmp_path / "truth.json").write_text(json.dumps(some_poses(2).tolist()))
    ((path, poses),) = scans_with_poses(tmp_path)
    assert path.name == "depth.png"
    assert len(poses) == 2
    assert camera_of(tmp_path) == tmp_path / "camera.json"


def test_what_is_not_clear_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a folder"):
        scans_with_poses(tmp_path / "none")
    with pytest.raises(InputError, match="no scan"):
        scans_with_poses(tmp_path)
    write(tmp_path, "a.pcd", "b.pcd")
    with pytest.raises(InputError, match="no file of poses"):
        scans_with_poses(tmp_path)
    write(tmp_path, "x.txt", "y.txt")
    with pytest.raises(InputError, match=r"not clear.*a\.pcd"):
        scans_with_poses(tmp_path)
    with pytest.raises(InputError, match="0 CAD files"):
        mesh_of(tmp_path)
    write(tmp_path, "a.stl", "b.step")
    with pytest.raises(InputError, match="2 CAD files"):
        mesh_of(tmp_path)
