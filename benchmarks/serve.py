"""The server under load on this machine: latency, memory and errors of many scans from several clients at once.

python -m benchmarks.serve [--scans 1000] [--clients 8] [--json FILE]

`kmn serve` runs in a process of its own, as a user starts it. Each client keeps one connection and sends the next scan
as soon as it has its answer, so that all but one of them wait in the queue. Scans are depth images of the small test
set, each sent with its camera; the same scan must be answered by the same poses, whoever asks.
"""

from __future__ import annotations

import http.client
import itertools
import json as jsons
import os
import re
import secrets
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.command import run
from kmn_jax.errors import InputError
from kmn_jax.report import print_table, write_json

_PART = Path("experiments/assets/industrial/gear_motor.stl")
_SCENE = Path("experiments/assets/small_test_set/test/000002")  # bins of that part
_STARTED = re.compile(r"serving on http://127\.0\.0\.1:(\d+);")
_SETTLED = 0.2  # share of the scans after which memory should not grow any more


@dataclass
class _Load:
    """What clients have done so far, and how it went."""

    bodies: list[tuple[bytes, str]]
    numbers: Any  # which scan is next
    bar: Any
    seconds: list[float] = field(default_factory=list)
    searches: list[float] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    answers: dict[int, Any] = field(default_factory=dict)
    different: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)


def main(scans: int = 1000, clients: int = 8, json: Path | None = None) -> None:
    """Send scans until all are answered.

    Args:
        scans: how many.
        clients: that send at once.
        json: where results go.
    """
    bodies = [_form(image) for image in sorted((_SCENE / "depth").glob("*.png"))]
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, _PART.name).symlink_to(_PART.resolve())
        command = [sys.executable, "-m", "kmn_jax.cli", "serve", "--port", "0", "--parts", folder]
        command += ["--example", str(next((_SCENE / "depth").glob("*.png")))]
        begin = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                port = _port(process)
                ready_s = _wait_until_ready(process, port, begin)
                row = {"scans": scans, "clients": clients, "ready s": ready_s}
                row |= _under_load(process.pid, port, bodies, scans, clients)
                process.send_signal(signal.SIGTERM)
                row["exit code"] = process.wait(60)
            finally:
                process.kill()
    print_table("The server under load", [row])
    write_json(json, {"serve": [row]})


def _under_load(pid: int, port: int, bodies: list[tuple[bytes, str]], scans: int, clients: int) -> dict[str, Any]:
    load = _Load(bodies, itertools.count(), tqdm(total=scans, unit="scan"))
    threads = [threading.Thread(target=_client, args=(port, load, scans)) for _ in range(clients)]
    begin, memory = time.perf_counter(), []
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        memory.append((len(load.seconds), _resident(pid)))
        time.sleep(0.2)
    elapsed = time.perf_counter() - begin
    load.bar.close()
    for error in load.errors[:5]:
        print(error)
    if not load.seconds:
        raise InputError("no scan was answered")
    settled = [bytes_ for done, bytes_ in memory if done >= _SETTLED * scans]
    percentiles = {f"p{q} s": float(np.percentile(load.seconds, q)) for q in (50, 90, 99)}
    return {
        "errors": len(load.errors),
        "different answers": load.different,
        "scans a second": scans / elapsed,
        "search s": float(np.median(load.searches)),
        **percentiles,
        "longest s": max(load.seconds),
        "memory MB": settled[0] / 1e6,
        "memory at the end MB": settled[-1] / 1e6,
        "largest memory MB": max(bytes_ for _, bytes_ in memory) / 1e6,
    }


def _client(port: int, load: _Load, scans: int) -> None:
    """Send scans on one connection until there are no more."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=300)
    while (number := next(load.numbers)) < scans:
        which = number % len(load.bodies)
        body, kind = load.bodies[which]
        start = time.perf_counter()
        try:
            connection.request("POST", "/detect", body, {"Content-Type": kind})
            answer = connection.getresponse()
            content = answer.read()
            if answer.status != 200:
                raise OSError(f"{answer.status}: {content[:200]!r}")
            found = jsons.loads(content)
        except (OSError, http.client.HTTPException, ValueError) as error:
            connection.close()
            with load.lock:
                load.errors.append(f"scan {number}: {error}")
        else:
            poses = [(pose["T_scene_object"], pose["probability"]) for pose in found["poses"]]
            with load.lock:
                load.seconds.append(time.perf_counter() - start)
                load.searches.append(found["timing"]["total_s"])
                load.different += load.answers.setdefault(which, poses) != poses
        load.bar.update()
    connection.close()


def _form(image: Path) -> tuple[bytes, str]:
    """Return the form of a depth image with its camera, and its content type."""
    cameras = jsons.loads((_SCENE / "scene_camera.json").read_text())
    camera = jsons.dumps(cameras[str(int(image.stem))]).encode()
    boundary = secrets.token_hex(16)
    head = f'--{boundary}\r\nContent-Disposition: form-data; name="'
    pieces = [f'{head}part"\r\n\r\n{_PART.stem}\r\n'.encode(), f'{head}units"\r\n\r\nmm\r\n'.encode()]
    for name, called, content in (("camera", "camera.json", camera), ("scene", image.name, image.read_bytes())):
        pieces += [f'{head}{name}"; filename="{called}"\r\n\r\n'.encode(), content, b"\r\n"]
    return b"".join([*pieces, f"--{boundary}--\r\n".encode()]), f"multipart/form-data; boundary={boundary}"


def _port(process: subprocess.Popen[str]) -> int:
    assert process.stdout is not None
    found = _STARTED.match(process.stdout.readline())
    if found is None:
        raise InputError("the server did not start: see what it said above")
    return int(found[1])


def _wait_until_ready(process: subprocess.Popen[str], port: int, begin: float) -> float:
    """Return how many seconds after its start the server had compiled everything."""
    while process.poll() is None:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        connection.request("GET", "/health")
        status = connection.getresponse().status
        connection.close()
        if status == 200:
            return time.perf_counter() - begin
        time.sleep(0.1)
    raise InputError("the server stopped before it was ready: see what it said above")


def _resident(pid: int) -> int:
    """Return the bytes of memory that a process holds (Linux)."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    run(main)
