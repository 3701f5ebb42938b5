"""Poses of different parts: in one place the more probable one stays, side by side both do. And results as text."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kmn_jax.detection import Detections, Timing, as_json, table
from kmn_jax.detection._exclusion import apart
from tests.detection.box_sample import POSES, SIZES, both_boxes, box_part, box_view, detection
from tests.reference.meshes import pose

PART = box_part()
VIEW = box_view()


def found(*copies: tuple[np.ndarray, float]) -> Detections:
    poses = tuple(detection(PART, VIEW, T, probability) for T, probability in copies)
    return Detections("box", "m", poses, Timing({"search": 0.5}, 0.0))


def moved(T: np.ndarray, x: float, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    return pose((x, y, z)) @ T


def probabilities(results: tuple[Detections, ...]) -> list[list[float]]:
    return [[copy.probability for copy in one.poses] for one in results]


def test_in_one_place_the_more_probable_pose_stays() -> None:
    first, second = found((POSES[0], 0.9), (POSES[1], 0.4)), found((moved(POSES[0], 0.05), 0.6), (POSES[1], 0.8))
    results = apart([first, second], [PART, PART])
    assert probabilities(results) == [[0.9], [0.8]]
    for one in results:
        assert one.warnings == ("1 of 2 poses were left out, as more probable ones of other parts are there",)
        assert one.reason is None
    (kept, gone) = apart([first, found((POSES[0], 0.9), (POSES[1], 0.1))], [PART, PART])
    assert kept == first
    assert gone.poses == ()
    assert gone.reason == "2 of 2 poses were left out, as more probable ones of other parts are there"


def test_a_pose_that_is_left_out_excludes_nothing() -> None:
    # A row of three, each of which overlaps the next one: the middle one goes, so both others stay.
    row = [moved(POSES[0], 0.6 * SIZES[0] * number) for number in range(3)]
    results = apart([found((row[0], 0.9)), found((row[1], 0.8)), found((row[2], 0.7))], [PART] * 3)
    assert probabilities(results) == [[0.9], [], [0.7]]


@pytest.mark.parametrize("offset", [(SIZES[0], 0, 0), (0, SIZES[1], 0), (0, 0, SIZES[2]), (3.0, 0, 0)])
def test_parts_that_touch_or_are_far_away_both_stay(offset: tuple[float, float, float]) -> None:
    first, second = found((POSES[0], 0.9)), found((moved(POSES[0], *offset), 0.8))
    assert apart([first, second], [PART, PART]) == (first, second)


def test_a_small_part_inside_of_a_large_one_goes_however_far_the_frame() -> None:
    small = replace(
        PART,
        points=0.3 * PART.points,
        diameter=0.3 * PART.diameter,
        minimum=0.3 * PART.minimum,
        maximum=0.3 * PART.maximum,
        area=0.09 * PART.area,
    )
    for away in (0.0, 5e5):
        T = moved(POSES[0], away, away, away)
        results = apart([found((T, 0.9)), found((T, 0.5), (moved(T, 0, 0, -0.5), 0.4))], [PART, small])
        assert probabilities(results) == [[0.9], [0.4]]


def test_results_as_values_and_as_text_of_one_screen() -> None:
    few = both_boxes(PART, VIEW)
    assert few.best is few.poses[0]
    assert found().best is None
    values = few.to_dict()
    first = values["poses"][0]
    assert first["num_inliers"] == first["inliers"] == few.poses[0].num_inliers
    assert first["T_base_object"] is first["grasps"] is None
    assert {**values, "object": "a.stl", "scene": "b.ply", "seed": 3} == as_json(few, "a.stl", "b.ply", {"seed": 3})
    assert repr(few).splitlines()[1] == "   1. Detection(probability 0.93, visible 0.81, at -0.75, 0, 3)"
    many = replace(few, poses=few.poses * 100, warnings=("the scan is coarse",))
    lines = repr(many).splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 120
    assert "200 poses" in lines[0]
    assert lines[-3:-1] == ["      and 188 more", "      note: the scan is coarse"]
    assert lines[-1] == "      note: poses 2, 4, 6, 8, 10, 12, 14, 16 and 92 more: few of its matches <agree>"
    assert "nothing found, because it is dark" in repr(replace(found(), reason="it is dark"))


def test_what_poses_are_warned_of_is_told_after_their_ranks() -> None:
    few = both_boxes(PART, VIEW)
    warned = [("is symmetric", "is rivalled"), ("is symmetric",), (), ("is symmetric", "is rivalled"), ("is coarse",)]
    poses = tuple(replace(few.poses[0], warnings=(*texts, "is dark")) for texts in warned)
    result = replace(few, poses=poses, warnings=("is dark",))
    notes = ["poses 1, 2, 4: is symmetric", "poses 1, 4: is rivalled", "pose 5: is coarse"]
    assert repr(result).splitlines()[6:] == [f"      note: {note}" for note in ["is dark", *notes]]
    said = table(result, 0.5).splitlines()
    assert [line for line in said if line.startswith("note: ")] == [f"note: {note}" for note in ["is dark", *notes]]
    assert "poses 1 to 3: is symmetric" in repr(replace(result, poses=(poses[0], poses[1], poses[0])))


def test_the_table_is_in_the_robot_s_frame_if_that_is_known() -> None:
    few = both_boxes(PART, VIEW)
    there = replace(few.poses[0], T_base_object=pose((7, 8, 9)))
    assert "robot's frame" not in table(few, 0.5)
    shown = table(replace(few, poses=(there,)), 0.5)
    assert "(lengths in m, in the robot's frame)" in shown
    assert shown.splitlines()[2].split()[5:8] == ["7", "8", "9"]
