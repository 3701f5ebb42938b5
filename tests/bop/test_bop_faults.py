"""Broken datasets: each fault is named with its file and entry, and whatever else is there stays usable."""

from __future__ import annotations

import json
import pickle
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.bop import BopDataset, FrameKey
from kmn_jax.bop._files import BopFault
from kmn_jax.errors import InputError
from tests.bop.bop_sample import edit_json, save_image, write_sample

SCENE = "test/000000"
GT, CAMERA, INFO, BIN = (f"{SCENE}/{name}.json" for name in ("scene_gt", "scene_camera", "scene_gt_info", "scene_bin"))
Damage = Callable[[Path], None]


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample(tmp_path_factory.mktemp("template"))


@pytest.fixture
def folder(template: Path, tmp_path: Path) -> Path:
    return shutil.copytree(template, tmp_path / "bop")


def setting(name: str, *keys: str | int, value: object) -> Damage:
    return lambda folder: edit_json(folder / name, *keys, value=value)


def content(name: str, data: bytes) -> Damage:
    def damage(folder: Path) -> None:
        (folder / name).write_bytes(data)

    return damage


def image(name: str, values: np.ndarray) -> Damage:
    return lambda folder: save_image(folder / name, values)


def removed(name: str) -> Damage:
    return lambda folder: (folder / name).unlink()


def cut(name: str, size: int) -> Damage:
    def damage(folder: Path) -> None:
        (folder / name).write_bytes((folder / name).read_bytes()[:size])

    return damage


DEPTH, MASK = f"{SCENE}/depth/000001.png", f"{SCENE}/mask/000001_000001.png"
VISIBLE = f"{SCENE}/mask_visib/000001_000000.png"
SMALL, GREY = np.ones((24, 32), np.uint16), np.ones((48, 64), np.uint8)
FLAT = np.diag([1.0, 1, -1]).ravel().tolist()
TRUTH = {"obj_id": 1, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 1]}

# Damage to image 1 of scene 0: what breaks it, the file that is named, and what the message says.
OF_A_FRAME: dict[str, tuple[Damage, str, str]] = {
    "depth missing": (removed(DEPTH), DEPTH, "is missing"),
    "depth of zero bytes": (content(DEPTH, b""), DEPTH, "is empty (0 bytes)"),
    "depth truncated": (cut(DEPTH, 600), DEPTH, "is not a readable image"),
    "depth is text": (content(DEPTH, b"no image"), DEPTH, "is not a readable image"),
    "depth of 8 bits": (image(DEPTH, GREY), DEPTH, "has L pixels, but a depth image has one channel of 16"),
    "depth in colour": (image(DEPTH, np.dstack([GREY] * 3)), DEPTH, "has RGB pixels"),
    "depth size": (image(DEPTH, SMALL), DEPTH, "has 32 x 24 pixels, but mask/000001_000000.png 64 x 48"),
    "colour size": (image(f"{SCENE}/gray/000001.png", GREY[:40]), DEPTH, "but gray/000001.png 64 x 40"),
    "mask missing": (removed(MASK), MASK, "is missing"),
    "mask truncated": (cut(MASK, 100), MASK, "is not a readable image"),
    "mask in colour": (image(MASK, np.dstack([GREY] * 3)), MASK, "has RGB pixels, but a mask has one channel"),
    "mask size": (image(VISIBLE, GREY[:9]), DEPTH, "has 64 x 48 pixels, but mask_visib/000001_000000.png 64 x 9"),
    "no camera": (setting(CAMERA, "1", value=...), CAMERA, "image 1: is missing"),
    "no ground truth": (setting(GT, "1", value=...), GT, "image 1: is missing"),
    "no visibility": (setting(INFO, "1", value=...), INFO, "image 1: is missing"),
    "camera is a list": (setting(CAMERA, "1", value=[]), CAMERA, "image 1: must be a JSON object"),
    "no depth_scale": (setting(CAMERA, "1", "depth_scale", value=...), CAMERA, "image 1: depth_scale is missing"),
    "zero depth_scale": (setting(CAMERA, "1", "depth_scale", value=0), CAMERA, "depth_scale is 0, but must be above"),
    "text": (setting(CAMERA, "1", "depth_scale", value="0.1"), CAMERA, "holds '0.1', which is not a number"),
    "infinity": (setting(CAMERA, "1", "depth_scale", value=float("inf")), CAMERA, "depth_scale holds NaN, infinity"),
    "no cam_K": (setting(CAMERA, "1", "cam_K", value=...), CAMERA, "image 1: cam_K is missing"),
    "short cam_K": (setting(CAMERA, "1", "cam_K", value=[1, 2]), CAMERA, "cam_K must hold 9 numbers, but has 2 values"),
    "skew": (setting(CAMERA, "1", "cam_K", 1, value=3), CAMERA, "a camera with skew is not supported"),
    "focal length": (setting(CAMERA, "1", "cam_K", 0, value=-80), CAMERA, "focal lengths -80, 82, which must be above"),
    "cam_R_w2c": (setting(CAMERA, "1", "cam_R_w2c", value=FLAT), CAMERA, "image 1: cam_R_w2c is not a rotation"),
    "half a cam_w2c": (setting(CAMERA, "1", "cam_t_w2c", value=...), CAMERA, "image 1: cam_t_w2c is missing"),
    "nan": (setting(GT, "1", 2, "cam_t_m2c", 0, value=float("nan")), GT, "image 1, instance 2: cam_t_m2c holds NaN"),
    "huge": (setting(GT, "1", 2, "cam_t_m2c", 0, value=10**400), GT, "image 1, instance 2: cam_t_m2c holds NaN, inf"),
    "reflection": (setting(GT, "1", 0, "cam_R_m2c", value=FLAT), GT, "instance 0: cam_R_m2c is not a rotation"),
    "scaled": (setting(GT, "1", 0, "cam_R_m2c", value=[9] * 9), GT, "instance 0: cam_R_m2c is not a rotation"),
    "8 numbers": (setting(GT, "1", 1, "cam_R_m2c", 8, value=...), GT, "must hold 9 numbers, but has 8 values"),
    "no list": (setting(GT, "1", 1, "cam_t_m2c", value=5), GT, "cam_t_m2c must hold 3 numbers, but has no list"),
    "bool": (setting(GT, "1", 1, "cam_t_m2c", 0, value=True), GT, "cam_t_m2c holds 'True', which is not a number"),
    "unknown object": (setting(GT, "1", 1, "obj_id", value=7), GT, "instance 1: obj_id 7 has no model"),
    "fraction of an id": (setting(GT, "1", 1, "obj_id", value=1.5), GT, "obj_id is 1.5, but must be a whole number"),
    "instance is text": (setting(GT, "1", 1, value="x"), GT, "image 1, instance 1: must be a JSON object"),
    "no instances": (setting(GT, "1", value={}), GT, "image 1: must be a list of instances"),
    "fewer infos": (setting(INFO, "1", 2, value=...), INFO, "image 1: has 2 instances, but scene_gt.json has 3"),
    "visib_fract": (setting(INFO, "1", 0, "visib_fract", value=1.2), INFO, "instance 0: visible_fraction is 1.2"),
    "box": (setting(INFO, "1", 0, "bbox_obj", value=[1, 2]), INFO, "bbox_obj must hold 4 numbers"),
    "bin size": (setting(BIN, "1", "width", value=0), BIN, "image 1: bin: length, width, height and thickness are"),
    "bin pose": (setting(BIN, "1", "cam_R_b2c", value=...), BIN, "image 1: cam_R_b2c is missing"),
}


@pytest.mark.parametrize("name", OF_A_FRAME)
def test_a_broken_frame_is_named_and_the_others_stay_usable(name: str, folder: Path) -> None:
    damage, file, message = OF_A_FRAME[name]
    (folder / SCENE / "gray").mkdir()
    damage(folder)
    dataset = BopDataset(folder, "test")
    problems = dataset.problems()
    assert {(problem.scene_id, problem.image_id) for problem in problems} == {(0, 1)}
    named = [problem for problem in problems if problem.file == folder / file and message in str(problem)]
    assert len(named) == 1, [str(problem) for problem in problems]
    assert str(folder / file) in str(named[0])
    assert dataset.usable() == tuple(key for key in dataset.keys if key != FrameKey(0, 1))
    for key in dataset.usable():
        dataset.frame(*key, masks=True)
    with pytest.raises(InputError, match=r"frame 1 of scene 0 cannot be used: .*"):
        dataset.frame(0, 1, masks=True)
    if not name.startswith("mask"):  # only what is asked for is read
        with pytest.raises(InputError, match=r"frame 1 of scene 0 cannot be used: .*" + re.escape(str(folder))):
            dataset[1]


OF_A_SCENE: dict[str, tuple[Damage, str, str]] = {
    "broken": (content(GT, b'{"0": ['), GT, "is not valid JSON"),
    "zeros": (content(GT, bytes(100)), GT, "is not valid JSON"),
    "no text": (content(GT, b'{"\xff": 1}'), GT, "is not valid JSON"),
    "nested": (content(GT, b"[" * 10**6), GT, "is not valid JSON"),
    "zero bytes": (content(GT, b""), GT, "is empty (0 bytes)"),
    "missing": (removed(GT), GT, "is missing"),
    "list": (content(GT, b"[]"), GT, "must hold a JSON object"),
    "key": (setting(GT, "first", value=[]), GT, "key 'first': must be an id"),
    "long key": (setting(GT, "1" * 5000, value=[]), GT, "has more than 18 digits, but must be an id"),
    "long number": (content(GT, b'{"0": ' + b"9" * 5000 + b"}"), GT, "is not valid JSON"),
    "two keys": (setting(GT, "01", value=[]), GT, "key '01': stands there twice"),
    "same keys": (content(GT, b'{"0": [], "1": [], "0": []}'), GT, "two values for the key '0'"),
    "camera missing": (removed(CAMERA), CAMERA, "is missing"),
    "camera broken": (cut(CAMERA, 200), CAMERA, "is not valid JSON"),
    "info broken": (cut(INFO, 200), INFO, "is not valid JSON"),
    "bin broken": (content(BIN, b""), BIN, "is empty (0 bytes)"),
}


@pytest.mark.parametrize("name", OF_A_SCENE)
def test_a_broken_file_is_named_once_and_other_scenes_stay_usable(name: str, folder: Path) -> None:
    damage, file, message = OF_A_SCENE[name]
    damage(folder)
    dataset = BopDataset(folder, "test")
    (problem,) = dataset.problems()
    assert (problem.file, problem.scene_id, problem.image_id) == (folder / file, 0, None)
    assert message in str(problem)
    assert len(dataset) == 6
    assert dataset.usable() == (FrameKey(3, 0), FrameKey(3, 1), FrameKey(3, 2))
    with pytest.raises(InputError, match=r"frame 2 of scene 0 cannot be used: .*" + re.escape(file)):
        dataset[2]
    dataset[3]


def test_all_faults_of_a_frame_are_named(folder: Path) -> None:
    edit_json(folder / GT, "1", 0, "cam_t_m2c", 0, value=float("nan"))
    edit_json(folder / GT, "1", 2, "obj_id", value=9)
    (folder / DEPTH).write_bytes(b"")
    dataset = BopDataset(folder, "test")
    for decode in (True, False):
        assert [problem.entry for problem in dataset.problems(decode)] == [
            "image 1, instance 0",
            "image 1, instance 2",
            "",
        ]
    with pytest.raises(InputError, match=r"image 1, instance 0: .* \(2 more faults: see BopDataset.problems\)"):
        dataset[1]


def test_sizes_are_checked_without_decoding(folder: Path) -> None:
    save_image(folder / DEPTH, SMALL)
    problems = BopDataset(folder, "test").problems(decode=False)
    others = [re.search(r"but (\S+) ", problem.what) for problem in problems]
    names = [found[1] for found in others if found]
    assert names == [f"{kind}/000001_00000{i}.png" for kind in ("mask", "mask_visib") for i in range(3)] + [
        "camera.json"
    ]


def test_camera_json_tells_the_size_of_images_with_its_intrinsics_only(folder: Path) -> None:
    """Training images of some datasets are crops: another principal point, another size."""
    for name in ("mask", "mask_visib"):
        shutil.rmtree(folder / SCENE / name)
    save_image(folder / DEPTH, SMALL)
    assert [problem.image_id for problem in BopDataset(folder, "test").problems()] == [1]
    edit_json(folder / CAMERA, "1", "cam_K", 2, value=16.0)
    dataset = BopDataset(folder, "test")
    assert dataset.problems() == ()
    assert (dataset[1].camera.width, dataset[1].camera.cx) == (32, 16.0)


def test_frames_without_public_poses(folder: Path) -> None:
    (folder / GT).unlink()
    dataset = BopDataset(folder, "test", ground_truth=False)
    assert dataset.problems() == ()
    assert len(dataset) == 6
    assert dataset[0].instances is None
    assert dataset[0].bin is not None


MODELS_INFO = "models/models_info.json"


@pytest.mark.parametrize(
    ("damage", "file", "message"),
    [
        (setting(MODELS_INFO, "1", "diameter", value=...), MODELS_INFO, "object 1: diameter is missing"),
        (setting(MODELS_INFO, "1", "diameter", value=0), MODELS_INFO, "object 1: diameter is 0 and must be above zero"),
        (setting(MODELS_INFO, "1", "size_x", value=float("nan")), MODELS_INFO, "object 1: size_x holds NaN"),
        (setting(MODELS_INFO, "1", value=...), MODELS_INFO, "object 1: is missing, but obj_000001.ply exists"),
        (content("models/obj_000001.ply", b""), "models/obj_000001.ply", "is empty (0 bytes)"),
    ],
)
def test_a_broken_model_is_named_and_the_others_stay_usable(
    damage: Damage, file: str, message: str, folder: Path
) -> None:
    damage(folder)
    dataset = BopDataset(folder, "test")
    (problem,) = dataset.problems()
    assert (problem.file, problem.scene_id) == (folder / file, None)
    assert message in str(problem)
    assert dataset.model(2).name == "turned"
    with pytest.raises(InputError, match="object 1 has no usable model: .*" + re.escape(message)):
        dataset.model(1)
    assert dataset.usable() == dataset.keys
    dataset[0]


@pytest.mark.parametrize("data", [b"", b"{"])
def test_broken_dataset_files_spare_the_frames(data: bytes, folder: Path) -> None:
    for name in ("camera.json", MODELS_INFO):
        (folder / name).write_bytes(data)
    dataset = BopDataset(folder, "test")
    problems = dataset.problems()
    assert [problem.file.name for problem in problems] == ["models_info.json", "camera.json"]
    assert re.search(r"camera.json (is empty|is not valid JSON)", str(problems[1]))
    assert dataset.usable() == dataset.keys
    dataset[0]
    with pytest.raises(InputError, match=r"object 2 has no usable model: .*models_info.json (is empty|is not valid)"):
        dataset.model(2)


def test_camera_json_of_nothing(folder: Path) -> None:
    edit_json(folder / "camera.json", "width", value=0)
    (problem,) = BopDataset(folder, "test").problems()
    assert "an image of 0 x 48 pixels is empty" in str(problem)


def test_asking_for_what_is_not_there(folder: Path) -> None:
    with pytest.raises(InputError, match=r"no split 'train' with scenes; its splits: test$"):
        BopDataset(folder, "train")
    with pytest.raises(InputError, match=r"has no split 'test' .* none: a split is a folder of folders"):
        BopDataset(folder / "models", "test")
    with pytest.raises(InputError, match="is not a folder"):
        BopDataset(folder / "absent", "test")
    dataset = BopDataset(folder, "test")
    with pytest.raises(InputError, match="has no scene 1"):
        dataset.frame(1, 0)
    with pytest.raises(InputError, match="has no image 3"):
        dataset.frame(0, 3)
    with pytest.raises(IndexError):
        dataset[6]


def test_faults_survive_the_way_between_processes() -> None:
    fault = pickle.loads(pickle.dumps(BopFault(Path("a/b.json"), "image 3", "is missing", 1, 3)))
    assert (str(fault), fault.entry) == ("a/b.json: image 3: is missing", "image 3")
    assert (fault.scene_id, fault.image_id) == (1, 3)
    assert isinstance(fault, InputError)


def test_sample_json_is_what_other_readers_expect(folder: Path) -> None:
    truth = json.loads((folder / GT).read_text())
    assert list(truth) == ["0", "1", "2"]
    assert sorted(truth["0"][0]) == sorted(TRUTH)
    info = json.loads((folder / INFO).read_text())
    assert sorted(info["0"][0]) == [
        "bbox_obj",
        "bbox_visib",
        "px_count_all",
        "px_count_valid",
        "px_count_visib",
        "visib_fract",
    ]
    camera = json.loads((folder / CAMERA).read_text())
    assert sorted(camera["0"]) == ["cam_K", "cam_R_w2c", "cam_t_w2c", "depth_scale"]
    assert camera["0"]["cam_K"] == [80, 0, 31.5, 0, 82, 23, 0, 0, 1]
    sensor = json.loads((folder / "camera.json").read_text())
    assert sensor == {"cx": 31.5, "cy": 23, "depth_scale": 0.02, "fx": 80, "fy": 82, "height": 48, "width": 64}


def test_two_folders_of_one_scene_id(folder: Path) -> None:
    before = BopDataset(folder, "test")
    shutil.copytree(folder / SCENE, folder / "test" / "0")
    dataset = BopDataset(folder, "test")
    assert dataset.keys == before.keys
    assert [problem.file for problem in dataset.problems()] == [folder / "test" / "000000"]
    assert "has the scene id of another folder" in str(dataset.problems()[0])
    assert len(dataset.usable()) == len(dataset)
