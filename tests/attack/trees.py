"""Valid folders of several files: a BOP dataset, a pack, checkpoints of a run, predictions of an evaluation."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.evaluation.cases import Case
from experiments.evaluation.predictions import Export, Predictions
from experiments.worlds import NAMES, TARGETS
from kmn_jax.data import Pack, PackConfig, Record
from kmn_jax.data._build import _Journal
from kmn_jax.data._pack import Entry, Shard, write_manifest, write_object
from kmn_jax.train._checkpoint import Checkpoints
from tests.bop.bop_sample import write_sample

_SMALL_PACK = Path(__file__).parents[2] / "experiments" / "assets" / "small_pack"


def bop_folder(folder: Path) -> None:
    """Write a dataset of two scenes of two frames."""
    write_sample(folder, num_frames=2)


def pack_folder(folder: Path) -> None:
    """Write a pack of two objects with few surfels and drops, and with visibility bits."""
    pack = Pack(_SMALL_PACK)
    items = []
    for name in pack.names()[:2]:
        item = pack.load(name)
        drops = tuple(replace(drop, bits=np.zeros((len(drop.scene.T_bin_object), 8), np.uint8)) for drop in item.drops)
        items.append(
            replace(item, name=item.digest[:8], points=item.points[:64], normals=item.normals[:64], drops=drops[:2])
        )
    write_manifest(folder, [write_object(folder, item) for item in items])


def targets_folder(folder: Path) -> None:
    """Write which objects are asked for in world bins, and the families of their scenes."""
    rows = [{"scene_id": scene, "im_id": image, "obj_id": 1 + scene} for scene in (0, 1) for image in (0, 1)]
    (folder / TARGETS).write_text(json.dumps(rows))
    (folder / NAMES).write_text(json.dumps({"0": "bins", "1": "tables"}))


def journal_folder(folder: Path) -> None:
    """Write the journal of a build with an object that was built and one that was rejected."""
    journal = read_journal(folder)
    shard = Shard("objects/one.safetensors", 100, "0" * 64)
    journal.add(Record("one", "train", 1.5, None, Entry("one", "train", shard, None), {"penetrations": [0.001]}))
    journal.add(Record("other", "test", 2.5, "it is broken"))


def read_journal(folder: Path) -> _Journal:
    """Read the journal as the next build would."""
    return _Journal(folder / "journal.jsonl", PackConfig())


def checkpoint_folder(folder: Path) -> None:
    """Write checkpoints of steps 10 and 20."""
    from tests.train.snapshot_sample import random_snapshot

    checkpoints = Checkpoints(folder / "checkpoints")
    for step in (10, 20):
        checkpoints.save(random_snapshot(step))


def evaluation_folder(folder: Path) -> None:
    """Write predictions of one method on three cases."""
    exported = Export.open(folder, {"data": "a", "methods": {"ours": {"rounds": 1}}}, overwrite=False)
    poses = np.tile(np.eye(4), (3, 1, 1))
    points = np.zeros((5, 3), dtype=np.float32)
    cases = [Case(f"0/{row}", points, poses[:2], 0, 0.5) for row in range(3)]
    exported.write_truth("box", 0.0, cases)
    seconds = np.full(3, 0.1)
    exported.write("ours", "box", 0.0, Predictions(poses, poses, np.ones(3, dtype=bool), seconds, seconds))
