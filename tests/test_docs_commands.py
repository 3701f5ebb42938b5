"""The commands in README.md and docs/: all are commands that exist, and those that search files run as pasted."""

from __future__ import annotations

import http.client
import importlib.util
import json
import os
import re
import shlex
import signal
import threading
import time
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from kmn_jax.arguments import joined, parsed
from kmn_jax.bop import bop_scan
from kmn_jax.cli import convert, detect, export, main, prepare, serve, view
from kmn_jax.viz import Viewer

ROOT = Path(__file__).parent.parent
ASSETS = ROOT / "experiments" / "assets"
IMAGE = ASSETS / "small_test_set" / "test" / "000002" / "depth" / "000000.png"  # of three copies: soon searched
GUIDE, SERVING = ROOT / "docs" / "detect.md", ROOT / "docs" / "serve.md"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
OWN = {  # what stands for the reader's own files
    *("part.stl", "part.kmn", "part.grasps.json", "scan.ply", "empty_bin.ply", "depth.png", "scan.png", "camera.json"),
    *("camera_pose.json", "parts", "parts/"),
}


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```sh\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S)


def commands(block: str) -> list[list[str]]:
    """Return the words of each command, without comments."""
    lines = block.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


ALL = [
    pytest.param(words, id=f"{page.name}: {' '.join(words)[:60]}")
    for page in PAGES
    for block in blocks(page)
    if "curl" not in block  # those of the server are pasted by tests/serve/test_guide.py
    for words in commands(block)
]


@pytest.mark.parametrize("words", ALL)
def test_the_command_exists(words: list[str]) -> None:
    program, *rest = words
    if program == "kmn":
        parsed(joined(rest), (prepare, detect, view, serve, export, convert))
        for word in rest[1:]:
            if "/" in word and not word.startswith(("http:", "-")) and word not in OWN:
                assert (ROOT / word).exists(), f"{word} is neither in the repository nor the reader's own"
    elif program == "make":
        assert re.search(rf"^{rest[0]}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    elif program.endswith("python") and rest[0] == "-m":
        assert importlib.util.find_spec(rest[1]) is not None
    elif program.endswith("python"):
        assert (ROOT / rest[0]).is_file()
    else:
        assert program in ("pip", "git", "cp"), "what is it?"


@pytest.fixture
def own_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a reader with a part, scans of it, a camera, and what a robot needs; it is where we are."""
    scan, _ = bop_scan(IMAGE)
    assert scan.camera is not None
    (tmp_path / "part.stl").symlink_to(ASSETS / "industrial" / "gear_motor.stl")
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "motor.stl").symlink_to(ASSETS / "industrial" / "gear_motor.stl")
    (tmp_path / "experiments").symlink_to(ROOT / "experiments")
    for name in ("depth.png", "scan.png"):
        (tmp_path / name).write_bytes(IMAGE.read_bytes())
    matrix = scan.camera.matrix
    camera = {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2], "depth_scale": 0.02}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    low, high = scan.points.min(axis=0), scan.points.max(axis=0)
    floor = np.stack(np.meshgrid(*np.linspace(low[:2], high[:2], 150).T, high[2]), axis=-1).reshape(-1, 3)
    # The guide's point to search at, 12,-40,630, is on a copy: the one in the middle.
    shift = np.array([12.0, -40, 630]) - [-15, 2, 787]
    for name, points in (("scan.ply", scan.points), ("empty_bin.ply", floor)):
        header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
        header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
        (tmp_path / name).write_bytes(header.encode() + (points + shift).astype("<f4").tobytes())
    gripper = {"boxes": [{"center": [0, 0, -40], "size": [90, 40, 20]}]}
    ways = [{"T_object_grasp": [[0, 0, -1, 0], [1, 0, 0, 0], [0, -1, 0, -30], [0, 0, 0, 1]], "width": 40}]
    (tmp_path / "part.grasps.json").write_text(json.dumps({"unit": "mm", "gripper": gripper, "grasps": ways}))
    (pose,) = re.findall(r"^```json\n(.*?)^```$", GUIDE.read_text(encoding="utf-8"), re.M | re.S)
    (tmp_path / "camera_pose.json").write_text(pose)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_searches_run_as_they_are_pasted(own_files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grasps = ROOT / "docs" / "grasps.md"
    (first,) = (block for block in blocks(ROOT / "README.md") if block.startswith("kmn detect"))
    (own,) = (block for block in blocks(ROOT / "README.md") if block.startswith("kmn prepare"))
    guide = [words for words in commands(blocks(GUIDE)[0]) if {"--at", "--save-picture"} & {*words}]
    run = [words for words in [*commands(first), *commands(own), *guide] if words[1] in ("prepare", "detect")]
    assert len(run) == 7
    assert blocks(grasps)[0].count("--grasps part.grasps.json") == 2  # the same as in README
    for words in run:
        capsys.readouterr()
        assert main(words[1:]) == 0, capsys.readouterr().err
        if words[1] == "detect":
            assert "nothing found" not in capsys.readouterr().out, words
    for name in ("bin.png", "poses.png"):
        assert (own_files / name).read_bytes().startswith(b"\x89PNG")
    assert json.loads((own_files / "poses.json").read_text())["poses"]


def test_the_page_opens_and_the_export_is_written_as_is_pasted(
    own_files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = [words for words in commands(blocks(GUIDE)[0]) if words[1] in ("prepare", "view", "export")]
    assert len(run) == 3
    answered: list[bool] = []
    # Nobody is here to press Ctrl+C.
    monkeypatch.setattr(Viewer, "wait", lambda page: answered.append(is_answered(page.url)))
    for words in run:
        assert main([*words[1:], *(["--port", "0"] if words[1] == "view" else [])]) == 0, capsys.readouterr().err
    assert answered == [True]
    assert "nothing found" not in capsys.readouterr().out
    assert (own_files / "part.jaxexport").stat().st_size > 1_000_000


def test_a_server_starts_and_is_asked_as_is_pasted(
    own_files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [words for block in blocks(SERVING) if "curl" not in block for words in commands(block)]
    (start,) = (words for words in given if "--example" in words)
    (ask,) = (words for words in given if "--server" in words)
    told: list[str] = []
    codes: list[int] = []
    monkeypatch.setattr("kmn_jax.cli.say", told.append)

    def ask_and_stop() -> None:
        while not told:
            time.sleep(0.05)
        try:
            (url,) = re.findall(r"http://[\d.:]+", told[0])
            while not is_answered(f"{url}/health"):
                time.sleep(0.2)
            codes.append(main([url if word == "http://127.0.0.1:8000" else word for word in ask[1:]]))
        finally:
            os.kill(os.getpid(), signal.SIGTERM)  # which the server takes

    asker = threading.Thread(target=ask_and_stop, daemon=True)
    asker.start()
    assert main([*start[1:], "--port", "0"]) == 0, capsys.readouterr().err
    asker.join(30)
    assert codes == [0]
    assert json.loads((own_files / "poses.json").read_text())["poses"]


def is_answered(url: str) -> bool:
    """Tell whether an address answers that all is well."""
    place = urlsplit(url)
    connection = http.client.HTTPConnection(place.netloc, timeout=60)
    try:
        connection.request("GET", f"{place.path}?{place.query}")
        return connection.getresponse().status == 200
    finally:
        connection.close()
