"""The page in a browser without a display: what it says and draws, its switches, and a search at a clicked point."""

from __future__ import annotations

import re
import socket
import threading
from dataclasses import replace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from kmn_jax.detection import Detections, Scene
from kmn_jax.errors import InputError
from kmn_jax.viz import Viewer, distinct_colors
from kmn_jax.viz._viewer_scene import nearest_to_ray
from tests.detection.box_sample import FRONT, POSES, SIZES
from tests.viz.page_sample import (
    PART,
    T_SCENE_CAMERA,
    Picker,
    click,
    click_on_canvas,
    count_like,
    eventually,
    look_at,
    text,
)


def test_the_page_shows_the_poses_and_switches_them(browser: Any, sample: tuple[Scene, Detections]) -> None:
    view, found = sample
    blue, _ = distinct_colors(2)
    with Viewer(view, PART, found, port=0) as page:
        look_at(browser, page)
        for words in (
            "box",
            "Pose 1",
            "probability 0.93, 81% visible",
            "probability 0.31",
            "few of its matches <agree>",
        ):
            assert words in text(browser)
        assert "Pick a point" not in text(browser)  # there is nothing to search with
        eventually(lambda: count_like(browser, blue) > 2000)

        assert page.is_shown(1)
        click(browser, "Pose 1")
        eventually(lambda: not page.is_shown(1))
        assert page.is_shown(2)
        eventually(lambda: count_like(browser, blue) < 200)

        click(browser, "all")
        eventually(lambda: page.is_shown(1))
        click(browser, "found")
        eventually(lambda: page.is_shown(1) and not page.is_shown(2))

        assert not page.is_shown(1, "Keypoints")
        # Of clicks within a twentieth of a second the page sends the last alone: each is waited for.
        click(browser, "Keypoints")
        eventually(lambda: page.is_shown(1, "Keypoints"))
        click(browser, "Surfaces")
        eventually(lambda: not page.is_shown(1, "Surfaces"))
        assert page.is_shown(1, "Keypoints")
        front = np.bincount(found.poses[0].prediction.keypoint[found.poses[0].prediction.on_object])
        most = distinct_colors(PART.num_keypoints)[front.argmax()]
        eventually(lambda: count_like(browser, most) > 300)
        click(browser, "Segmentation")
        eventually(lambda: page.is_shown(1, "Segmentation"))


def test_a_click_on_the_scan_searches_there(browser: Any, sample: tuple[Scene, Detections], picked: Detections) -> None:
    view, found = sample
    search = Picker(picked)
    with Viewer(view, PART, found, port=0, on_pick=search) as page:
        look_at(browser, page)
        click_on_canvas(browser, 0, 0)  # before it is asked for, a click is nothing
        click(browser, "Pick a point to search at")
        eventually(lambda: "Click on a point of the scan." in text(browser))
        assert search.places == []
        right = browser.find_element("tag name", "canvas").size["width"] // 5
        click_on_canvas(browser, right, 0)
        eventually(lambda: search.places)
        eventually(lambda: "Searching around" in text(browser))
        (place,) = search.places
        in_view = (place - T_SCENE_CAMERA[:3, 3]) @ T_SCENE_CAMERA[:3, :3]
        assert np.linalg.norm(view.points - in_view, axis=1).min() < 1e-5
        on_right_box = np.abs(in_view - POSES[1][:3, 3]) < np.array(SIZES) / 2 + 0.01
        assert on_right_box.all(), in_view
        assert in_view[2] < FRONT + 0.01
        search.may_answer.set()
        eventually(lambda: "probability 0.67" in text(browser))
        assert "probability 0.93" in text(browser)  # it comes to the others
        assert page.found.poses == (*found.poses, *picked.poses)
        assert page.chosen is None  # the click was for the scan, not for the pose in front of it
        assert page.is_shown(3, "Surfaces")

        click(browser, "Pick a point to search at")
        eventually(lambda: "Click on a point of the scan." in text(browser))
        click_on_canvas(browser, right, 0)
        eventually(lambda: "That is pose 3." in text(browser))
        assert len(page.found.poses) == 3
        click(browser, "Remove picked poses")
        eventually(lambda: "probability 0.67" not in text(browser))
        assert page.found is found


def test_a_failed_search_is_a_message_and_the_page_lives_on(
    browser: Any, sample: tuple[Scene, Detections], picked: Detections, capsys: pytest.CaptureFixture
) -> None:
    view, found = sample
    search = Picker(InputError("this place holds 3 points: pick another one"))
    search.may_answer.set()
    with Viewer(view, PART, found, port=0, on_pick=search) as page:
        look_at(browser, page)
        size = browser.find_element("tag name", "canvas").size
        right = size["width"] // 5  # messages cover the left
        click(browser, "Pick a point to search at")
        eventually(lambda: "Click on a point of the scan." in text(browser))
        click_on_canvas(browser, 4 - size["width"] // 2, size["height"] // 2 - 4)
        eventually(lambda: "Nothing was measured where you clicked" in text(browser))
        assert search.places == []
        click_on_canvas(browser, right, 0)
        eventually(lambda: "this place holds 3 points: pick another one" in text(browser))
        eventually(lambda: "Searching" not in text(browser))
        assert "probability 0.93" in text(browser)

        search.answer = RuntimeError("broken")
        click(browser, "Pick a point to search at")
        eventually(lambda: "Click on a point of the scan." in text(browser))
        click_on_canvas(browser, right, 0)
        eventually(lambda: "RuntimeError: broken" in text(browser))
        eventually(lambda: "Searching" not in text(browser))

        search.answer = picked
        click(browser, "Pick a point to search at")
        eventually(lambda: "Click on a point of the scan." in text(browser))
        click(browser, "Cancel picking")
        eventually(lambda: "Click on a point of the scan." not in text(browser))
        click(browser, "Pick a point to search at")
        eventually(lambda: "Click on a point of the scan." in text(browser))
        click_on_canvas(browser, right, 0)
        eventually(lambda: "probability 0.67" in text(browser))
        assert len(search.places) == 3
    assert "RuntimeError: broken" in capsys.readouterr().err  # what we did wrong is in the server's log


def test_what_is_shown_may_change_and_be_nothing(sample: tuple[Scene, Detections], picked: Detections) -> None:
    view, found = sample
    with Viewer(view, PART, found, port=0) as page:
        page.show(picked)
        assert page.is_shown(1)
        with pytest.raises(IndexError):
            page.is_shown(2)
        page.show(replace(found, poses=(), reason="nothing looks like the part"))
        assert page.found.reason == "nothing looks like the part"
        page.show(found)
        assert page.is_shown(2, "Surfaces")


def test_a_port_in_use_is_refused_and_a_stopped_page_frees_it(sample: tuple[Scene, Detections]) -> None:
    view, found = sample
    threads = set(threading.enumerate())
    page = Viewer(view, PART, found, port=0)
    port = urlsplit(page.url).port
    assert re.fullmatch(rf"http://127\.0\.0\.1:{port}/\?token=[\w-]{{22}}", page.url)
    with pytest.raises(InputError, match=rf"port {port} of 127.0.0.1 cannot be used \(.*in use\): choose another one"):
        Viewer(view, PART, found, port=port)
    page.stop()
    page.wait()
    with socket.socket() as trial, pytest.raises(ConnectionRefusedError):
        trial.connect(("127.0.0.1", port))
    eventually(lambda: set(threading.enumerate()) <= threads)
    with Viewer(view, PART, found, port=port) as again:
        assert urlsplit(again.url).port == port
        assert again.url != page.url  # another token


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ({"port": 65536}, "port 65536 is not one"),
        ({"host": "no.such.host.invalid"}, "host 'no.such.host.invalid' is not known"),
        ({"host": "192.0.2.1"}, r"port 0 of 192.0.2.1 cannot be used"),
    ],
)
def test_places_that_are_not_ours_are_refused(
    sample: tuple[Scene, Detections], place: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Viewer(sample[0], PART, sample[1], **({"port": 0} | place))


def test_a_ray_meets_the_first_point_that_is_near_to_it() -> None:
    rng = np.random.default_rng(0)
    side = np.stack(np.meshgrid(np.linspace(-1, 1, 81), np.linspace(-1, 1, 81)), axis=-1).reshape(-1, 2)
    near, far = (np.column_stack([side, np.full(len(side), z)]) for z in (2.0, 3.0))
    points = np.concatenate([far, near[near[:, 0] < 0]])
    for x, y in rng.uniform(-0.6, 0.6, (40, 2)):
        row = nearest_to_ray(points, np.zeros(3), 7 * np.array([x / 2, y / 2, 1.0]))
        assert row is not None
        plane = 2.0 if x < -0.05 else 3.0
        if abs(x) > 0.05:
            assert points[row, 2] == plane
            assert np.linalg.norm(points[row, :2] - np.array([x, y]) * plane / 2) < 0.04
    assert nearest_to_ray(points, np.zeros(3), np.array([0.0, 0.0, -1.0])) is None
    assert nearest_to_ray(points, np.zeros(3), np.array([1.0, 0.0, 0.1])) is None
