"""Crops of depth images: labels against exact scenes, with masks and without; broken frames; threads."""

from __future__ import annotations

import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from jaxtyping import Float

from kmn_jax.bop import BopDataset, write_scene
from kmn_jax.data import (
    BatchIterator,
    BopCropConfig,
    BopCrops,
    CropConfig,
    LabelledCrop,
    PipelineConfig,
    SampleBatches,
    load_models,
)
from kmn_jax.data._bop_crops import FrameCrops
from kmn_jax.errors import InputError
from kmn_jax.objects import ObjectConfig, ObjectModel, Symmetries
from tests.bop.bop_sample import RADIUS, edit_json, sample_frame, write_sample

UNIT = 1000.0  # the datasets are opened in millimetres
CONFIG = BopCropConfig(
    CropConfig(num_points=160, radius=2.0, max_noise=0.0, normal_radius=0.25, normal_points=256), num_keypoints=8
)
STEP = 0.02  # mm, of the depth images


def ball() -> ObjectModel:
    """Return the ball that the sample frames show."""
    index = np.arange(512) + 0.5
    z, angle = 1 - index / 256, np.pi * (1 + 5**0.5) * index
    normals = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
    order = np.random.default_rng(0).permutation(512)
    points = (RADIUS * normals[order]).astype(np.float32)
    return ObjectModel(
        name="ball",
        unit="m",
        vertices=points.astype(np.float64),
        triangles=np.zeros((0, 3), dtype=np.int32),
        points=points,
        normals=normals[order].astype(np.float32),
        minimum=np.full(3, -RADIUS),
        maximum=np.full(3, RADIUS),
        diameter=2 * RADIUS,
        area=4 * np.pi * RADIUS**2,
        hidden_share=0.0,
        symmetries=Symmetries(np.eye(3)[None], np.zeros((0, 3)), np.zeros(3), 0.02),
        digest="0" * 64,
    )


MODELS = {1: ball(), 2: ball()}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for scene_id in (0, 3):
        write_scene(tmp_path, "test", scene_id, (sample_frame(10 * scene_id + i) for i in range(3)), "m", STEP)
    return tmp_path


def crops_of(folder: Path, config: BopCropConfig = CONFIG) -> BopCrops:
    return BopCrops(BopDataset(folder, "test"), MODELS, config)


def batches(crops: BopCrops, ordered: bool = False) -> SampleBatches:
    config = PipelineConfig(batch_size=8, samples_per_object=4, crops_per_object=4)
    return SampleBatches(config, len(crops.keys), 1, ordered=ordered)


def single(batch: FrameCrops, row: int) -> LabelledCrop:
    crop: LabelledCrop = jax.tree.map(lambda part: part[row], batch.crop)
    return crop


def distances_to_balls(crops: BopCrops, batch: FrameCrops, row: int) -> Float[np.ndarray, "n balls"]:
    """Return how far the real points of a crop are from the surface of each ball of its frame, in millimetres."""
    frame, crop = crops.dataset.frame(*crops.keys[batch.frame[row]]), single(batch, row)
    centers = np.stack([instance.T_camera_object[:3, 3] for instance in frame.instances or ()])
    points = (crop.points + crop.seed)[crop.mask]
    return np.abs(np.linalg.norm(points[:, None] - centers, axis=2) - RADIUS * UNIT)


def test_crops_are_labelled_as_the_scene_is(folder: Path) -> None:
    crops = crops_of(folder)
    source = batches(crops)
    near_other, bin_points = 0, 0
    for number in range(3):
        batch = crops.read(source[number])
        assert batch.mask.all()
        assert batch.crop.valid.all()
        assert batch.crop.points.shape == (8, 160, 3)
        for row in range(8):
            crop, frame = single(batch, row), crops.dataset.frame(*crops.keys[batch.frame[row]])
            instance = (frame.instances or ())[int(crop.instance)]
            assert crops.object_ids[batch.object[row]] == instance.object_id
            on = distances_to_balls(crops, batch, row) < 2 * STEP
            np.testing.assert_array_equal(crop.is_object[crop.mask], on[:, int(crop.instance)])
            near_other += (on.any(axis=1) & ~crop.is_object[crop.mask]).sum()
            bin_points += (~on.any(axis=1)).sum()
            assert crop.is_object[0]
            assert not crop.points[0].any()
            assert np.linalg.norm(crop.points, axis=1).max() <= 2.0 * 2 * RADIUS * UNIT * (1 + 1e-5)
            pose = instance.T_camera_object.copy()
            pose[:3, 3] -= crop.seed
            np.testing.assert_allclose(crop.T_crop_object, pose, atol=1e-4)
            keypoints = ball().points[:8] * UNIT @ pose[:3, :3].T + pose[:3, 3]
            nearest = np.linalg.norm(crop.points[:, None] - keypoints, axis=2).argmin(axis=1)
            assert (crop.keypoint == nearest)[crop.is_object].mean() > 0.98  # but for ties
    assert near_other > 20
    assert bin_points > 100


def test_normals_are_those_of_the_balls(folder: Path) -> None:
    crops = crops_of(folder)
    batch = crops.read(batches(crops)[0])
    errors = []
    for row in range(8):
        crop = single(batch, row)
        radial = (crop.points - crop.T_crop_object[:3, 3])[crop.is_object]
        radial /= np.linalg.norm(radial, axis=1, keepdims=True)
        assert (((crop.points + crop.seed) * crop.normals).sum(axis=1)[crop.mask] < 0).all()
        errors.append(np.degrees(np.arccos(np.clip((radial * crop.normals[crop.is_object]).sum(axis=1), -1, 1))))
    # Seven pixels a radius: the planes of the rim's points mix with what is behind.
    assert np.median(np.concatenate(errors)) < 12


def test_groups_show_one_object_of_one_frame(folder: Path) -> None:
    crops = crops_of(folder)
    source = batches(crops)
    instances = set()
    for number in range(4):
        batch = crops.read(source[number])
        for group in (slice(0, 4), slice(4, 8)):
            assert len(set(batch.frame[group])) == len(set(batch.object[group])) == 1
            instances.add(len(set(batch.crop.instance[group].tolist())))
    assert max(instances) > 1


def test_labels_without_masks_are_those_with_masks(folder: Path) -> None:
    crops = crops_of(folder)
    whole = [crops.read(batches(crops)[number]) for number in range(3)]
    for scene in ("000000", "000003"):
        for name in ("mask", "mask_visib"):
            shutil.rmtree(folder / "test" / scene / name)
    edited = crops_of(folder)
    assert edited.problems == []
    by_surface = 0
    for number, wanted in enumerate(whole):
        batch = edited.read(batches(edited)[number])
        np.testing.assert_array_equal(batch.frame, wanted.frame)
        assert batch.crop.valid.all()
        for row in range(8):
            crop = single(batch, row)
            on = distances_to_balls(edited, batch, row)
            own = on[:, int(crop.instance)]
            clear = (own < 0.5 * STEP + 0.1) | (own > 1.0)  # a tolerance of 0.8 mm takes in what touches
            np.testing.assert_array_equal(crop.is_object[crop.mask][clear], own[clear] < 0.5)
            by_surface += clear.sum()
    assert by_surface > 1500


def test_background_stays_away_if_not_wanted(folder: Path) -> None:
    crop_config = CropConfig(
        num_points=160, radius=2.0, max_noise=0.0, normal_radius=0.25, normal_points=256, include_bin=False
    )
    crops = crops_of(folder, BopCropConfig(crop_config, num_keypoints=8))
    batch = crops.read(batches(crops)[0])
    for row in range(8):
        assert (distances_to_balls(crops, batch, row).min(axis=1) < 2 * STEP).all()


def test_threads_and_resuming_change_nothing(folder: Path) -> None:
    crops = crops_of(folder)
    source = batches(crops)
    plain = [crops.read(source[number]) for number in range(6)]
    iterator = BatchIterator(source, crops.read, threads=3, ahead=4)
    taken = [next(iterator) for _ in range(4)]
    resumed = BatchIterator(batches(crops_of(folder)), crops_of(folder).read)
    resumed.set_state(iterator.get_state())
    taken += [next(resumed), next(resumed)]
    for a, b in zip(plain, taken, strict=True):
        jax.tree.map(np.testing.assert_array_equal, a, b)


def test_ordered_pass_reads_every_frame_once(folder: Path) -> None:
    crops = crops_of(folder)
    parts = list(BatchIterator(batches(crops, ordered=True), crops.read))
    assert np.concatenate([part.frame for part in parts]).tolist() == np.repeat(np.arange(6), 4).tolist()


def test_frames_that_files_show_broken_are_left_out_by_name(folder: Path) -> None:
    edit_json(folder / "test/000000/scene_gt.json", "1", 0, "cam_t_m2c", value=[1.0, 2.0])
    (folder / "test/000003/depth/000002.png").unlink()
    reported: list[str] = []
    crops = BopCrops(BopDataset(folder, "test"), MODELS, CONFIG, report=reported.append)
    assert crops.keys == ((0, 0), (0, 2), (3, 0), (3, 1))
    assert crops.problems == reported
    assert len(reported) == 2
    assert "scene_gt.json: image 1, instance 0: cam_t_m2c" in reported[0]
    assert "000003/depth/000002.png is missing" in reported[1]
    assert crops.read(batches(crops)[0]).crop.valid.all()


def test_images_that_break_on_reading_are_not_fatal(folder: Path) -> None:
    path = folder / "test/000003/depth/000001.png"
    path.write_bytes(path.read_bytes()[:-200])
    crops = crops_of(folder)
    assert crops.problems == []
    parts = list(BatchIterator(batches(crops, ordered=True), crops.read))
    broken = crops.keys.index((3, 1))
    for part in parts:
        np.testing.assert_array_equal(part.crop.valid, part.frame != broken)
        assert np.isfinite(part.crop.points).all()
    (problem,) = crops.problems
    assert "frame 1 of scene 3" in problem
    assert str(path) in problem
    decoded = BopCrops(BopDataset(folder, "test"), MODELS, CONFIG, decode=True)
    assert (3, 1) not in decoded.keys
    assert str(path) in decoded.problems[0]


def test_only_objects_with_a_model_are_cropped(folder: Path) -> None:
    crops = BopCrops(BopDataset(folder, "test"), {2: ball()}, CONFIG)
    batch = crops.read(batches(crops)[0])
    assert batch.crop.valid.all()
    assert set(batch.crop.instance.tolist()) == {1}
    none = BopCrops(BopDataset(folder, "test"), {7: ball()}, CONFIG)
    assert not none.read(batches(none)[0]).crop.valid.any()


def test_hidden_instances_give_no_seeds(folder: Path) -> None:
    for scene in ("000000", "000003"):
        for image in ("0", "1", "2"):
            for instance, fraction in ((0, 0.05), (1, 0.1), (2, 0.0)):
                file = folder / "test" / scene / "scene_gt_info.json"
                edit_json(file, image, instance, "visib_fract", value=fraction)
    crops = crops_of(folder)
    batch = crops.read(batches(crops)[0])
    assert batch.crop.valid.all()
    assert set(batch.crop.instance.tolist()) == {1}


def test_models_are_read_in_the_unit_of_the_dataset(tmp_path: Path) -> None:
    dataset = BopDataset(write_sample(tmp_path), "test", "cm")
    (tmp_path / "models/obj_000002.ply").write_bytes(b"ply\n")
    models, problems = load_models(dataset, ObjectConfig(num_points=64))
    assert list(models) == [1]
    np.testing.assert_allclose(models[1].extents, [2, 2, 4], rtol=1e-5)
    assert len(problems) == 1
    assert "obj_000002.ply" in problems[0]


def test_what_cannot_be_cropped_is_refused(folder: Path) -> None:
    with pytest.raises(InputError, match="without ground truth"):
        BopCrops(BopDataset(folder, "test", ground_truth=False), MODELS, CONFIG)
    with pytest.raises(InputError, match="has 512 points, too few for 600 keypoints"):
        crops_of(folder, BopCropConfig(num_keypoints=600))
    with pytest.raises(InputError, match='use "estimated"'):
        BopCropConfig(CropConfig(normals="surface"))
    with pytest.raises(InputError, match="label_tolerance"):
        BopCropConfig(label_tolerance=0.0)
    with pytest.raises(InputError, match="no object has a model"):
        BopCrops(BopDataset(folder, "test"), {}, CONFIG)
    for scene in ("000000", "000003"):
        (folder / "test" / scene / "scene_camera.json").write_text("{")
    with pytest.raises(InputError, match=r"no usable frame.*scene_camera.json"):
        crops_of(folder)
