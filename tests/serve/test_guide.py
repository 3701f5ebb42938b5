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


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed: apt-get install g++")
def test_the_guides_client_in_cpp_prints_poses_and_says_what_is_wrong(tmp_path: Path) -> None:
    source, client = ROOT / "docs" / "client.cpp", tmp_path / "client"
    strict = ("g++", "-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
    done = subprocess.run([*strict, str(source), "-o", str(client)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    depth, camera = tmp_path / "depth.png", tmp_path / "camera.json"
    depth.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 4000)
    camera.write_text("{}")
    (tmp_path / "private").mkdir()
    with running(tmp_path / "private") as server:
        assert server.send("PUT", "/parts/motor", file=("gear_motor.stl", b"solid"))[0] == 201
        for host, part, code, message in (
            ("127.0.0.1", "motor", 0, ""),
            ("localhost", "motor", 0, ""),
            ("127.0.0.1", "nut", 1, "there is no part 'nut'"),
            ("no.such.host.invalid", "motor", 1, "is not known"),
        ):
            command = [client, host, str(server.port), part, depth, camera]
            done = subprocess.run(command, capture_output=True, text=True, timeout=60)
            assert done.returncode == code, done.stderr
            assert message in done.stderr
            if code == 0:
                found = json.loads(done.stdout)
                assert (found["object"], found["scene"], len(found["poses"])) == ("motor", "depth.png", 2)
        assert [asked["content"] for asked in server.known.asked] == [depth.read_bytes()] * 2
        assert {asked["unit"] for asked in server.known.asked} == {"mm"}
    done = subprocess.run(command[:1], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (1, "client: usage: client HOST PORT PART DEPTH.png CAMERA.json\n")


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
