"""A BOP image as a scan: the same points as by its dataset, its true poses, and faults as one sentence."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.bop import BopDataset, bop_files, bop_scan, bop_scene_id, bop_sizes, is_bop_image
from kmn_jax.cli import main
from kmn_jax.errors import InputError
from kmn_jax.geometry import measured_points
from tests.bop.bop_sample import edit_json, sample_frame, save_image, write_blenderproc, write_sample


@pytest.fixture
def image(tmp_path: Path) -> Path:
    return write_sample(tmp_path / "bins") / "test" / "000003" / "depth" / "000001.png"


def test_it_is_the_frame_of_its_dataset(image: Path) -> None:
    scan, instances = bop_scan(image)
    frame = BopDataset(image.parents[3], "test").frame(3, 1)
    assert is_bop_image(image)
    assert (scan.unit, scan.camera, scan.normals) == ("mm", frame.camera, None)
    np.testing.assert_array_equal(scan.depth, frame.depth)
    np.testing.assert_allclose(scan.points, measured_points(frame.depth, frame.camera), rtol=1e-5, atol=1e-4)
    truth = sample_frame(31)
    assert scan.depth is not None
    np.testing.assert_allclose(scan.depth, truth.depth * 1000, atol=0.011)  # half a step
    assert instances is not None
    assert [instance.object_id for instance in instances] == [1, 2, 1]
    for found, wanted in zip(instances, truth.instances or (), strict=True):
        np.testing.assert_allclose(found.T_camera_object[:3, 3], wanted.T_camera_object[:3, 3] * 1000, rtol=1e-6)


def test_lengths_come_in_the_unit_asked_for(image: Path) -> None:
    (scan, instances), (metres, moved) = bop_scan(image), bop_scan(image, "m")
    assert metres.unit == "m"
    np.testing.assert_allclose(metres.points * 1000, scan.points, rtol=1e-5)
    assert instances is not None
    assert moved is not None
    np.testing.assert_allclose(moved[0].T_camera_object[:3, 3] * 1000, instances[0].T_camera_object[:3, 3])
    with pytest.raises(InputError, match="unit 'feet' is not known"):
        bop_scan(image, "feet")


def test_depth_scale_and_saturation_are_those_of_the_scene(tmp_path: Path) -> None:
    path = write_blenderproc(tmp_path) / "train_pbr" / "000000" / "depth" / "000002.png"
    scan, _ = bop_scan(path)
    assert scan.depth is not None
    assert 500 < scan.depth[scan.depth > 0].min() < scan.depth.max() < 700  # steps of 0.1 mm, background left out
    assert len(scan.points) == (scan.depth > 0).sum() < scan.depth.size / 2


def test_without_true_poses_there_are_none(image: Path) -> None:
    (image.parents[1] / "scene_gt.json").unlink()
    scan, instances = bop_scan(image)
    assert instances is None
    assert len(scan.points) > 1000


def test_a_scene_of_several_sensors(image: Path) -> None:
    scene = image.parents[1]
    shutil.copytree(image.parent, scene / "depth_left")
    for name in ("scene_camera", "scene_gt"):
        shutil.copy(scene / f"{name}.json", scene / f"{name}_left.json")
    edit_json(scene / "scene_camera_left.json", "1", "depth_scale", value=0.04)
    left, instances = bop_scan(scene / "depth_left" / image.name)
    np.testing.assert_allclose(left.depth, 2 * np.asarray(bop_scan(image)[0].depth), rtol=1e-6)
    assert instances is not None


def test_a_scene_folder_is_enough_and_paths_may_be_relative(image: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = image.parents[1].rename(image.parents[3].parent / "scan of today")
    monkeypatch.chdir(scene / "depth")
    assert is_bop_image(image.name)
    assert len(bop_scan(image.name)[0].points) > 1000
    assert bop_scene_id(image.name) == 0


def test_scene_and_objects_of_a_dataset(image: Path) -> None:
    assert bop_scene_id(image) == int(image.parents[1].name)
    infos = image.parents[3] / "models" / "models_info.json"
    found = bop_sizes(image)
    assert found
    for key, info in json.loads(infos.read_text()).items():
        assert found[int(key)][0] == info["diameter"]
        assert found[int(key)][1] == min(info[name] for name in ("size_x", "size_y", "size_z"))
    for content in ("{", "[]", '{"1": {}}'):
        infos.write_text(content)
        assert bop_sizes(image) == {}
    infos.unlink()
    assert bop_sizes(image) == {}


def test_other_images_are_none_of_a_bop_scene(image: Path) -> None:
    for other in ("depth.png", "000001.ply", "a1.png"):
        assert not is_bop_image(image.parent / other)
    (image.parents[1] / "scene_camera.json").unlink()
    assert not is_bop_image(image)
    with pytest.raises(InputError, match="is not a depth image of a BOP scene"):
        bop_scan(image)


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("scene_camera.json", "1"), ..., "image 1: is missing"),
        (("scene_camera.json", "1", "depth_scale"), 0, "depth_scale is 0, but must be above zero"),
        (("scene_camera.json", "1", "cam_K"), [1, 2], "cam_K must hold 9 numbers"),
        (("scene_gt.json", "1", 0, "cam_R_m2c"), [1] * 9, "instance 0: cam_R_m2c is not a rotation"),
        (("scene_gt.json", "1"), ..., "scene_gt.json: image 1: is missing"),
    ],
)
def test_broken_entries_are_named(image: Path, keys: tuple[str, ...], value: object, message: str) -> None:
    file, *names = keys
    edit_json(image.parents[1] / file, *names, value=value)
    with pytest.raises(InputError, match=message) as caught:
        bop_scan(image)
    assert str(caught.value).startswith(f"{image} cannot be used: ")
    assert "\n" not in str(caught.value)


def test_broken_files_are_named(image: Path) -> None:
    save_image(image, np.zeros((48, 64), np.uint16))
    with pytest.raises(InputError, match="none of its 48 x 64 pixels was measured"):
        bop_scan(image)
    image.write_bytes(b"\x89PNG")
    with pytest.raises(InputError, match="is not a readable image"):
        bop_scan(image)
    image.unlink()
    with pytest.raises(InputError, match=r"000001.png is missing"):
        bop_scan(image)
    shutil.copy(image.with_name("000002.png"), image.with_name("2.tif"))
    with pytest.raises(InputError, match="are both image 2 of their scene"):
        bop_scan(image.with_name("000002.png"))
    (image.parents[1] / "scene_gt.json").write_text("{")
    with pytest.raises(InputError, match=r"scene_gt.json is not valid JSON"):
        bop_scan(image.with_name("000000.png"))


def test_a_scale_beyond_float32_measures_nothing(image: Path) -> None:
    edit_json(image.parents[1] / "scene_camera.json", "1", "depth_scale", value=1e300)
    with pytest.raises(InputError, match=r"none of its .* pixels was measured"):
        bop_scan(image)


@pytest.mark.parametrize("name", ["scene_camera.json", "scene_gt.json"])
def test_no_output_replaces_what_an_image_is_read_with(
    image: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = image.parent.parent / name
    content = file.read_bytes()
    assert main(["detect", "--object", "part.stl", "--scene", str(image), "--json", str(file)]) == 2
    assert "it is read, too, and would be lost" in capsys.readouterr().err
    assert file.read_bytes() == content
    assert bop_files(image.with_name("cloud.ply")) == ()
