"""The page in a browser without a display: what it says and draws, its switches, and a search at a clicked point."""

from __future__ import annotations

import io
import re
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

from kmn_jax.detection import Detections, Scene
from kmn_jax.detection._result import Timing
from kmn_jax.errors import InputError
from kmn_jax.viz import Viewer, distinct_colors
from kmn_jax.viz._viewer_scene import nearest_to_ray
from tests.detection.box_sample import FRONT, POSES, SIZES, both_boxes, box_part, box_view, detection
from tests.reference.meshes import pose, random_rotations

T_SCENE_CAMERA = pose((5.0, -2.0, 1.0), random_rotations(1, 3)[0])
PART = box_part()


def moved(view: Scene, found: Detections) -> tuple[Scene, Detections]:
    """Return the sample in a scene whose frame is not the sensor's."""

    def into_scene(points: np.ndarray) -> np.ndarray:
        return points @ T_SCENE_CAMERA[:3, :3].T + T_SCENE_CAMERA[:3, 3]

    poses = [
        replace(
            one,
            T_scene_object=T_SCENE_CAMERA @ one.T_scene_object,
            seed=into_scene(one.seed),
            prediction=replace(one.prediction, points=into_scene(one.prediction.points).astype(np.float32)),
        )
        for one in found.poses
    ]
    return replace(view, T_scene_camera=T_SCENE_CAMERA), replace(found, poses=tuple(poses))


@dataclass
class Picker:
    """Answers searches with the right box alone, or with an error, once it may."""

    answer: Detections | Exception
    places: list[np.ndarray] = field(default_factory=list)
    may_answer: threading.Event = field(default_factory=threading.Event)

    def __call__(self, place: np.ndarray) -> Detections:
        self.places.append(place)
        assert self.may_answer.wait(30)
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


@pytest.fixture(scope="module")
def sample() -> tuple[Scene, Detections]:
    view = box_view()
    return moved(view, both_boxes(PART, view))


@pytest.fixture(scope="module")
def picked() -> Detections:
    view = box_view()
    found = Detections("box", "m", (detection(PART, view, POSES[1], 0.67),), Timing({"search": 0.1}, 0.0))
    return moved(view, found)[1]


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    chromium = shutil.which("chromium")
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("chromium or its driver is not installed: apt-get install chromium chromium-driver")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    flags = ["headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-background-networking"]
    flags += ["disable-component-update", "disable-sync", "disable-dev-shm-usage", "window-size=1000,640"]
    flags += ["use-angle=swiftshader", "enable-unsafe-swiftshader"]
    # The page must not need any other machine.
    flags += ["host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"]
    flags += [f"user-data-dir={tmp_path_factory.mktemp('chromium')}"]
    for flag in flags:
        options.add_argument(f"--{flag}")
    # A spare connection, opened ahead of need, would hold the server up for seconds when it stops.
    options.add_experimental_option("prefs", {"net.network_prediction_options": 2})
    driven = webdriver.Chrome(options, Service(driver))
    try:
        yield driven
    finally:
        driven.quit()


def eventually(condition: Callable[[], object], seconds: float = 40.0) -> None:
    """Wait until a condition holds; fail if it does not."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it has not come true"
        time.sleep(0.05)


def look_at(browser: Any, page: Viewer) -> None:
    """Open the page and wait for what is in it."""
    browser.get(f"{page.url}")
    eventually(lambda: "2 poses, 1 of them likely" in text(browser))


def text(browser: Any) -> str:
    return str(browser.find_element("tag name", "body").text)


def click(browser: Any, label: str) -> None:
    """Click on what is labelled so: the checkbox beside the label, or a button."""
    checkbox = f"//label[normalize-space()='{label}']/ancestor::*[.//input[@type='checkbox']][1]//input"
    found = browser.find_elements("xpath", checkbox) or browser.find_elements(
        "xpath", f"//button[normalize-space()='{label}']"
    )
    browser.execute_script("arguments[0].click()", found[0])


def click_on_canvas(browser: Any, right: int, down: int) -> None:
    """Click on the scene, so many pixels from its centre."""
    from selenium.webdriver import ActionChains

    canvas = browser.find_element("tag name", "canvas")
    ActionChains(browser).move_to_element_with_offset(canvas, right, down).click().perform()


def count_like(browser: Any, color: np.ndarray) -> int:
    """Return how many pixels of the page's scene have a colour, whatever their brightness."""
    image = np.asarray(Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")).astype(float)
    canvas = image[:, : browser.find_element("tag name", "canvas").size["width"]]
    vivid = np.ptp(canvas, axis=2) > 60
    cosine = canvas @ color / np.maximum(np.linalg.norm(canvas, axis=2) * np.linalg.norm(color), 1e-9)
    return int((vivid & (cosine > 0.985)).sum())


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
        click(browser, "likely")
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
        assert "probability 0.93" not in text(browser)
        assert page.found is picked
        click(browser, "Show the first result again")
        eventually(lambda: "probability 0.93" in text(browser))
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
