"""Files of grasps: what they say, in any unit, and one sentence for what they cannot say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.objects import load_grasps

FILE: dict[str, Any] = {
    "unit": "cm",
    "gripper": {
        "boxes": [{"center": [0, 1, -9], "size": [12, 6, 4]}],
        "fingers": {"size": [1, 2, 6], "reach": 0.5},
        "approach": 3,
    },
    "grasps": [
        {"name": "top", "T_object_grasp": np.eye(4).tolist(), "width": 4},
        {"xyz": [1, 2, 3], "xyzw": [1, 0, 0, 0]},
    ],
}


def written(folder: Path, content: Any) -> Path:
    path = folder / "part.grasps.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_grasps_and_gripper_in_any_unit(tmp_path: Path) -> None:
    found = load_grasps(written(tmp_path, FILE))
    assert [(one.name, one.width) for one in found.grasps] == [("top", 4.0), ("2", 0.0)]
    np.testing.assert_array_equal(
        found.grasps[1].T_object_grasp, [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]]
    )
    in_mm = found.in_unit("mm")
    assert in_mm.grasps[0].width == pytest.approx(40)
    np.testing.assert_allclose(in_mm.grasps[1].T_object_grasp[:3, 3], [10, 20, 30])
    for grasps, factor in ((found, 1.0), (in_mm, 10.0)):
        centers, sizes = grasps.gripper.boxes(4.0 * factor)
        # The palm, and fingers on both sides of the opening, all drawn backwards by the approach.
        np.testing.assert_allclose(centers, factor * np.array([[0, 1, -10.5], [-2.5, 0, -4], [2.5, 0, -4]]))
        np.testing.assert_allclose(sizes, factor * np.array([[12, 6, 7], [1, 2, 9], [1, 2, 9]]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ("{", "cannot be used as grasps"),
        ("[]", "the file must be an object with grasps, gripper, unit"),
        ({"unit": None}, "unit 'None' is not known"),
        ({"gripper": {"boxes": []}}, "its gripper has neither boxes nor fingers"),
        ({"gripper": {"box": []}}, "gripper has 'box', which is not known: it may have approach, boxes, fingers"),
        ({"gripper": {"fingers": {"size": [1, 0, 1]}}}, "the size of the fingers must be 3 numbers above zero"),
        (
            {"gripper": {"boxes": [{"center": [0, 0], "size": [1, 1, 1]}]}},
            "the center of a box must be 3 finite numbers",
        ),
        ({"gripper": {"fingers": {"size": [1, 1, 1]}, "approach": -1}}, "approach must be a number of zero or more"),
        ({"grasps": []}, "it holds no grasps"),
        ({"grasps": [{"width": 3}]}, r"grasp 1: it has no T_object_grasp \(4 x 4 numbers\), and no xyz with xyzw"),
        ({"grasps": [{"T_object_grasp": np.zeros((4, 4)).tolist()}]}, "grasp 1: T_object_grasp is not a rigid pose"),
        ({"grasps": [{**FILE["grasps"][0], "width": "4"}]}, "width of grasp 1 must be a number of zero or more"),
        ({"grasps": [{**FILE["grasps"][0], "width": 10**400}]}, "width of grasp 1 must be a number of zero or more"),
        ({"gripper": {"boxes": [{"center": [10**400, 0, 0], "size": [1, 1, 1]}]}}, "the center of a box must be 3"),
    ],
)
def test_what_is_no_file_of_grasps_is_one_sentence(changes: Any, message: str, tmp_path: Path) -> None:
    path = written(tmp_path, changes if isinstance(changes, str) else {**FILE, **changes})
    with pytest.raises(InputError, match=message) as caught:
        load_grasps(path)
    assert "part.grasps.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_without_a_unit_asks_for_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='it has no unit: say which its lengths are in, such as "unit": "mm"'):
        load_grasps(written(tmp_path, {key: FILE[key] for key in ("gripper", "grasps")}))
