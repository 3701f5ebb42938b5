"""World bins: what is asked for where, and how what is found there is counted."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments import detect_worlds
from experiments.bins import LEAST_VISIBLE, WorldImage, _like_in_size, world_images
from experiments.detect_bins import Tally
from experiments.detect_worlds import WorldTally, scan_of
from experiments.test_sets import SPLIT
from experiments.worlds import FAMILIES, TARGETS, TRAINING, VALIDATION, build_worlds, kind_of, sensed
from experiments.worst_images import WorstImages
from kmn_jax.bop import BopDataset
from kmn_jax.detection import CropPrediction, Detection, Detections, Timing, make_scene
from kmn_jax.errors import InputError
from kmn_jax.models import Model, load_pretrained


@pytest.fixture(scope="module")
def model() -> Model:
    return load_pretrained()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two families of worlds, two of parts."""
    folder = tmp_path_factory.mktemp("worlds")
    families = {family.name: family for family in FAMILIES}
    chosen = (
        replace(families["mixed parts"], sensor="perfect", others=(1, 2), copies=(1, 2)),
        replace(families["touching rows"], sensor="perfect", copies=(4, 4)),
    )
    recipe = replace(VALIDATION, parts=("washer", "lever"), images=4, size=(320, 240), families=chosen)
    build_worlds(folder, recipe, workers=2)
    with pytest.raises(InputError, match="another recipe"):
        build_worlds(folder, replace(recipe, images=5))
    return folder


@pytest.fixture(scope="module")
def images(folder: Path, model: Model) -> list[WorldImage]:
    return list(world_images(folder, model))


def test_a_quarter_of_the_images_lack_the_part(folder: Path) -> None:
    targets = json.loads((folder / TARGETS).read_text())
    assert len(targets) == 8
    dataset = BopDataset(folder, SPLIT, unit="mm")
    assert not dataset.problems()
    for target in targets:
        frame = dataset.frame(target["scene_id"], target["im_id"])
        assert {instance.object_id for instance in frame.instances or ()} <= {target["obj_id"]}
        assert len(frame.instances or ()) == target["inst_count"]
        assert (target["inst_count"] == 0) == (target["im_id"] == 3)
        assert (frame.depth > 0).mean() > 0.5


def test_parts_in_rows_touch_nothing_but_each_other(folder: Path) -> None:
    frame = BopDataset(folder, SPLIT, unit="mm").frame(2, 0)
    heights = np.array([instance.T_camera_object[:3, 3] for instance in frame.instances or ()])
    assert len(heights) == 4
    apart = np.linalg.norm(heights[:, None] - heights[None], axis=2)[~np.eye(4, dtype=bool)].reshape(4, 3)
    np.testing.assert_allclose(apart.min(axis=1), apart.min(), rtol=0.05)


def test_images_come_with_their_scans(folder: Path, model: Model, images: list[WorldImage]) -> None:
    assert [image.family for image in images] == ["mixed parts"] * 4 + ["touching rows"] * 4
    first, in_rows = images[0], images[4]
    (stranger,) = in_rows.strangers  # there are two kinds
    names = json.loads((folder / "models" / "object_names.json").read_text())
    numbers = [str(int(part.name.removeprefix("obj_"))) for part in (in_rows.part, stranger)]
    assert {kind_of(names[number]) for number in numbers} == {"washer", "lever"}
    assert len(first.scan.points) == (first.scan.depth > 0).sum()  # type: ignore[operator]
    assert first.errors(first.truth).argmin(axis=1).tolist() == list(range(len(first.truth)))
    with pytest.raises(InputError, match="build_data worlds"):
        next(world_images(folder / "models", model))


def test_no_stranger_is_searched_where_it_may_lie(images: list[WorldImage]) -> None:
    """Other parts of an image, which are those nearest in size, have no poses: a stranger may be one of them."""
    for image in images:
        may_lie = image.family == "mixed parts" or not len(image.truth)
        assert (not image.strangers) == may_lie


def test_scans_are_cut_out_around_copies(images: list[WorldImage]) -> None:
    for image in images[:1] + images[4:5]:  # of one copy or two, and of four in a row
        whole, cut = image.cloud(), image.cloud(0.1)
        assert (whole.depth, whole.camera, cut.camera) == (None, None, None)
        np.testing.assert_array_equal(whole.points, image.scan.points)
        surface = np.concatenate([image.part.points @ T[:3, :3].T + T[:3, 3] for T in image.truth])
        kept = {tuple(point) for point in cut.points}
        some = np.concatenate([whole.points[:: len(whole.points) // 200], cut.points[:: len(cut.points) // 50 + 1]])
        near = np.linalg.norm(surface[None] - some[:, None], axis=2).min(axis=1) < 0.1 * image.part.diameter
        assert [tuple(point) in kept for point in some] == near.tolist()
        assert 0.05 < near.mean() < 0.95
    assert not len(images[3].cloud(0.1).points)


def test_worlds_are_given_in_the_form_that_is_asked_for(images: list[WorldImage]) -> None:
    present, absent = images[0], images[3]
    assert scan_of(present, "images") is present.scan
    whole, cut = scan_of(present, "clouds"), scan_of(present, "cut-outs")
    assert whole is not None
    assert cut is not None
    assert (whole.camera, len(whole.points)) == (None, len(present.scan.points))
    assert len(present.cloud(0.1).points) < len(cut.points) < len(whole.points)
    assert scan_of(absent, "clouds") is not None
    assert scan_of(absent, "cut-outs") is None


def test_counts(images: list[WorldImage]) -> None:
    present, *_, absent = images[:4]
    assert not len(absent.truth)

    def found(image: WorldImage, poses: list[np.ndarray], probability: float) -> Detections:
        nothing = CropPrediction(np.zeros((0, 3), np.float32), np.zeros(0, bool), np.zeros(0, int))
        made = [Detection(pose, probability, 9, 1.0, 0.5, 1.0, 0.0, 0.0, 0.0, np.zeros(3), nothing) for pose in poses]
        return Detections(image.part.name, "mm", tuple(made), Timing({"search": 1.0}, 0.0))

    tally = WorldTally()
    beside = present.truth[0] + np.array([[0, 0, 0, 1000.0]] * 3 + [[0] * 4])
    tally.add(present, Tally.of(present, found(present, [present.truth[0], beside], 0.95)))
    tally.add(absent, Tally.of(absent, found(absent, [np.eye(4)], 0.85)))
    tally.add_stranger(found(present, [np.eye(4)], 0.2))
    row = tally.row("these")
    assert row["precision"] == pytest.approx(1 / 3)
    assert row["first right"] == 1
    assert row["right from 0.9 on"] == 0.5
    assert (row["searched in vain"], row["accepted there"]) == (2, 1)
    copies, seen = tally.found.copies, bool(present.visible[0] >= LEAST_VISIBLE)
    assert row["MSSD recall"] == pytest.approx(seen / copies)
    # The most probable pose is right, all others are wrong: precision is 1 up to a recall of one copy.
    assert row["average precision"] == pytest.approx(seen * (100 // copies + 1) / 101)
    assert row["shifted, mm, median"] == pytest.approx(0, abs=1e-3)
    assert row["turned, degrees, 90%"] == pytest.approx(0, abs=0.1)


def test_what_was_searched_before_an_interruption_counts(
    images: list[WorldImage], monkeypatch: pytest.MonkeyPatch
) -> None:
    def some(count: int) -> Callable[..., Iterator[WorldImage]]:
        def images_then_interrupted(*_: object) -> Iterator[WorldImage]:
            yield from images[:count]
            raise KeyboardInterrupt

        return images_then_interrupted

    nothing = Detections("part", "mm", (), Timing({"search": 1.0}, 0.0), "nothing was found")
    monkeypatch.setattr(detect_worlds, "found_in", lambda *_: (None, nothing))
    monkeypatch.setattr(detect_worlds, "world_images", some(2))
    rows = detect_worlds.run(detect_worlds.Options())["detection"]
    assert {row["bins"]: row["images"] for row in rows} == {"mixed parts": 2, "all": 2} | {detect_worlds._OTHERS: 2}
    monkeypatch.setattr(detect_worlds, "world_images", some(0))
    with pytest.raises(InputError, match=r"no image .* was searched"):
        detect_worlds.run(detect_worlds.Options())


def test_the_worst_images_are_drawn(images: list[WorldImage], tmp_path: Path) -> None:
    worst, counts = WorstImages(accepted=0.5), [(1, 0.9, True), (3, 0.9, True), (1, 0.9, False)]
    for image, (copies, probability, right) in zip(images[:3], counts, strict=True):
        nothing = Detections(image.part.name, "mm", (), Timing({}, 0.0), "nothing was found")
        counted = Tally([probability], [right], [right], copies)
        worst.add(image, make_scene(image.scan, image.part.diameter), nothing, counted)
    # Nothing is wrong in the first; two of three copies are missed in the second, one in the third, which has a wrong
    # pose besides.
    drawn = worst.save(tmp_path / "worst")
    assert [path.name for path in drawn] == [
        "mixed_parts-000001-000001-2_missed-0_wrong.png",
        "mixed_parts-000001-000002-1_missed-1_wrong.png",
    ]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in drawn)


def test_strangers_are_the_parts_of_other_kinds_that_are_nearest_in_size() -> None:
    parts: dict[str, Any] = {
        name: SimpleNamespace(diameter=size) for name, size in zip("abcd", (9, 12, 8, 40), strict=True)
    }
    others = [
        ("round", parts["d"]),
        ("flat", parts["b"]),
        ("round", parts["c"]),
        ("round", parts["a"]),
        ("flat", parts["c"]),
        ("long", parts["d"]),
    ]
    found = _like_in_size(SimpleNamespace(diameter=10.0), others)  # type: ignore[arg-type]
    assert found == (parts["a"], parts["b"], parts["d"])
    assert _like_in_size(SimpleNamespace(diameter=10.0), others[:1]) == (parts["d"],)  # type: ignore[arg-type]
    assert _like_in_size(SimpleNamespace(diameter=10.0), []) == ()  # type: ignore[arg-type]


def test_sensors_take_turns_where_parts_are_known() -> None:
    pile = next(family for family in FAMILIES if family.name == "deep pile")
    sensors = [sensed(pile, TRAINING, image).sensor for image in range(TRAINING.images)]
    assert sensors[:10] == ["structured_light"] * 3 + ["stereo"] * 3 + ["time_of_flight"] * 3 + ["structured_light"]
    # Neither images without the part, every fourth, nor the ways in which scans are given go with one sensor.
    assert (
        {sensors[image] for image in range(3, 24, 4)} == {sensors[image] for image in range(0, 24, 3)} == set(sensors)
    )
    assert all(sensed(pile, VALIDATION, image) == pile for image in range(16))
