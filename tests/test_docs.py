"""The Python examples in README.md and docs/ run as they stand."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r"(?:<!-- not run: (?P<reason>[^\n]*?) -->\n)?^```python\n(?P<code>.*?)^```$", re.M | re.S)
EXAMPLES = [
    pytest.param(path, match, id=f"{path.name}-{number}")
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    for number, match in enumerate(BLOCK.finditer(path.read_text(encoding="utf-8")), start=1)
]


@pytest.mark.parametrize(("path", "block"), EXAMPLES)
def test_example_runs(path: Path, block: re.Match[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    line = path.read_text(encoding="utf-8").count("\n", 0, block.start("code"))
    code = compile("\n" * line + block["code"], str(path), "exec")
    if block["reason"]:
        pytest.skip(f"{path.name}:{line}: {block['reason']}")
    monkeypatch.chdir(tmp_path)
    exec(code, {"__name__": "__main__"})
