"""The commands of docs/serve.md work as they are pasted."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.serve.serve_sample import running

ROOT = Path(__file__).parent.parent.parent
GUIDE = (ROOT / "docs" / "serve.md").read_text(encoding="utf-8")


@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not installed: apt-get install curl")
def test_the_guides_requests_are_answered(tmp_path: Path) -> None:
    blocks = [block for block in re.findall(r"^```sh\n(.*?)^```$", GUIDE, re.M | re.S) if "curl" in block]
    assert len(blocks) == 2
    assert "%header{" not in GUIDE  # older versions of curl do not know it
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "experiments").symlink_to(ROOT / "experiments")
    (tmp_path / "private").mkdir()
    with running(tmp_path / "private") as server:
        program = "set -e\n" + "".join(blocks).replace(":8000", f":{server.port}")
        done = subprocess.run(["bash", "-c", program], cwd=tmp_path / "here", capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        assert '"status":"ready"' in done.stdout
        assert '"label":"gear_motor"' in done.stdout
        assert len(json.loads((tmp_path / "here" / "poses.json").read_text())["poses"]) == 2
        assert (tmp_path / "here" / "bin.png").read_bytes().startswith(b"\x89PNG")
        assert server.ask("GET", "/parts")[1] == {"parts": []}


def test_the_guide_names_all_requests_limits_and_metrics(tmp_path: Path) -> None:
    with running(tmp_path) as server:
        for path in server.ask("GET", "/openapi.json")[1]["paths"]:
            assert path.replace("{name}", "NAME") in GUIDE
        names = re.findall(
            r"^# TYPE (kmn_\w+) (counter|gauge|histogram)", server.ask("GET", "/metrics")[1].decode(), re.M
        )
        assert len(names) > 5
        for name, _ in names:
            assert name.endswith("_created") or f"`{name}`" in GUIDE
