"""The Python examples in README.md and docs/ run as they stand, on inputs that a comment before them names."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.bop import bop_scan
from kmn_jax.io import Scan
from kmn_jax.models._torch_file import state_dict_bytes
from tests.golden.make_network import draw_state_dict
from tests.reference.clouds import box_cloud, scene_crop

ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r"(?:<!-- given: (?P<given>[^\n]*?) -->\n)?^```python\n(?P<code>.*?)^```$", re.M | re.S)
EXAMPLES = [
    pytest.param(path, match, id=f"{path.name}-{number}")
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    for number, match in enumerate(BLOCK.finditer(path.read_text(encoding="utf-8")), start=1)
]
ASSETS = ROOT / "experiments" / "assets"
FILES = {
    "part_file": ASSETS / "industrial" / "gear_motor.stl",
    "small_pack": ASSETS / "small_pack",
    "small_test_set": ASSETS / "small_test_set",
}
IMAGE = ASSETS / "small_test_set" / "test" / "000002" / "depth" / "000000.png"
T_BASE_CAMERA = np.array([[0, -1, 0, 300.0], [-1, 0, 0, 50.0], [0, 0, -1, 900.0], [0, 0, 0, 1]])  # it looks down


def image() -> Scan:
    return bop_scan(IMAGE)[0]


def empty_depth() -> np.ndarray:
    """The image's floor alone, as it lies in most columns of a row."""
    depth = np.rint(image().depth)
    return np.repeat(np.quantile(depth, 0.9, axis=1), depth.shape[1]).reshape(depth.shape).astype(np.uint16)


GIVEN = {
    "depth": lambda: np.rint(image().depth).astype(np.uint16),
    "empty_depth": lambda: empty_depth(),
    "K": lambda: image().camera.matrix,
    "T_base_camera": lambda: T_BASE_CAMERA,
    "cloud_in_robot_frame": lambda: (image().points @ T_BASE_CAMERA[:3, :3].T + T_BASE_CAMERA[:3, 3]).astype("f4"),
    "cloud": lambda: box_cloud(0, 2048),
    "keypoint_indices": lambda: np.arange(20) * 100,
    "crop": lambda: scene_crop(0, 2048),
}


def test_every_room_has_its_page_of_the_reference() -> None:
    rooms = {path.parent.name for path in (ROOT / "kmn_jax").glob("*/__init__.py")}
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert {path.stem for path in (ROOT / "docs" / "api").glob("*.md")} == rooms
    for room in rooms:
        assert f"::: kmn_jax.{room}\n" in (ROOT / "docs" / "api" / f"{room}.md").read_text(encoding="utf-8")
        assert f"api/{room}.md\n" in nav


@pytest.mark.parametrize(("path", "block"), EXAMPLES)
def test_example_runs(path: Path, block: re.Match[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    line = path.read_text(encoding="utf-8").count("\n", 0, block.start("code"))
    code = compile("\n" * line + block["code"], str(path), "exec")
    monkeypatch.chdir(tmp_path)
    names = [name.strip() for name in (block["given"] or "").split(",") if name.strip()]
    if "checkpoint" in names:
        names.remove("checkpoint")
        (tmp_path / "keymatchnet.t7").write_bytes(state_dict_bytes(draw_state_dict(0)))
    for name in [name for name in names if name in FILES]:
        names.remove(name)
        (tmp_path / FILES[name].name).symlink_to(FILES[name])
    exec(code, {"__name__": "__main__"} | {name: GIVEN[name]() for name in names})
