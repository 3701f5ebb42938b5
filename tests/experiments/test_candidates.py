"""The poses that probabilities are fitted to: what is kept of a search, and what is stored."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from experiments import candidates as module
from experiments.candidates import Sources, candidates, judged_anew
from experiments.fits import FitOptions
from kmn_jax.detection import EVIDENCE, OF_PICTURE, Candidates
from kmn_jax.errors import InputError
from kmn_jax.models import create_model
from tests.reference.networks import TINY


def test_crops_without_poses_are_dropped_and_the_others_keep_theirs() -> None:
    usable = np.array([False, False, True, False, False, False, False, True])  # two poses of each of four crops
    crop = np.repeat(np.arange(4), 2)
    said: Any = {"logits": np.arange(4)}
    found = Candidates(
        np.arange(8)[:, None], usable, np.arange(8)[:, None] * 10, np.arange(8), crop, said, crop[::2] * 7
    )
    few = module._with_poses(found)
    np.testing.assert_array_equal(few.evidence[:, 0], [20, 30, 60, 70])
    np.testing.assert_array_equal(few.usable, [True, False, False, True])
    np.testing.assert_array_equal(few.crop, [0, 0, 1, 1])
    np.testing.assert_array_equal(few.found["logits"], [1, 3])
    np.testing.assert_array_equal(few.seed_rows, [7, 21])
    none = module._with_poses(found._replace(usable=np.zeros(8, dtype=bool)))
    assert (len(none.usable), len(none.seed_rows)) == (2, 1)


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let two searches be made again, whose poses show as much to the camera as they are shifted."""

    def searches(sources: Sources, network: Any) -> Any:
        for row in range(2):
            yield SimpleNamespace(row=row, on_device=row, scene=row, is_known=row == 1)

    def shown(poses: np.ndarray, part: int, scene: int, config: Any) -> np.ndarray:
        return np.repeat(poses[:, :1, 3] + 10 * scene, len(OF_PICTURE), axis=1)

    monkeypatch.setattr(module, "_searches", searches)
    monkeypatch.setattr(module, "picture_evidence", shown)
    monkeypatch.setattr(module, "held_out_models", lambda poses, fits: [(np.unique(poses["object"]), "model")])
    monkeypatch.setattr(module, "_made_of", lambda *given: "these")

    def all_but_the_first(found: Candidates, *given: Any) -> Any:
        return SimpleNamespace(kept=np.arange(len(found.usable)) > 0)

    monkeypatch.setattr(module, "chosen", all_but_the_first)


def stored_poses(names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return four poses of one search and two of another: of the first a found one and three refined ones."""
    poses = np.tile(np.eye(4, dtype=np.float32), (6, 1, 1))
    poses[:, 0, 3] = np.arange(6)
    return {
        "evidence": np.tile(np.arange(len(names), dtype=np.float32), (6, 1)),
        "error": np.full(6, 0.01),
        "largest_error": np.full(6, 0.01),
        "object": np.array([7, 7, 7, 7, 8, 8]),
        "search": np.array([0, 0, 0, 0, 1, 1]),
        "narrowed": np.zeros(6, dtype=bool),
        "T_camera_object": poses,
        "refined": np.array([False, True, True, True, True, True]),
        "reported": np.zeros(6, dtype=bool),
    }


_OF_CROPS = tuple(name for name in EVIDENCE if name not in OF_PICTURE)


@pytest.mark.usefixtures("searched")
def test_stored_poses_are_judged_anew_by_other_evidence(tmp_path: Path) -> None:
    path, names = tmp_path / "poses.npz", ("what is gone", *reversed(_OF_CROPS))
    np.savez(path, allow_pickle=False, made_of=np.array("these"), names=np.array(names), **stored_poses(names))
    network: Any = SimpleNamespace(config=create_model(TINY, jax.random.key(0)).config)
    poses = candidates(path, Sources(), FitOptions(), network)
    for name in EVIDENCE:
        column = poses["evidence"][:, EVIDENCE.index(name)]
        wanted = [0, 1, 2, 3, 14, 15] if name in OF_PICTURE else np.full(6, names.index(name))
        np.testing.assert_array_equal(column, wanted)
    # Of refined poses, those that are chosen; none of parts that the network knows.
    np.testing.assert_array_equal(poses["reported"], [False, False, True, True, False, False])
    again = candidates(path, Sources(), FitOptions(), network)
    assert again.keys() == poses.keys()
    for name, values in poses.items():
        np.testing.assert_array_equal(again[name], values)
    assert sorted(tmp_path.iterdir()) == [path]


@pytest.mark.usefixtures("searched")
def test_poses_that_lack_what_comes_of_crops_cannot_be_judged() -> None:
    names = _OF_CROPS[1:]
    with pytest.raises(InputError, match="remove the file"):
        judged_anew(stored_poses(names), names, Sources(), FitOptions(), SimpleNamespace(config=TINY))  # type: ignore


@pytest.mark.usefixtures("searched")
def test_candidates_of_other_bins_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "poses.npz"
    for wrong in ({"made_of": np.array("others")}, {"more": np.zeros(1)}):
        stored = {"made_of": np.array("these"), "names": np.array(EVIDENCE), **stored_poses(EVIDENCE)} | wrong
        np.savez(path, allow_pickle=False, **stored)
        with pytest.raises(InputError, match="holds poses of other bins, weights or settings: remove it"):
            candidates(path, Sources(), FitOptions(), SimpleNamespace())  # type: ignore
