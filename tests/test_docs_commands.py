"""The commands in README.md and docs/ are commands that exist, with flags and files that exist."""

from __future__ import annotations

import importlib.util
import re
import shlex
from pathlib import Path

import pytest

from kmn_jax.arguments import joined, parsed
from kmn_jax.cli import convert, detect, export, prepare, serve, view

ROOT = Path(__file__).parent.parent
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
