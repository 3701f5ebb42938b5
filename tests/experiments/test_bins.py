"""What is known of images: which parts hardly differ from those that are there; objects as cards, not meshes."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments.bins import TrueImage, bin_images
from kmn_jax.detection import symmetry_transforms
from kmn_jax.errors import InputError
from kmn_jax.models import load_pretrained
from kmn_jax.objects import save_part
from kmn_jax.pose import adi, mssd
from tests.experiments.test_whole_bin import SMALL
from tests.reference.clouds import box_cloud
from tests.reference.meshes import random_rotations


def box(size: tuple[float, float, float], random_seed: int, middle: tuple[float, float, float]) -> Any:
    points = box_cloud(random_seed, 4096, size)[:, :3] + np.asarray(middle)
    return SimpleNamespace(points=points, diameter=float(np.linalg.norm(size)))


def at(*shift: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = shift
    return pose


def test_a_part_looks_like_another_where_most_of_each_surface_lies_on_the_other() -> None:
    """All is in two copies' frames, whose origins, as those of the strangers, are in no middle of anything."""
    key: Any = (1, 0)
    turned, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    one, two = at(60.0, -5, 300.0), at(-10, 0, 290.0)
    one[:3, :3], two[:3, :3] = turned * np.sign(np.linalg.det(turned)), [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    middle = (7.0, -3.0, 11.0)
    image = TrueImage(key, box((40.0, 24.0, 16.0), 0, middle), (), np.stack([one, two]), np.ones(2))

    def alike(size: tuple[float, float, float], random_seed: int, *shifts: tuple[float, float, float]) -> list[bool]:
        """Say for a box at either copy, the middle shifted from there."""
        own = (-4.0, 9.0, 2.0)
        inwards = [at(*np.asarray(middle) + shift - own) for shift in shifts]
        poses = np.array([true @ move for move in inwards for true in (one, two)]).reshape(-1, 4, 4)
        found: list[bool] = image.looks_like(box(size, random_seed, own), poses).tolist()
        return found

    assert alike((43.0, 24.0, 16.0), 1, (1.5, 0, 0), (5.0, 4.0, 4.0)) == [True, True, False, False]
    # All of a plate lies on a side of the box, but hardly any of the box on the plate; half a box is none, nor one of
    # twice the length and more.
    assert alike((40.0, 24.0, 0.5), 2, (0, 0, -8.0)) == [False, False]
    assert alike((20.0, 24.0, 16.0), 3, (10.0, 0, 0)) == [False, False]
    assert alike((100.0, 24.0, 16.0), 4, (30.0, 0, 0)) == [False, False]
    assert alike((40.0, 24.0, 16.0), 5, (0, 0, 300.0)) == [False, False]
    assert alike((40.0, 24.0, 16.0), 6) == []


def test_errors_are_those_of_all_pairs_or_bounds_above_every_threshold() -> None:
    """Poses lie about a diameter from a copy, some of them farther, half of them turned anyhow."""
    image = next(bin_images(SMALL, "test", load_pretrained()))
    rng, diameter = np.random.default_rng(0), image.part.diameter
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, :3] = random_rotations(40, 0)
    poses[::2, :3, :3] = image.truth[0, :3, :3]
    poses[:, :3, 3] = image.truth[0, :3, 3] + rng.normal(size=(40, 3)) * diameter * rng.uniform(0, 1, (40, 1))
    poses[:3] = image.truth[:3]
    points, turns = image.part.points[:1000], symmetry_transforms(image.part.symmetries)
    measures: list[tuple[Any, Any]] = [
        (image.errors, lambda one, other: adi(one, other, points)),
        (image.largest_errors, lambda one, other: mssd(one, other, points, turns)),
    ]
    for measure, wanted in measures:
        found = measure(poses)
        true = np.array([[wanted(one, other) for other in image.truth] for one in poses.astype(np.float32)]) / diameter
        may_be_bounds = found > 0.5
        np.testing.assert_allclose(found[~may_be_bounds], true[~may_be_bounds], atol=1e-5)
        assert (true[may_be_bounds] >= found[may_be_bounds] - 1e-5).all()
        assert (found < true - 0.1).any()
        assert (found[3:] < 0.5).sum() > 5
        assert (found < 0.1).any(axis=1)[:3].all()
        assert measure(poses[:0]).shape == (0, len(image.truth))


def test_cards_stand_for_the_meshes_of_a_dataset(tmp_path: Path) -> None:
    model = load_pretrained()
    image = next(bin_images(SMALL, "test", model))
    save_part(image.part, tmp_path / f"{image.part.name}.kmn")
    with pytest.raises(InputError, match=r"obj_000002\.kmn"):
        next(bin_images(SMALL, "test", model, cards=tmp_path))
    for stranger in image.strangers:
        save_part(stranger.in_unit("m"), tmp_path / f"{stranger.name}.kmn")
    other = next(bin_images(SMALL, "test", model, cards=tmp_path))
    assert (image.key, image.part.name) == (other.key, other.part.name)
    np.testing.assert_array_equal(image.part.points, other.part.points)
    np.testing.assert_array_equal(image.truth, other.truth)
    (stranger,), (of_card,) = image.strangers, other.strangers
    assert (of_card.name, of_card.unit) == (stranger.name, stranger.unit) == ("obj_000002", "mm")
    np.testing.assert_allclose(of_card.points, stranger.points, rtol=1e-5)


@pytest.mark.parametrize("with_cards", [False, True])
def test_a_dataset_without_models_says_so(tmp_path: Path, with_cards: bool) -> None:
    shutil.copytree(SMALL, tmp_path / "set", ignore=shutil.ignore_patterns("models"))
    with pytest.raises(InputError, match="no model"):
        next(bin_images(tmp_path / "set", "test", load_pretrained(), cards=tmp_path if with_cards else None))
