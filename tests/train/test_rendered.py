"""Samples of depth images: the objects, deterministic reading, and labels against exact poses."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.data import CropConfig, PipelineConfig, SampleBatches
from kmn_jax.errors import InputError
from kmn_jax.models import KeyMatchNetConfig
from kmn_jax.train import read_metrics, rendered_frames, train
from kmn_jax.train._rendered import RenderedFrames
from tests.train.loop_sample import tiny

FOLDER = Path(__file__).parent.parent.parent / "experiments" / "assets" / "small_test_set"
NETWORK = KeyMatchNetConfig(num_scene_points=64, num_object_points=64, num_keypoints=4)

NORMALS = {"examples.crops.normals": "estimated", "examples.crops.normal_points": 256}


@pytest.fixture(scope="module")
def frames() -> RenderedFrames:
    problems: list[str] = []
    found = rendered_frames(FOLDER, "test", NETWORK, CropConfig(num_points=64, max_noise=0.0), problems.append)
    assert problems == []
    return found


def test_objects_are_a_pack_without_drops(frames: RenderedFrames) -> None:
    assert frames.names == ("000001", "000002")
    assert frames.pack.points.shape == frames.pack.normals.shape == (2, 4096, 3)
    assert frames.pack.T_camera_object.shape[1] == 0
    assert 0.001 < float(frames.pack.diameter.max()) < 0.2  # metres
    assert len(frames.digest) == 64


def test_samples_are_points_on_the_seeds_object_in_its_pose(frames: RenderedFrames) -> None:
    pipeline = PipelineConfig(batch_size=4, crops_per_object=2, samples_per_object=2)
    batches = SampleBatches(pipeline, frames.num_frames, 1, ordered=True)
    seen = set()
    for number in range(len(batches)):
        samples, crops = frames.read(batches[number])
        again = frames.read(batches[number]).crops
        assert all(np.array_equal(one, other) for one, other in zip(crops, again, strict=True))
        for row in np.flatnonzero(samples.mask & crops.valid):
            seen.add(int(samples.object[row]))
            surface = np.asarray(frames.pack.points)[samples.object[row]]
            points = crops.points[row][crops.is_object[row]]
            T_crop_object = crops.T_crop_object[row]
            points_object = (points - T_crop_object[:3, 3]) @ T_crop_object[:3, :3]
            apart = np.linalg.norm(points_object[:, None] - surface[None], axis=2).min(axis=1)
            assert apart.max() < 0.03 * frames.pack.diameter[samples.object[row]]
            np.testing.assert_allclose(crops.points[row][0], 0, atol=1e-7)
    assert seen == {0, 1}


def test_a_folder_without_frames_or_objects_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        rendered_frames(tmp_path, "test", NETWORK, CropConfig(num_points=64))
    with pytest.raises(InputError, match="train"):
        rendered_frames(FOLDER, "train", NETWORK, CropConfig(num_points=64))


def test_a_run_reads_its_crops_from_images(compiled: None, tmp_path: Path) -> None:
    config = tiny(rendered=str(FOLDER), rendered_split="test", num_steps=3, **NORMALS)
    reports: list[str] = []
    outcome = train(config, tmp_path / "run", progress=False, report=reports.append)
    assert (outcome.step, outcome.reason) == (3, "")
    rows = read_metrics(tmp_path / "run")
    assert [row["split"] for row in rows] == ["train", "validation"]
    assert all(np.isfinite(row["loss"]) for row in rows)
    assert not any(report.startswith("left out") for report in reports)


def test_a_broken_image_is_named_and_the_run_goes_on(compiled: None, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    shutil.copytree(FOLDER, folder)
    for image in sorted(folder.glob("test/000001/depth/*.png")):
        image.write_bytes(image.read_bytes()[:-100])
    config = tiny(rendered=str(folder), rendered_split="test", num_steps=3, **NORMALS)
    reports: list[str] = []
    outcome = train(config, tmp_path / "run", progress=False, report=reports.append)
    assert (outcome.step, outcome.reason) == (3, "")
    assert all(np.isfinite(row["gradient_norm"]) for row in read_metrics(tmp_path / "run") if row["split"] == "train")
    assert any(report.startswith("left out") and "000001" in report for report in reports)
