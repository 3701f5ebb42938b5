from __future__ import annotations

import json
import pickle
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.bop import (
    BopDataset,
    BopFrame,
    BopInstance,
    FrameKey,
    dataset_digest,
    finest_depth_scale,
    scene_frame,
    write_models,
    write_scene,
)
from kmn_jax.errors import InputError
from kmn_jax.io import read_mesh
from kmn_jax.objects import ObjectModel
from kmn_jax.simulate import BinScene
from tests.bop.bop_sample import (
    CAMERA,
    RADIUS,
    STEP,
    box_model,
    sample_frame,
    save_image,
    sphere_depth,
    turned_model,
    write_blenderproc,
    write_sample,
)

HALF_STEP = 0.5 * STEP / 1000 * (1 + 1e-6) + 2e-8  # metres, and the rounding of float32 at 0.3 m


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample(tmp_path_factory.mktemp("bop"))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_written_frames_are_read_back(sample: Path) -> None:
    dataset = BopDataset(sample, "test", unit="m")
    assert BopDataset.splits(sample) == ("test",)
    assert len(dataset) == 6
    assert dataset.keys[2:4] == (FrameKey(0, 2), FrameKey(3, 0))
    for key, seed in ((FrameKey(0, 1), 1), (FrameKey(3, 2), 32)):
        wrote, read = sample_frame(seed).with_visibility(), dataset.frame(*key, masks=True)
        assert read.camera == wrote.camera
        assert read.depth.dtype == np.float32
        assert np.abs(read.depth.astype(float) - wrote.depth.astype(float)).max() <= HALF_STEP
        np.testing.assert_array_equal(read.depth == 0, wrote.depth == 0)
        np.testing.assert_array_equal(read.masks, wrote.masks)
        np.testing.assert_array_equal(read.visible_masks, wrote.visible_masks)
        np.testing.assert_allclose(read.T_camera_world, wrote.T_camera_world, rtol=1e-15)
        np.testing.assert_allclose(read.T_camera_bin, wrote.T_camera_bin, rtol=1e-15)
        for name in ("length", "width", "height", "thickness"):
            assert getattr(read.bin, name) == pytest.approx(getattr(wrote.bin, name), rel=1e-15)
        assert read.instances is not None
        assert wrote.instances is not None
        for got, want in zip(read.instances, wrote.instances, strict=True):
            np.testing.assert_allclose(got.T_camera_object, want.T_camera_object, rtol=1e-15)
            names = [field.name for field in fields(BopInstance) if field.name != "T_camera_object"]
            assert [getattr(got, name) for name in names] == [getattr(want, name) for name in names]
    assert dataset[-1].masks is None
    assert dataset.problems() == ()
    assert dataset.usable() == dataset.keys


def test_visibility_is_counted_on_the_masks() -> None:
    depth = np.ones((48, 64), np.float32)
    depth[10] = 0
    mask, visible = np.zeros((2, 1, 48, 64), bool)
    mask[0, 10:20, 5:25] = True
    visible[0, 10:15, 5:15] = True
    frame = BopFrame(CAMERA, depth, (BopInstance(1, np.eye(4)),), masks=mask, visible_masks=visible)
    (instance,) = frame.with_visibility().instances or ()
    assert (instance.box, instance.visible_box) == ((5, 10, 20, 10), (5, 10, 10, 5))
    assert (instance.num_pixels, instance.num_valid_pixels, instance.num_visible_pixels) == (200, 180, 50)
    assert instance.visible_fraction == 0.25
    known = replace(frame, instances=(replace(instance, num_pixels=400, visible_fraction=None),), masks=None)
    (instance,) = known.with_visibility().instances or ()
    assert instance.visible_fraction == 0.125  # of a silhouette that leaves the image


def test_frame_of_a_rendered_bin(tmp_path: Path) -> None:
    source = sample_frame(4)
    assert source.instances is not None
    assert source.bin is not None
    assert source.masks is not None
    assert source.visible_masks is not None
    T_bin_camera = np.linalg.inv(np.asarray(source.T_camera_bin))
    poses = np.stack([instance.T_camera_object for instance in source.instances] + [np.eye(4)])
    scene = BinScene(source.bin, T_bin_camera @ poses, CAMERA, np.asarray(source.T_camera_bin))
    numbers = np.where(source.visible_masks.any(axis=0), source.visible_masks.argmax(axis=0), -1)
    wanted = source.with_visibility().instances or ()
    counts = np.append(source.masks.sum(axis=(1, 2)), 0)
    boxes = np.array([*(instance.box for instance in wanted), (-1, -1, -1, -1)])
    frame = scene_frame(scene, 7, source.depth, numbers, counts, boxes)
    write_scene(tmp_path, "test", 0, [frame], "m", STEP)
    *shown, hidden = BopDataset(tmp_path, "test", unit="m")[0].instances or ()
    for got, want in zip(shown, wanted, strict=True):
        np.testing.assert_allclose(got.T_camera_object, want.T_camera_object, atol=1e-15)
        names = ("visible_fraction", "box", "visible_box", "num_pixels", "num_visible_pixels")
        assert [getattr(got, name) for name in names] == [getattr(want, name) for name in names]
        assert (got.object_id, got.num_valid_pixels) == (7, None)
    assert (hidden.visible_fraction, hidden.box, hidden.visible_box, hidden.num_pixels) == (0, None, None, 0)


def test_same_frames_give_the_same_bytes(sample: Path, tmp_path: Path) -> None:
    again = contents(write_sample(tmp_path / "again"))
    assert again == contents(sample)
    assert len(again) == 2 + 2 + 1 + 2 * (4 + 3 + 2 * 9)
    assert dataset_digest(sample) == dataset_digest(tmp_path / "again")
    before = dataset_digest(sample)
    save_image(tmp_path / "again" / "test" / "000003" / "depth" / "000001.png", np.zeros((48, 64), np.uint16))
    assert dataset_digest(tmp_path / "again") != before


def test_rewriting_what_was_read_changes_nothing(sample: Path, tmp_path: Path) -> None:
    """The steps of depth survive the way through float32; millimetres pass unchanged."""
    dataset = BopDataset(sample, "test")
    for scene_id in (0, 3):
        keys = [key for key in dataset.keys if key.scene_id == scene_id]
        frames = (dataset.frame(*key, masks=True) for key in keys)
        write_scene(tmp_path, "test", scene_id, frames, "mm", STEP)
    wrote = {name: value for name, value in contents(sample).items() if name.startswith("test")}
    assert contents(tmp_path) == wrote


def test_units_agree(sample: Path) -> None:
    in_metres, in_mm = (BopDataset(sample, "test", unit=unit) for unit in ("m", "mm"))
    a, b = in_metres[0], in_mm[0]
    np.testing.assert_allclose(a.depth * 1000, b.depth, rtol=1e-6)
    assert a.instances is not None
    assert b.instances is not None
    translations = [frame[0].T_camera_object[:3, 3] for frame in (a.instances, b.instances)]
    np.testing.assert_allclose(translations[0] * 1000, translations[1], rtol=1e-14)
    assert in_mm.model(1).diameter == pytest.approx(1000 * in_metres.model(1).diameter, rel=1e-14)
    with pytest.raises(InputError, match="unit 'parsec' is not known"):
        BopDataset(sample, "test", unit="parsec")


def test_poses_reproject_onto_the_stored_depth(sample: Path) -> None:
    for frame in BopDataset(sample, "test", unit="m"):
        assert frame.instances is not None
        rendered = np.stack([sphere_depth(CAMERA, i.T_camera_object[:3, 3], RADIUS) for i in frame.instances])
        shown = (frame.depth > 0) & (frame.depth < 0.29)
        error = np.abs(rendered.min(axis=0)[shown] - frame.depth[shown])
        assert np.median(error) < STEP / 1000
        assert error.max() <= HALF_STEP


def test_nothing_is_read_before_it_is_asked_for(tmp_path: Path) -> None:
    for name in ("000000", "000007"):
        (tmp_path / "test" / name).mkdir(parents=True)
        (tmp_path / "test" / name / "scene_gt.json").write_text("broken")
    dataset = BopDataset(tmp_path, "test")
    dataset = pickle.loads(pickle.dumps(dataset))
    assert len(dataset) == 0
    assert [problem.scene_id for problem in dataset.problems()] == [0, 0, 7, 7]


def test_models(sample: Path, tmp_path: Path) -> None:
    dataset, box = BopDataset(sample, "test", unit="m"), box_model()
    assert dataset.object_ids == (1, 2)
    model = dataset.model(1)
    assert (model.name, model.diameter) == ("box", pytest.approx(box.diameter, rel=1e-14))
    np.testing.assert_allclose(model.size, box.extents, rtol=1e-14)
    assert model.path is not None
    mesh = read_mesh(model.path, "mm")
    np.testing.assert_allclose(mesh.vertices / 1000, box.vertices, rtol=1e-6)
    np.testing.assert_array_equal(mesh.triangles, box.triangles)

    stored = json.loads((sample / "models" / "models_info.json").read_text())
    np.testing.assert_allclose([stored["1"][f"min_{axis}"] for axis in "xyz"], 1000 * box.minimum, rtol=1e-14)
    assert stored["2"]["symmetries_continuous"] == [{"axis": [0, 0, 1], "offset": [10, -20, 30]}]
    assert "symmetries_discrete" not in stored["2"]
    turns = np.array(stored["1"]["symmetries_discrete"]).reshape(3, 4, 4)  # the identity goes without saying
    np.testing.assert_allclose(turns[:, :3, :3], box.symmetries.transforms[1:, :3, :3], atol=1e-16)
    np.testing.assert_allclose(turns[:, :3, 3], 1000 * box.symmetries.transforms[1:, :3, 3], atol=1e-12)
    with pytest.raises(InputError, match=r"object 9 has no usable model: .*models does not have it"):
        dataset.model(9)
    with pytest.raises(InputError, match="object id 0 must be 1 or more"):
        write_models(tmp_path, {0: box})


def test_vertex_normals_are_weighted_by_angles(sample: Path) -> None:
    """At a box's corner three faces meet at 90 degrees, in up to six triangles: the normal is the diagonal."""
    import open3d

    mesh = open3d.io.read_triangle_mesh(str(sample / "models" / "obj_000001.ply"))
    normals, vertices = np.asarray(mesh.vertex_normals), np.asarray(mesh.vertices)
    outward = np.sign(vertices - vertices.mean(axis=0)) / 3**0.5
    np.testing.assert_allclose(normals, outward, atol=1e-6)


def test_cloud_model_is_written_with_its_normals(tmp_path: Path) -> None:
    cloud: ObjectModel = replace(turned_model(), triangles=np.zeros((0, 3), np.int32))
    write_models(tmp_path, {4: cloud})
    mesh = read_mesh(tmp_path / "models" / "obj_000004.ply", "mm")
    assert len(mesh.triangles) == 0
    np.testing.assert_allclose(mesh.vertices, cloud.points * 1000, rtol=1e-6)
    np.testing.assert_allclose(mesh.normals, cloud.normals, rtol=1e-6)


def test_blenderproc_output(tmp_path: Path) -> None:
    dataset = BopDataset(write_blenderproc(tmp_path), "train_pbr")
    assert BopDataset.splits(tmp_path) == ("train_pbr",)
    assert dataset.keys == tuple(FrameKey(0, image) for image in range(12))  # not in the order of strings
    assert dataset.problems() == ()
    assert dataset.object_ids is None
    frame = dataset.frame(0, 10, masks=True)
    assert frame.instances is not None
    assert (frame.masks, frame.visible_masks, frame.bin) == (None, None, None)
    (instance,) = frame.instances
    assert (instance.object_id, instance.visible_fraction, instance.box) == (5, None, None)
    assert instance.T_camera_object[:3, 3].tolist() == [10, -5, 610]
    assert frame.T_camera_world is not None
    assert frame.T_camera_world[:3, 3].tolist() == [0, 0, 700]
    exact = sphere_depth(CAMERA, np.array([10.0, -5, 610]), 60.0)
    np.testing.assert_array_equal(frame.depth > 0, np.isfinite(exact))  # the saturated background is gone
    assert np.abs(frame.depth - exact)[frame.depth > 0].max() <= 0.05 + 1e-4


def test_tiff_depth_and_several_sensors(tmp_path: Path) -> None:
    scene = tmp_path / "test_photo" / "000002"
    (scene / "depth_left").mkdir(parents=True)
    steps = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    steps[5, 5] = 65535
    values = {0: steps, 1: steps.astype(">u2"), 2: steps.astype(np.int32), 3: steps.astype(np.float32)}
    values[3][6, 6] = np.nan
    for image, pixels in values.items():
        save_image(scene / "depth_left" / f"{image:04d}.tif", pixels)
    entry = {"cam_K": [80, 0, 31.5, 0, 82, 23, 0, 0, 1], "depth_scale": 0.5}
    (scene / "scene_camera_left.json").write_text(json.dumps({str(image): entry for image in values}))
    dataset = BopDataset(tmp_path, "test_photo", sensor="left", ground_truth=False)
    assert dataset.problems() == ()
    frames = list(dataset)
    assert frames[0].instances is None
    for frame in frames[:2]:
        np.testing.assert_array_equal(frame.depth, np.where(steps == 65535, 0, steps * np.float32(0.5)))
    assert frames[2].depth[5, 5] == 65535 * 0.5  # 32 bits do not saturate there
    assert frames[3].depth[6, 6] == 0
    np.testing.assert_array_equal(frames[3].depth[7:], steps[7:] * np.float32(0.5))


@pytest.mark.parametrize(
    ("farthest", "unit", "step"),
    [(6.5534, "m", 0.1), (6.5535, "m", 0.2), (300.0, "mm", 0.005), (1310.68, "mm", 0.02), (2e-4, "m", 5e-6)],
)
def test_finest_depth_scale(farthest: float, unit: str, step: float) -> None:
    assert finest_depth_scale(farthest, unit) == step


def frame_with(**changes: object) -> BopFrame:
    return replace(sample_frame(0), masks=None, visible_masks=None, **changes)


def pose_with(row: int, column: int, value: float) -> np.ndarray:
    pose = np.eye(4)
    pose[row, column] = value
    return pose


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([], "has no frames"),
        ([frame_with(instances=None)], "frame 0: it has no instances"),
        ([frame_with(), frame_with(depth=-sample_frame(0).depth)], "frame 1: depth holds negative values"),
        ([frame_with(depth=np.full((48, 64), np.nan))], "depth holds negative values, NaN"),
        ([frame_with(depth=np.full((48, 64), 2.0))], "reaches from 2000 to 2000 mm, .* 0.02 to 1310.68 mm: choose"),
        ([frame_with(depth=np.full((48, 64), 1e-6))], "reaches from 0.001 to 0.001 mm"),
        ([frame_with(instances=(BopInstance(0, np.eye(4)),))], "instance 0: object_id is 0"),
        (
            [frame_with(instances=(BopInstance(1, pose_with(0, 3, np.nan)),))],
            "instance 0: T_camera_object holds 1 values",
        ),
        ([frame_with(instances=(BopInstance(1, pose_with(2, 2, -1)),))], "T_camera_object is not a rigid pose"),
        ([frame_with(T_camera_world=pose_with(3, 0, 1.0))], "T_camera_world is not a rigid pose"),
        ([sample_frame(0), frame_with()], "only some frames have mask"),
    ],
)
def test_unusable_frames_leave_nothing_behind(frames: list[BopFrame], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        write_scene(tmp_path, "test", 0, frames, "m", STEP)
    assert list((tmp_path / "test").iterdir()) == []


def test_a_scene_is_written_once_and_debris_is_cleared(tmp_path: Path) -> None:
    debris = tmp_path / "test" / ".000000.writing" / "depth"
    debris.mkdir(parents=True)
    (debris / "000009.png").write_bytes(b"cut off")
    write_scene(tmp_path, "test", 0, [sample_frame(0)], "m", STEP)
    assert [path.name for path in (tmp_path / "test").iterdir()] == ["000000"]
    assert len(list((tmp_path / "test" / "000000" / "depth").iterdir())) == 1
    with pytest.raises(InputError, match="000000 exists already"):
        write_scene(tmp_path, "test", 0, [sample_frame(0)], "m", STEP)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write"):
        write_scene(tmp_path / "file", "test", 0, [sample_frame(0)], "m", STEP)
    for bad in (0.0, float("nan")):
        with pytest.raises(InputError, match="depth_scale is"):
            write_scene(tmp_path, "test", 1, [sample_frame(0)], "m", bad)


def test_an_empty_frame_and_unknown_visibility(tmp_path: Path) -> None:
    """A bin may be empty, and a dataset need not tell what is hidden: no scene_gt_info.json then."""
    write_scene(tmp_path, "test", 0, [frame_with(instances=()), frame_with()], "m", STEP)
    assert not (tmp_path / "test" / "000000" / "scene_gt_info.json").exists()
    dataset = BopDataset(tmp_path, "test", unit="m")
    assert dataset[0].instances == ()
    assert [instance.visible_fraction for instance in dataset[1].instances or ()] == [None] * 3
    assert dataset.problems() == ()


def test_frames_refuse_contradictions() -> None:
    depth = np.ones((48, 64), np.float32)
    with pytest.raises(InputError, match=r"depth has .* pixels, but the camera"):
        BopFrame(CAMERA, depth[:-1])
    with pytest.raises(InputError, match="bin and T_camera_bin belong together"):
        BopFrame(CAMERA, depth, T_camera_bin=np.eye(4))
    with pytest.raises(InputError, match="masks has shape"):
        BopFrame(CAMERA, depth, (), masks=np.zeros((1, 48, 64), bool))
    with pytest.raises(InputError, match=r"visible_fraction is 1\.5"):
        BopInstance(1, np.eye(4), visible_fraction=1.5)
