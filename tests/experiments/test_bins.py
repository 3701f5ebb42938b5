"""What is known of images: which parts hardly differ from those that are there."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from experiments.bins import TrueImage
from tests.reference.clouds import box_cloud


def box(size: tuple[float, float, float], random_seed: int) -> Any:
    points = box_cloud(random_seed, 4096, size)[:, :3]
    return SimpleNamespace(points=points, diameter=float(np.linalg.norm(size)))


def at(*shift: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = shift
    return pose


def test_a_part_looks_like_another_where_most_of_each_surface_lies_on_the_other() -> None:
    key: Any = (1, 0)
    truth = np.stack([at(50.0, 0, 300.0), at(0, 0, 300.0)])
    image = TrueImage(key, box((40.0, 24.0, 16.0), 0), (), truth, np.ones(2))
    longer, poses = box((43.0, 24.0, 16.0), 1), np.stack([at(1.5, 0, 300.0), at(51.5, 0, 300.0), at(5.0, 4.0, 304.0)])
    np.testing.assert_array_equal(image.looks_like(longer, poses), [True, True, False])
    turned = poses[0] @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert image.looks_like(longer, turned[None]).all()
    # All of a plate lies on a side of the box, but hardly any of the box on the plate; and half a box is none.
    plate, half = box((40.0, 24.0, 0.5), 2), box((20.0, 24.0, 16.0), 3)
    assert not image.looks_like(plate, at(0, 0, 292.0)[None]).any()
    assert not image.looks_like(half, at(10.0, 0, 300.0)[None]).any()
    assert not image.looks_like(longer, at(0, 0, 600.0)[None]).any()
    assert image.looks_like(longer, np.zeros((0, 4, 4))).shape == (0,)
