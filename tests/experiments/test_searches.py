"""What probabilities are fitted to: which parts are searched in which images, and in which forms of their scans."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from experiments import searches as module
from experiments.bins import WorldImage
from experiments.searches import Search, Sources, as_given, searches
from kmn_jax.bop import FrameKey
from kmn_jax.errors import InputError
from kmn_jax.io import Scan
from tests.reference.clouds import box_cloud


def part(name: str) -> Any:
    return SimpleNamespace(name=name, points=box_cloud(0, 256, (4.0, 2.0, 1.0))[:, :3], diameter=4.5)


def world(strangers: str = "", copies: int = 1, kind: str = "cup") -> WorldImage:
    """Make the image of a floor, with copies in the middle of it or none."""
    grid = np.stack(np.meshgrid(*[np.linspace(-20, 20, 161)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    scan = Scan(grid, None, None, None, "mm")
    truth = np.tile(np.eye(4), (copies, 1, 1))
    return WorldImage(
        FrameKey(3, 1), part("own"), tuple(map(part, strangers)), truth, np.ones(copies), "table", kind, scan
    )


def asked(image: Any, row: int, is_known: bool = False) -> list[tuple[str, str]]:
    return [(part.name, form) for part, form in module._asked(image, row, is_known)]


def test_strangers_are_searched_by_turns() -> None:
    image: Any = SimpleNamespace(part=part("own"), strangers=tuple(map(part, "abcdefgh")))
    assert asked(image, 4) == [("own", "image"), ("a", "image"), ("c", "image"), ("e", "image")]
    assert asked(image, 5) == [("own", "image"), ("b", "image"), ("d", "image"), ("f", "image")]
    image.strangers = image.strangers[:2]
    assert asked(image, 4)[1:] == [("a", "image")]
    image.strangers = ()
    assert asked(image, 5) == [("own", "image")]


def test_worlds_are_given_as_images_and_in_other_forms_by_turns() -> None:
    image = world("abcdef")
    assert asked(image, 0) == [
        ("own", "image"),
        ("a", "image"),
        ("c", "image"),
        ("e", "cloud"),
        ("own", "cloud"),
    ]
    assert asked(image, 1)[2:] == [("d", "cloud"), ("f", "cut-out"), ("own", "cut-out")]
    assert {form for row in range(6) for name, form in asked(image, row)[2:-1]} == set(module._FORMS)
    for row, form in enumerate(module._FORMS):
        assert asked(image, row, is_known=True) == [("own", form), ("aba"[row], form)]


def test_scans_come_as_users_may_have_them() -> None:
    image, absent = world(), world(copies=0)
    assert as_given(image, "image", 0) is image.scan
    whole, *cut = (as_given(image, *form) for form in (("cloud", 0), ("cut-out", 0), ("cut-out", 1), ("cut-out", 1)))
    np.testing.assert_array_equal(whole.points, image.scan.points)
    sizes = [len(scan.points) for scan in cut]
    assert 0 < sizes[0] != sizes[1] == sizes[2] < len(whole.points)  # each image has a margin of its own
    assert len(as_given(absent, "cut-out", 0).points) == len(absent.scan.points)  # without a copy nothing is cut


def test_each_search_has_a_name_of_its_own_and_makes_what_it_takes_when_that_is_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[str] = []

    def scene(name: str) -> Any:
        def given(form: str) -> str:
            if (name, form) == ("second", "cut-out"):
                raise InputError("a plane alone")
            return f"{name} as {form}"

        return given

    def on_device(network: Any, part: Any) -> str:
        made.append(part.name)
        return f"{part.name} on device"

    images = [
        module._Image(name, row, 7, world("ab"), scene(name), False)
        for row, name in enumerate(("first", "second", "first"))
    ]
    images[2] = images[2]._replace(image=replace(images[2].image, key=FrameKey(3, 2)))
    monkeypatch.setattr(module, "_images", lambda sources, network: images)
    monkeypatch.setattr(module, "device_part", on_device)
    network: Any = None
    found = list(searches(Sources(), network))
    assert [search.row for search in found] == list(range(9))
    assert [search.name for search in found[:7]] == [
        "first-000003-000001-own-image",
        "first-000003-000001-a-image",
        "first-000003-000001-own-cloud",
        "second-000003-000001-own-image",
        "second-000003-000001-b-image",
        "second-000003-000001-own-cut-out",
        "first-000003-000002-own-image",
    ]
    assert not made
    assert [str(search.scene) for search in (*found[:5], found[6])] == [
        *("first as image", "first as image", "first as cloud", "second as image", "second as image"),
        "first as image",
    ]
    assert [search.is_empty for search in found] == [row == 5 for row in range(9)]
    assert [str(search.on_device) for search in found[:4]] == [
        f"{name} on device" for name in ("own", "a", "own", "own")
    ]
    assert made == ["own", "a", "own"]  # once of each folder


def test_known_worlds_come_last_and_share_the_numbers_of_their_families(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """So that what is found elsewhere has the same rows whether they are named or not."""
    (tmp_path / "bins" / "a" / module.SPLIT).mkdir(parents=True)
    image = SimpleNamespace(key=FrameKey(5, 0), scene=None)
    monkeypatch.setattr(module, "bin_images", lambda *given: [image])
    images = {
        "validation": ["mug", "nut"],
        "various": ["nut", "hook"],
        "b": ["cup", "clip"],
        "a": ["clip_with_cup", "cup_with_clip", "bail"],
    }
    monkeypatch.setattr(
        module, "world_images", lambda folder, network: [world(kind=kind) for kind in images[folder.name]]
    )
    folders = [tmp_path / "worlds" / name for name in images]
    sources = Sources(bins=tmp_path / "bins", worlds=tuple(folders[:2]), known_worlds=tuple(folders[2:]))
    nothing = cast(Any, None)
    numbers = {"b": (3, 4), "a": (4, 3, 5)}  # compounds count as their larger piece
    found = [(one.folder, one.row, one.number, one.is_known) for one in module._images(sources, nothing)]
    assert found == [
        ("bins-a", 0, 1005, False),
        *(("worlds-validation", row, row, False) for row in range(2)),
        *(("worlds-various", row, row + 1, False) for row in range(2)),
        *((f"worlds-{name}", row, number, True) for name in "ba" for row, number in enumerate(numbers[name])),
    ]
    twice = replace(sources, known_worlds=(folders[0],))
    with pytest.raises(InputError, match="are worlds-validation, worlds-various, worlds-validation: rename one"):
        next(module._images(twice, nothing))


def test_a_stranger_that_looks_like_the_part_is_neither_right_nor_wrong() -> None:
    alike = np.array([False, True])

    def looks_like(part: str, poses: np.ndarray) -> np.ndarray:
        assert part == "stranger"
        np.testing.assert_array_equal(poses[:, :3, 3], [[5, 1, 0]] * 2)  # in the scene's frame
        return alike

    image: Any = SimpleNamespace(part="own", looks_like=looks_like)
    T_scene_camera = np.array([[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=np.float32)
    scene: Any = SimpleNamespace(T_scene_camera=T_scene_camera)
    poses = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    poses[:, 0, 3] = 1.0
    nothing: Any = None
    search = Search(image, "stranger", nothing, lambda: scene, 0, 7, False, "name")  # type: ignore[arg-type]
    np.testing.assert_array_equal(search.errors(poses, nothing), [np.inf, np.nan])
    own = replace(search, part=image.part)
    np.testing.assert_array_equal(own.errors(poses, lambda given: given[:, :2, 3]), [1, 1])
    np.testing.assert_array_equal(own.errors(poses, lambda given: given[:, :1, 3]), [5, 5])
