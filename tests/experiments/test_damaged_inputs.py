"""Damaged files that experiments read are one sentence: predictions whose recipe is right, poses, targets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from experiments.bins import read_targets
from experiments.evaluation.clouds import read_poses
from experiments.evaluation.predictions import Export
from experiments.worlds import TARGETS
from kmn_jax.errors import InputError
from kmn_jax.files import read_safetensors
from tests.attack.trees import evaluation_folder, targets_folder

RECIPE = {"data": "a", "methods": {"ours": {"rounds": 1}}}


@pytest.fixture
def exported(tmp_path: Path) -> Export:
    evaluation_folder(tmp_path)
    return Export.open(tmp_path, RECIPE, overwrite=False)


@pytest.mark.parametrize("method", ["cases", "ours"])
@pytest.mark.parametrize("damage", ["rename", "cut", "nan", "inf"])
def test_damaged_predictions_are_refused(exported: Export, method: str, damage: str) -> None:
    path = exported.path(method, "box", 0.0)
    read = (lambda: exported.truth("box", 0.0)) if method == "cases" else (lambda: exported.read("ours", "box", 0.0))
    read()
    tensors, metadata = read_safetensors(path)
    own = "poses" if damage == "nan" else "visible"  # which is not known everywhere
    name = own if method == "cases" else "T_camera_object"
    if damage == "rename":
        tensors[name.upper()] = tensors.pop(name)
    elif damage == "cut":
        tensors[name] = tensors[name][:1].copy()
    else:
        tensors[name] = np.full_like(tensors[name], float(damage))
    save_file(tensors, path, metadata=metadata)
    with pytest.raises(InputError, match=r"noise0\.safetensors is damaged \(.*\): delete it, and evaluate again"):
        read()


def test_deep_files_are_refused(tmp_path: Path) -> None:
    for name, read in (
        ("recipe.json", lambda: Export.open(tmp_path, RECIPE, overwrite=False)),
        ("poses.json", lambda: read_poses(tmp_path / "poses.json")),
    ):
        (tmp_path / name).write_text("[" * 100_000)
        with pytest.raises(InputError, match=r"cannot be read|holds no poses"):
            read()
    (tmp_path / "recipe.json").write_text('{"methods": 3}')
    with pytest.raises(InputError, match="is no recipe"):
        Export.open(tmp_path, RECIPE, overwrite=False)


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '[{"scene_id": 0}]', '[{"scene_id": 9, "im_id": 0, "obj_id": 1}]', "3"]
)
def test_damaged_targets_are_refused(text: str, tmp_path: Path) -> None:
    targets_folder(tmp_path)
    assert [(*key, number, family) for key, number, family in read_targets(tmp_path)][-1] == (1, 1, 2, "tables")
    (tmp_path / TARGETS).write_text(text)
    with pytest.raises(InputError, match="holds no world bins"):
        read_targets(tmp_path)
