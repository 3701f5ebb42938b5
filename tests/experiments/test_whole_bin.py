"""The whole bin of the report: which image it is, that nothing of its truth is searched with, and what is told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import evaluate
from experiments.evaluation.sources import BopImages, bop_objects
from experiments.evaluation.whole_bin import headline, num_right, whole_bin
from kmn_jax.bop import bop_scan
from kmn_jax.detection import Detections, PoseEstimator, Scene, Timing
from kmn_jax.objects import Part
from kmn_jax.released import RELEASED
from tests.reference.meshes import pose

SMALL = Path(evaluate.__file__).parent / "assets" / "small_test_set"
FULLEST = SMALL / "test" / "000001" / "depth" / "000003.png"


def test_the_headline_counts_copies_and_wrong_poses() -> None:
    assert headline(16, 14, 14) == "14 of 16 copies found in this bin, all accepted poses right"
    assert headline(1, 1, 1, "image") == "1 of 1 copy found in this image, all accepted poses right"
    assert headline(16, 14, 12) == "12 of 16 copies found in this bin, 2 of 14 accepted poses wrong"
    assert headline(16, 0, 0) == "0 of 16 copies found in this bin, no pose accepted"


def test_the_fullest_image_is_searched_without_its_truth(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    objects = bop_objects(SMALL, "test", print)
    (first, *_), searched = objects, list[Scene]()

    def detect(estimator: PoseEstimator, part: Part, scene: Scene, **more: Any) -> Detections:
        assert not more
        assert part.name == first.name
        searched.append(scene)
        return Detections(part.name, scene.unit, (), Timing({}, 0.0), "it was not searched")

    monkeypatch.setattr(PoseEstimator, "detect", detect)
    drawn = whole_bin(objects, RELEASED)
    (scene,) = searched
    scan, instances = bop_scan(FULLEST)
    assert instances is not None
    assert isinstance(first.images, BopImages)
    assert len(instances) == max(first.images.counts)
    np.testing.assert_array_equal(scene.depth, scan.depth)
    assert scene.truth is None
    assert not scene.is_narrowed
    assert drawn is not None
    assert drawn.content.startswith(b"\x89PNG")
    assert drawn.title == f"0 of {len(instances)} copies found in this bin, no pose accepted"
    assert "(scene 1, image 3; " in drawn.text
    assert whole_bin([], RELEASED) is None
    assert whole_bin(objects, "none") is None
    assert "no whole bin is drawn: there is no released model" in capsys.readouterr().err

    model, truth = first.model, np.stack([pose((0.0, 0.0, 500.0)), pose((100.0, 0.0, 500.0))])
    near = pose((0.02 * model.diameter, 0.0, 500.0))
    assert num_right(np.stack([truth[1], near, truth[0]]), truth, model) == 2  # a copy is found once
    assert num_right(truth[:0], truth, model) == 0
    assert num_right(pose((50.0, 0.0, 400.0))[None], truth, model) == 0
