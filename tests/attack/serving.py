"""A session with `kmn serve`, to be killed with it: it prepares parts, searches scans, and ends.

python -m tests.attack.serving FOLDER

What the server answers is a file as soon as it has come: that is what it has confirmed. Another session in the same
folder starts the server again, and asks the same.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

from kmn_jax.files import write_whole
from kmn_jax.serve import detect_on_server

_ASSETS = Path(__file__).parents[2] / "experiments" / "assets"
_NAMED = ("gear_motor", "shaft")  # in the folder that the server is started on
_SENT = ("gear_motor", "idler", "screw")  # with a scan
_BIN = _ASSETS / "small_test_set" / "test" / "000002"
_IMAGES = (2, 3)
_CLOCKS = ("timing", "object", "scene")  # of an answer: what may differ
_MOST_SECONDS = 3000  # of a start and of an answer, on a machine that others use, too


def run(folder: Path) -> None:
    """Start a server on the parts of a folder, ask all of it, and end it."""
    parts, temporary = folder / "parts", folder / "temporary"
    parts.mkdir(exist_ok=True)
    temporary.mkdir(exist_ok=True)
    for name in _NAMED:
        if not (parts / f"{name}.stl").exists():
            write_whole(parts / f"{name}.stl", cad_file(name).read_bytes())
    flags = ["--port", "0", "--parts", str(parts), "--time-limit", str(_MOST_SECONDS)]
    command = [sys.executable, "-m", "kmn_jax.cli", "serve", *flags]
    environment = os.environ | {"TMPDIR": str(temporary)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True) as server:
        try:
            assert server.stdout is not None
            url = re.findall(r"http://[\d.:]+", server.stdout.readline())[0]
            end = time.monotonic() + _MOST_SECONDS
            while not _is_ready(url):
                assert time.monotonic() < end, "the server does not get ready"
                time.sleep(0.1)
            _ask_all(url, folder)
            server.send_signal(signal.SIGTERM)
            code = server.wait(_MOST_SECONDS)
            assert code == 0, f"the server ended with code {code}"
        finally:
            server.kill()


def cad_file(name: str) -> Path:
    """Return where a part's CAD file is."""
    return _ASSETS / "industrial" / f"{name}.stl"


def _is_ready(url: str) -> bool:
    try:
        return bool(_fetched(f"{url}/health")["status"] == "ready")
    except urllib.error.HTTPError:
        return False


def _fetched(url: str) -> Any:
    with urllib.request.urlopen(url, timeout=_MOST_SECONDS) as answer:
        return json.load(answer)


def _ask_all(url: str, folder: Path) -> None:
    _confirm(folder, "parts", _fetched(f"{url}/parts"))
    truth = json.loads((_BIN / "scene_gt.json").read_text(encoding="utf-8"))
    for image in _IMAGES:
        nearest = min((pose["cam_t_m2c"] for pose in truth[str(image)]), key=lambda place: place[2])
        at = ",".join(map(str, nearest))
        for name in _SENT:
            answer = detect_on_server(url, cad_file(name), _BIN / "depth" / f"{image:06}.png", at=at, random_seed=image)
            found = {key: value for key, value in answer.result.items() if key not in _CLOCKS}
            _confirm(folder, f"{name} in {image}", found)


def _confirm(folder: Path, name: str, answer: Any) -> None:
    write_whole(folder / f"{name}.json", json.dumps(answer, indent=1).encode())


if __name__ == "__main__":
    run(Path(sys.argv[1]))
