"""A browser without a display, and the sample that pages show."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from typing import Any

import pytest

from kmn_jax.detection import Detections, Scene, Timing
from tests.detection.box_sample import POSES, both_boxes, box_view, detection
from tests.reference.meshes import pose
from tests.viz.page_sample import PART, moved

BESIDE = POSES[1] @ pose((0.15, 0.0, 0.0))  # the right box, not quite in its place


@pytest.fixture(scope="session")
def sample() -> tuple[Scene, Detections]:
    view = box_view()
    return moved(view, both_boxes(PART, view))


@pytest.fixture(scope="session")
def picked() -> Detections:
    view = box_view()
    found = Detections("box", "m", (detection(PART, view, BESIDE, 0.67),), Timing({"search": 0.1}, 0.0))
    return moved(view, found)[1]


@pytest.fixture
def browser(chromium: Any) -> Iterator[Any]:
    yield chromium
    chromium.get("about:blank")  # else the last page is drawn on and on, which takes a core from all other tests


@pytest.fixture(scope="session")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    program, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("chromium or its driver is not installed: apt-get install chromium chromium-driver")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = program
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
