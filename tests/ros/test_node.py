"""The node without ROS: what it publishes of scans and calls, and what it says of those that cannot be used."""

from __future__ import annotations

import ast
import importlib
import json
import re
import sys
import threading
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kmn_jax import __version__
from kmn_jax.detection import Detections, PoseEstimator
from kmn_jax.errors import InputError
from kmn_jax.objects import Part
from kmn_ros.search import Settings
from tests.detection.box_sample import POSES, both_boxes, box_part, box_view
from tests.reference.meshes import pose, random_rotations
from tests.ros.messages import cloud, image, info
from tests.ros.stand_in import install

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "ros2" / "kmn_ros"
PART = box_part()
FOUND = both_boxes(PART, box_view())
T_BASE_CAMERA = pose((0.4, -0.2, 0.9), random_rotations(1, 5)[0])
K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
DEPTH = image(np.full((48, 64), 700, np.uint16), "16UC1")
INFO = info(K, 48, 64)


@dataclass(frozen=True)
class KnownAnswer(PoseEstimator):
    """Finds both boxes, or what it is told to."""

    model: Any = None
    digest: str = "0"
    probabilities: Any = None
    answers: list[Any] = field(default_factory=list)
    asked: list[dict[str, Any]] = field(default_factory=list)

    def prepare(self, source: Any, unit: Any = None, name: Any = None) -> Part:
        return replace(PART, unit=unit or "m")

    def detect(self, part: Part, scan: Any, **given: Any) -> Detections:  # type: ignore[override]
        self.asked.append({"scan": scan, **given})
        answer = self.answers.pop(0) if self.answers else FOUND
        if isinstance(answer, Exception):
            raise answer
        T = given["T_base_camera"]
        poses = [one if T is None else replace(one, T_base_object=T @ one.T_scene_object) for one in answer.poses]
        return replace(answer, poses=tuple(poses))


def started(monkeypatch: pytest.MonkeyPatch, estimator: KnownAnswer, **parameters: Any) -> Any:
    install(monkeypatch, **{"part": "box.stl"} | parameters)
    monkeypatch.delitem(sys.modules, "kmn_ros.node", raising=False)
    node = importlib.import_module("kmn_ros.node").PosesNode(estimator)
    monkeypatch.delitem(sys.modules, "kmn_ros.node")
    return node


def called(node: Any, name: str, *scan: Any) -> Any:
    """Return the answer of a service that waits for a scan, which comes a moment later."""
    before = threading.Timer(0.05, lambda: node.ends["depth"](*scan))
    if scan:
        before.start()
    answer = node.ends[name](None, SimpleNamespace(success=None, message=None))
    if scan:
        before.join()
    return answer


def test_every_scan_is_searched_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    estimator = KnownAnswer()
    node = started(monkeypatch, estimator, roi="-1,-1,0,1,1,2", plane="never", part_unit="mm")
    assert set(node.ends) == {"camera_info", "depth", "~/take_background"}
    node.ends["depth"](DEPTH)
    assert node.log[-1] == ("warning", "no camera info has come yet")
    node.ends["camera_info"](INFO)
    node.ends["depth"](DEPTH)
    (asked,) = estimator.asked
    assert asked["scan"].unit == "m"
    np.testing.assert_allclose(asked["scan"].depth, 0.7)
    assert asked["background"].roi == (-1, -1, 0, 1, 1, 2)
    assert asked["background"].remove_plane == "never"
    (array,), (rows,) = node.published, node.sent
    assert (array.header.frame_id, array.header.stamp) == ("camera_optical", DEPTH.header.stamp)
    assert [row.results[0].hypothesis.score for row in array.detections] == [0.93]  # the other one is not likely
    assert [row.child_frame_id for row in rows] == ["box_1"]


def test_poses_are_in_the_robots_frame_if_it_knows_the_camera(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    millimetres = T_BASE_CAMERA.copy()
    millimetres[:3, 3] *= 1000
    (tmp_path / "base.json").write_text(json.dumps({"T_base_camera": millimetres.tolist(), "unit": "mm"}))
    names = {"base_frame": "base", "base_camera": str(tmp_path / "base.json"), "object_frame": "motor"}
    node = started(monkeypatch, KnownAnswer(), input="cloud", min_probability=0.0, **names)
    node.ends["points"](cloud(np.ones((2, 3, 3))))
    (array,), (rows,) = node.published, node.sent
    assert array.header.frame_id == "base"
    assert [row.child_frame_id for row in rows] == ["motor_1", "motor_2"]
    where = rows[1].transform.translation
    np.testing.assert_allclose([where.x, where.y, where.z], (T_BASE_CAMERA @ POSES[1])[:3, 3], atol=1e-9)


def test_a_call_searches_the_scan_that_comes_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    estimator = KnownAnswer()
    node = started(monkeypatch, estimator, on_demand=True, wait=5.0, frame="lens")
    node.ends["camera_info"](INFO)
    node.ends["depth"](DEPTH)  # this one came before
    assert (estimator.asked, node.published) == ([], [])
    answer = called(node, "~/take_background", image(np.full((48, 64), 800, np.uint16), "16UC1"))
    assert (answer.success, answer.message) == (True, "this scan is the empty bin from now on")
    answer = called(node, "~/detect", image(np.full((48, 64), 600, np.uint16), "16UC1"))
    assert answer.success
    assert answer.message.startswith("2 poses, 1 of them published, in 1.5")
    (asked,) = estimator.asked
    np.testing.assert_allclose(asked["scan"].depth, 0.6)
    np.testing.assert_allclose(asked["background"].background.depth, 0.8)
    assert node.published[0].header.frame_id == "lens"


def test_what_cannot_be_used_is_said_and_the_node_lives_on(monkeypatch: pytest.MonkeyPatch) -> None:
    empty = replace(FOUND, poses=(), reason="nothing looks like it", warnings=("give the background",))
    estimator = KnownAnswer(answers=[InputError("the lengths do not fit"), empty])
    node = started(monkeypatch, estimator, on_demand=True, wait=0.3)
    answer = called(node, "~/detect")
    assert not answer.success
    assert answer.message == "no usable scan came within 0.3 s: see that the camera publishes"
    node.ends["camera_info"](INFO)
    node.ends["depth"](image(np.zeros((48, 64), np.uint8), "rgb8"))
    assert node.log[-1][0] == "error"
    assert "encoding is 'rgb8'" in node.log[-1][1]
    answer = called(node, "~/detect", DEPTH)
    assert (answer.success, answer.message) == (False, "the lengths do not fit")
    answer = called(node, "~/detect", DEPTH)
    assert answer.success
    assert "0 poses, 0 of them published" in answer.message
    assert "nothing looks like it" in answer.message
    assert ("warning", "give the background") in node.log
    assert node.published[0].detections == []  # listeners are told that there is none
    assert node.sent == []


def test_a_node_without_a_part_does_not_start(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="no part is given"):
        started(monkeypatch, KnownAnswer(), part="")


def test_the_package_is_whole() -> None:
    manifest = ElementTree.parse(PACKAGE / "package.xml").getroot()
    setup = (PACKAGE / "setup.py").read_text(encoding="utf-8")
    assert manifest.findtext("version") == __version__
    assert f'version="{__version__}"' in setup
    assert manifest.findtext("export/build_type") == "ament_python"
    needed = {one.text for one in manifest.iter("exec_depend")} | {"kmn_ros", "kmn_jax", "numpy", "scipy", "setuptools"}
    needed |= set(sys.stdlib_module_names)
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            modules += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert {module.split(".")[0] for module in modules} <= needed, f"{path.name} imports {modules}"
    for name in re.findall(r'"((?:launch|resource)/[^"{]+|package\.xml)"', setup):
        assert (PACKAGE / name).is_file()
    assert (PACKAGE / "resource" / "kmn_ros").is_file()
    launch = ast.parse((PACKAGE / "launch" / "poses.launch.py").read_text(encoding="utf-8"))
    (parameters,) = (
        ast.literal_eval(node.value)
        for node in launch.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "PARAMETERS"
    )
    assert parameters.keys() <= Settings.names().keys()


def test_the_guide_names_every_parameter() -> None:
    guide = (ROOT / "docs" / "ros.md").read_text(encoding="utf-8")
    for name, default in Settings.names().items():
        assert re.search(rf"^\| `{name}` \| {re.escape(json.dumps(default))} \|", guide, re.M), name
