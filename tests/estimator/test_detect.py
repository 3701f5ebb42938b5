"""Candidates of the committed bins by the released model: most are right, and the evidence tells which."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kmn_jax.checks import InputError
from kmn_jax.data.bop import BopDataset, BopFrame
from kmn_jax.data.bop_crops import load_models
from kmn_jax.data.cad import ObjectConfig
from kmn_jax.data.scan_files import Scan
from kmn_jax.estimator.detect import EVIDENCE, Candidates, DetectConfig, find_candidates
from kmn_jax.estimator.part import Part, make_part
from kmn_jax.estimator.view import View, view_of
from kmn_jax.models import Model, load_pretrained
from kmn_jax.pose import adi

FOLDER = Path(__file__).parent.parent.parent / "experiments" / "assets" / "small_test_set"
CONFIG = DetectConfig(most_seeds=16)


@pytest.fixture(scope="module")
def model() -> Model:
    return load_pretrained("small")


@pytest.fixture(scope="module")
def dataset() -> BopDataset:
    return BopDataset.open(FOLDER, "test", unit="mm")


@pytest.fixture(scope="module")
def parts(model: Model, dataset: BopDataset) -> dict[int, Part]:
    models, problems = load_models(dataset, ObjectConfig(num_points=4096))
    assert problems == ()
    return {object_id: make_part(found, model) for object_id, found in models.items()}


def view_and_foreground(frame: BopFrame) -> tuple[View, np.ndarray]:
    """Return a frame's view, and the points that its masks give to copies."""
    depth = frame.depth.astype(np.float32)
    rows, columns = np.nonzero(depth > 0)
    z = depth[rows, columns]
    camera = frame.camera
    points = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z], axis=1)
    assert frame.visible_masks is not None
    view = view_of(Scan(points.astype(np.float32), None, depth, camera, "mm"))
    return view, frame.visible_masks.any(axis=0)[rows, columns]


def right(found: Candidates, frame: BopFrame, part: Part) -> np.ndarray:
    poses = [instance.T_camera_object.astype(np.float32) for instance in frame.instances or ()]
    points = part.points[:500]
    errors = [[float(adi(T, truth, points)) for truth in poses] for T in found.T_view_object]
    return np.array(errors).min(axis=1) < 0.1 * part.diameter


def test_most_candidates_are_right_and_evidence_tells_them_apart(
    model: Model, dataset: BopDataset, parts: dict[int, Part]
) -> None:
    outcomes, confirmed = [], []
    for key in dataset.keys[::3]:
        frame = dataset.frame(*key, masks=True)
        part = parts[(frame.instances or ())[0].object_id]
        view, foreground = view_and_foreground(frame)
        found = find_candidates(model, part, view, foreground, 0, CONFIG)
        assert found.evidence.shape[1] == len(EVIDENCE)
        assert np.isfinite(found.evidence).all()
        outcomes.append(right(found, frame, part)[found.usable])
        confirmed.append(found.evidence[found.usable, EVIDENCE.index("confirmed")])
    outcome, evidence = np.concatenate(outcomes), np.concatenate(confirmed)
    print(f"candidates {len(outcome)}, right {outcome.mean():.2f}")
    assert outcome.mean() > 0.6
    if not outcome.all():
        assert evidence[outcome].mean() > evidence[~outcome].mean() + 0.1


def test_seeds_may_be_given_and_the_same_inputs_give_the_same_bits(
    model: Model, dataset: BopDataset, parts: dict[int, Part]
) -> None:
    frame = dataset.frame(*dataset.keys[0], masks=True)
    part = parts[(frame.instances or ())[0].object_id]
    view, foreground = view_and_foreground(frame)
    at = view.points[foreground][:3].astype(np.float64)
    one, other = (find_candidates(model, part, view, foreground, 3, CONFIG, at) for _ in range(2))
    for first, second in zip(one, other, strict=True):
        np.testing.assert_array_equal(first, second)
    np.testing.assert_allclose(one.seeds[:3], at, atol=1e-4)
    assert int(one.usable.sum()) <= 3


def test_no_foreground_is_refused(model: Model, dataset: BopDataset, parts: dict[int, Part]) -> None:
    view, foreground = view_and_foreground(dataset.frame(*dataset.keys[0], masks=True))
    with pytest.raises(InputError, match="no point of the scan is left as foreground"):
        find_candidates(model, next(iter(parts.values())), view, np.zeros_like(foreground), 0, CONFIG)
