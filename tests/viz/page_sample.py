"""Pages of the sample of two boxes, and what a person does with a page in a browser."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from PIL import Image

from kmn_jax.detection import Detections, Scene
from kmn_jax.viz import Viewer
from tests.detection.box_sample import box_part
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


def eventually(condition: Callable[[], object], seconds: float = 40.0) -> None:
    """Wait until a condition holds; fail if it does not."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it has not come true"
        time.sleep(0.05)


def look_at(browser: Any, page: Viewer) -> None:
    """Open the page and wait for what is in it."""
    browser.get(f"{page.url}")
    eventually(lambda: "1 found, 1 doubtful" in text(browser))


def text(browser: Any) -> str:
    found = browser.find_elements("tag name", "body")  # none while it loads
    return str(found[0].text) if found else ""


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
