"""The Python examples in README.md and docs/ run as they stand at the root of the repository."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r"^```python\n(?P<code>.*?)^```$", re.M | re.S)
EXAMPLES = [
    pytest.param(path, match, id=f"{path.name}-{number}")
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    for number, match in enumerate(BLOCK.finditer(path.read_text(encoding="utf-8")), start=1)
]


@pytest.fixture
def like_the_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in a folder in which all of the repository seems to lie, but what is written stays."""
    for folder in ("benchmarks", "configs", "docs", "experiments", "kmn_jax"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    monkeypatch.chdir(tmp_path)


def test_each_table_has_as_many_columns_below_its_head_as_in_it() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "kmn_jax" / "pretrained").rglob("*.md")]
    tables = 0
    for page in pages:
        lines = page.read_text(encoding="utf-8").splitlines()
        for head, rule in pairwise(lines):
            if re.fullmatch(r"\|(\s*:?-+:?\s*\|)+", rule):
                assert len(re.findall(r"(?<!\\)\|", head)) == rule.count("|"), f"{page.name}: {head}"
                tables += 1
    assert tables > 20


def test_every_room_has_its_page_of_the_reference() -> None:
    rooms = {path.parent.name for path in (ROOT / "kmn_jax").glob("*/__init__.py")}
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert {path.stem for path in (ROOT / "docs" / "api").glob("*.md")} == rooms
    for room in rooms:
        assert f"::: kmn_jax.{room}\n" in (ROOT / "docs" / "api" / f"{room}.md").read_text(encoding="utf-8")
        assert f"api/{room}.md\n" in nav


@pytest.mark.usefixtures("like_the_root")
@pytest.mark.parametrize(("path", "block"), EXAMPLES)
def test_example_runs(path: Path, block: re.Match[str], capsys: pytest.CaptureFixture[str]) -> None:
    line = path.read_text(encoding="utf-8").count("\n", 0, block.start("code"))
    code = compile("\n" * line + block["code"], str(path), "exec")
    exec(code, {"__name__": "__main__"})
    if path.name == "grasps.md":
        assert re.search(r"^\d\.\d\d side \d 40\.0 \[\[", capsys.readouterr().out, re.M), "some copy can be held"
