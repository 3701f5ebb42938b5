"""What the panel of a page does in a browser: numbers of a pose, filter, views, region of interest, next scan."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import kmn_jax.cli
from kmn_jax.detection import Detections, OrientedBox, Pick, Scene, warnings_once
from kmn_jax.errors import InputError, number_list
from kmn_jax.viz import PartMesh, Viewer, distinct_colors, one_after_the_other, part_mesh
from kmn_jax.viz._viewer_poses import rank_of_same
from kmn_jax.viz._viewer_scene import _GRASP
from kmn_jax.viz._viewer_text import heading
from kmn_jax.web import listen
from tests.detection.box_sample import SIZES
from tests.reference.meshes import box, pose, random_rotations
from tests.viz.page_sample import PART, click, click_on_canvas, count_like, eventually, look_at, text

MESH = PartMesh(*box(*SIZES))


def copied(browser: Any, button: int) -> str:
    """Click on a button that copies, and return what is in the clipboard."""
    browser.execute_cdp_cmd(
        "Browser.grantPermissions", {"permissions": ["clipboardReadWrite", "clipboardSanitizedWrite"]}
    )
    found = browser.find_elements("xpath", "//button[normalize-space()='Copy' or normalize-space()='Copied']")[button]
    browser.execute_script("arguments[0].scrollIntoView()", found)
    found.click()
    eventually(lambda: found.text == "Copied")
    read = "const done = arguments[0]; navigator.clipboard.readText().then(done, error => done('' + error))"
    return str(browser.execute_async_script(read))


def test_a_click_on_a_pose_tells_its_numbers(browser: Any, sample: tuple[Scene, Detections]) -> None:
    view, found = sample
    blue, _ = distinct_colors(2)
    with Viewer(view, PART, found, port=0, mesh=MESH) as page:
        look_at(browser, page)
        eventually(lambda: count_like(browser, blue) > 2000)  # the mesh
        left = -browser.find_element("tag name", "canvas").size["width"] // 5
        click_on_canvas(browser, left, 0)
        eventually(lambda: page.chosen == 1)
        eventually(lambda: "rotation vector (degrees)" in text(browser))
        values = json.loads(copied(browser, 0))
        assert values["probability"] == 0.93
        assert (values["object"], values["unit"]) == ("box", "m")
        np.testing.assert_array_equal(values["T_scene_object"], found.poses[0].T_scene_object)


def test_the_slider_hides_what_is_less_probable(browser: Any, sample: tuple[Scene, Detections]) -> None:
    from selenium.webdriver import ActionChains, Keys

    view, found = sample
    with Viewer(view, PART, found, port=0, mesh=MESH) as page:
        look_at(browser, page)
        assert page.is_shown(2)
        thumb = browser.find_element("xpath", "//*[@role='slider']")
        browser.execute_script("arguments[0].focus()", thumb)
        keys = ActionChains(browser)
        for _ in range(40):
            keys = keys.send_keys(Keys.ARROW_RIGHT)
        keys.perform()
        eventually(lambda: not page.is_shown(2))
        assert page.is_shown(1)
        eventually(lambda: "probability 0.31" not in text(browser))
        assert "probability 0.93" in text(browser)
        page.show(replace(found, poses=found.poses[::-1]))
        assert (page.is_shown(1), page.is_shown(2)) == (False, True)  # the filter stays


def test_the_first_free_grasp_is_drawn(browser: Any, sample: tuple[Scene, Detections]) -> None:
    view, found = sample
    first, second = found.poses
    T_object_grasp = pose((0, 0, -SIZES[2]))  # in front of the box
    picks = tuple(Pick(name, SIZES[0], first.T_scene_object @ T_object_grasp) for name in ("one", "other"))
    held = replace(found, poses=(replace(first, grasps=picks), replace(second, grasps=())))
    with Viewer(view, PART, held, port=0, mesh=MESH) as page:
        look_at(browser, page)
        assert page.is_shown(1, "Grasps")
        eventually(lambda: count_like(browser, np.array(_GRASP)) > 100)
        shown = count_like(browser, np.array(_GRASP))
        click(browser, "Grasps")
        eventually(lambda: not page.is_shown(1, "Grasps"))
        eventually(lambda: count_like(browser, np.array(_GRASP)) < shown - 100)
        page._list.choose(1)
        eventually(lambda: "free grasps" in text(browser))
        page.show(found)
        eventually(lambda: "Grasps" not in text(browser).split())


def test_the_region_writes_its_flag(browser: Any, sample: tuple[Scene, Detections]) -> None:
    view, found = sample
    with Viewer(view, PART, found, port=0, mesh=MESH) as page:
        look_at(browser, page)
        browser.execute_script(
            "arguments[0].click()", browser.find_element("xpath", "//*[normalize-space()='Region of interest']")
        )
        eventually(lambda: browser.find_elements("xpath", "//label[normalize-space()='Box']"))
        click(browser, "Box")
        eventually(lambda: "points are inside" in text(browser))
        flag = copied(browser, -1)
        assert flag == page.region.flag
        assert flag.startswith("--roi ")
        numbers = number_list(flag.removeprefix("--roi "), "--roi", 6)
        points = view.placed(view.points)
        inside = ((points > numbers[:3]) & (points < numbers[3:])).all(axis=1)
        assert f"{inside.sum():,} of {len(points):,} points are inside" in text(browser)
        assert inside.mean() > 0.8

        turned = pose((5.2, -1.5, 2.0), random_rotations(1, 8)[0])
        page.region.place(turned)
        again = OrientedBox.of_numbers(number_list(page.region.flag.removeprefix("--roi "), "--roi", 9))
        np.testing.assert_allclose(again.T_scene_box, turned, atol=1e-5)
        np.testing.assert_allclose(again.size, page.region.size.value, atol=1e-5)


def test_a_page_looks_from_the_sensor_from_the_front_and_from_above(
    browser: Any, sample: tuple[Scene, Detections]
) -> None:
    view, found = sample
    middle = (np.percentile(view.points, 1, axis=0) + np.percentile(view.points, 99, axis=0)) / 2

    def eye(page: Viewer) -> tuple[np.ndarray, np.ndarray]:
        (client,) = page._server.get_clients().values()
        return client.camera.position * page.region._scene.size + middle, client.camera.up_direction

    with Viewer(view, PART, found, port=0, mesh=MESH) as page:
        look_at(browser, page)
        click(browser, "top")
        eventually(lambda: np.allclose(eye(page)[0][:2], middle[:2], atol=1e-2))
        assert eye(page)[0][2] < middle[2] - 1
        time.sleep(0.1)  # of clicks within a twentieth of a second the page sends the last alone
        click(browser, "front")
        eventually(lambda: eye(page)[0][1] > middle[1] + 1)
        np.testing.assert_allclose(eye(page)[1], [0, 0, -1], atol=1e-3)
        time.sleep(0.1)
        click(browser, "camera")
        eventually(lambda: np.allclose(eye(page)[0], 0, atol=1e-2))


def test_the_next_scan_takes_the_place_of_all(browser: Any, sample: tuple[Scene, Detections]) -> None:
    view, found = sample
    other = replace(view, source="folder/second.png", T_scene_camera=np.eye(4))
    answers = iter([(other, replace(found, poses=found.poses[:1]))])

    def following() -> tuple[Scene, Detections]:
        for answer in answers:
            return answer
        raise InputError("no .png file comes after it")

    with Viewer(replace(view, source="folder/first.png"), PART, found, port=0, mesh=MESH, on_next=following) as page:
        look_at(browser, page)
        assert "first.png of " in text(browser)
        click(browser, "Next scan")
        eventually(lambda: "second.png of " in text(browser))
        assert "1 found, 0 doubtful" in text(browser)
        assert "Pose 2" not in text(browser)
        np.testing.assert_allclose(page.region.T_scene_box[:3, :3], np.eye(3), atol=1e-9)
        time.sleep(0.1)
        click(browser, "Next scan")
        eventually(lambda: "no .png file comes after it" in text(browser))
        eventually(lambda: "Searching" not in text(browser))


def test_warnings_of_several_poses_are_told_once(sample: tuple[Scene, Detections]) -> None:
    found = sample[1]
    first, second = (replace(one, warnings=("is symmetric", name)) for one, name in zip(found.poses, "ab", strict=True))
    both = replace(found, poses=(first, second), warnings=("the scan has holes", "the scan has holes"))
    assert warnings_once(both) == (["the scan has holes", "poses 1, 2: is symmetric"], [["a"], ["b"]])
    assert heading(both, None, 5).count("is symmetric") == 1


def test_compiling_is_told_apart(sample: tuple[Scene, Detections]) -> None:
    found = sample[1]
    assert "searched in 0.50 s, after compiling for 1.00 s" in heading(found, "a<b.png", 1234)
    assert "a&lt;b.png of 1,234 points" in heading(found, "a<b.png", 1234)
    warm = replace(found, timing=replace(found.timing, compile=0.0))
    assert "searched in 0.50 s" in heading(warm, None, 1)
    assert "compiling" not in heading(warm, None, 1)


def test_the_same_pose_is_known_again(sample: tuple[Scene, Detections]) -> None:
    found = sample[1]
    near = replace(found.poses[1], T_scene_object=found.poses[1].T_scene_object @ pose((0.01, 0, 0)))
    turned = replace(near, T_scene_object=near.T_scene_object @ pose((0, 0, 0), random_rotations(1, 2)[0]))
    assert rank_of_same(near, found, PART) == 2
    assert rank_of_same(turned, found, PART) is None


def test_a_card_is_shown_by_the_mesh_that_it_was_made_of(tmp_path: Path) -> None:
    cad = tmp_path / "box.stl"
    digest = written(cad, trimesh.Trimesh(*box(*SIZES)))
    part = replace(PART, unit="m", source_digest=digest, minimum=PART.minimum / 100, maximum=PART.maximum / 100)
    for source in (cad, tmp_path / "box.kmn"):
        mesh = part_mesh(source, part)
        assert mesh is not None
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), np.array(SIZES) / 100, rtol=1e-6)
        assert len(mesh.triangles) == 12
    assert part_mesh(cad, replace(part, source_digest="0")) is None  # it is another one by now
    assert part_mesh(tmp_path / "other.kmn", part) is None
    fine = trimesh.Trimesh(*box(*SIZES)).subdivide_to_size(0.025)
    thinned = part_mesh(cad, replace(part, source_digest=written(cad, fine)))
    assert thinned is not None
    assert 12 <= len(thinned.triangles) <= 20_000 < len(fine.faces)
    np.testing.assert_allclose(np.ptp(thinned.vertices, axis=0), np.array(SIZES) / 100, rtol=1e-2)


def written(path: Path, mesh: trimesh.Trimesh) -> str:
    """Write an STL file, and return its digest."""
    content = mesh.export(file_type="stl")
    path.write_bytes(content)
    return hashlib.sha256(content).hexdigest()


def test_scans_come_by_name(tmp_path: Path) -> None:
    for name in ("a.png", "b.png", "c.png", "d.ply", "empty.png"):
        (tmp_path / name).touch()
    following = one_after_the_other(tmp_path / "a.png", lambda path: path.name, tmp_path / "empty.png", None)
    assert [following(), following()] == ["b.png", "c.png"]
    for _ in itertools.repeat(None, 2):
        with pytest.raises(InputError, match=re.escape(f"no .png file comes after it in {tmp_path}")):
            following()


def test_a_port_in_use_is_told_before_the_search(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def searched(_: object) -> None:
        raise AssertionError("the port was not looked at first")

    monkeypatch.setattr(kmn_jax.cli, "Session", searched)
    with listen("127.0.0.1", 0) as busy:
        port = busy.getsockname()[1]
        assert kmn_jax.cli.main(["view", "--object", "a.stl", "--scene", "b.ply", "--port", str(port)]) == 2
    assert f"port {port} of 127.0.0.1 cannot be used" in capsys.readouterr().err
