"""`kmn serve` and `kmn detect --server` as commands: they start, answer, and end when they are told to."""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kmn_jax.cli import main
from kmn_jax.detection import FAST
from kmn_jax.errors import InputError
from kmn_jax.objects import Part
from kmn_jax.serve import ServeConfig, _client
from kmn_jax.serve._server import _prepared, uvicorn_config
from tests.serve.serve_sample import KnownAnswer, form, running, some_scan

# The command itself, with an estimator that needs no compiling and searches once it may.
PROGRAM = """
import os, sys, time
from kmn_jax.cli import main
from kmn_jax.detection import PoseEstimator
from tests.serve import serve_sample

class Slow(serve_sample.KnownAnswer):
    def detect(self, part, scene, **given):
        while given.get("top") and not os.path.exists(os.environ["MAY_ANSWER"]):
            time.sleep(0.05)
        return serve_sample.FOUND

PoseEstimator.from_pretrained = lambda weights: Slow()
sys.exit(main(sys.argv[1:]))
"""


def test_the_command_answers_ends_when_told_and_leaves_nothing_behind(tmp_path: Path) -> None:
    folder, parts = tmp_path / "temporary", tmp_path / "parts"
    folder.mkdir()
    parts.mkdir()
    (parts / "box.stl").write_bytes(b"solid")
    command = [sys.executable, "-c", PROGRAM, "serve", "--port", "0", "--parts", str(parts)]
    may_answer = tmp_path / "may-answer"
    environment = os.environ | {"TMPDIR": str(folder), "MAY_ANSWER": str(may_answer)}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.fullmatch(r"serving on http://127\.0\.0\.1:(\d+); stop with Ctrl\+C\n", line)
        assert found, (line, process.communicate()[1] if process.poll() is not None else "")
        port = int(found[1])
        answers: list[bytes] = []

        def ask(head: bytes, body: bytes = b"") -> None:
            with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
                connection.sendall(head + b"Host: localhost\r\nConnection: close\r\n\r\n" + body)
                pieces = []
                while piece := connection.recv(1 << 16):
                    pieces.append(piece)
                answers.append(b"".join(pieces))

        while not answers or not answers[-1].startswith(b"HTTP/1.1 200"):  # warm
            time.sleep(0.05)
            ask(b"GET /health HTTP/1.1\r\n")
        ask(b"GET /parts HTTP/1.1\r\n")
        assert b'"name":"box"' in answers[-1]
        # Of more than a megabyte, which is not kept in memory while it is received.
        body, kind = form(part="box", top=1, scene=("scan.ply", some_scan() + bytes(2_000_000)))
        head = f"POST /detect HTTP/1.1\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n".encode()
        del answers[:]
        threads = [threading.Thread(target=ask, args=(head, body)) for _ in range(2)]
        for thread in threads:
            thread.start()
        while b'"queued":2' not in (answers[-1] if answers else b""):
            time.sleep(0.05)
            ask(b"GET /health HTTP/1.1\r\n")
        (private,) = folder.iterdir()
        assert private.stat().st_mode & 0o777 == 0o700
        del answers[:]
        process.send_signal(signal.SIGTERM)
        may_answer.touch()
        out, error = process.communicate(timeout=60)
        for thread in threads:
            thread.join(60)
        said = "ready: all that searches need is compiled\nstopping: answering what is in flight\n"
        assert (process.returncode, out, error) == (0, said, "")
        assert [answer.startswith(b"HTTP/1.1 200") for answer in answers] == [True, True]
        assert list(folder.iterdir()) == []
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--port", "70000"], "port 70000 is not one"),
        (["--host", "no.such.host.invalid"], "host 'no.such.host.invalid' is not known"),
        (["--max-queue", "0"], "most_queued is 0"),
        (["--max-megabytes", "nan"], "--max-megabytes is nan"),
        (["--max-megabytes", "inf"], "--max-megabytes is inf"),
        (["--port", "0", "--parts", "no-such-folder"], "no-such-folder is not a folder"),
        (["--port", "0", "--parts", "."], "holds no part"),
        (["--port", "0", "--example", "scan.ply"], "an example scan needs the parts"),
        (["--port", "0", "--camera", "camera.json"], "the camera is that of an example scan"),
    ],
)
def test_a_server_that_cannot_start_says_why(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["serve", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_port_in_use_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["serve", "--port", str(port)]) == 2
    assert re.match(rf"kmn: port {port} of 127.0.0.1 cannot be used \(.*in use\)", capsys.readouterr().err)


def test_too_many_parts_are_refused_before_any_is_prepared(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / f"{number}.stl").write_bytes(b"broken")
    with pytest.raises(InputError, match="holds 3 parts, but at most 2 are kept"):
        _prepared(KnownAnswer(), tmp_path, 2)


def test_a_card_is_used_before_the_file_beside_it(tmp_path: Path) -> None:
    class OfCard(KnownAnswer):
        def prepare(self, path: Any, unit: str | None = None, name: str | None = None) -> Part:
            digest = path.read_text() if path.suffix == ".kmn" else "of the file"
            return replace(super().prepare(path), source_digest=digest)

    said: list[str] = []
    for name in ("nut.stl", "bolt.STEP", "lone.stl"):
        (tmp_path / name).write_bytes(name.encode())
    (tmp_path / "nut.kmn").write_text(hashlib.sha256(b"nut.stl").hexdigest())
    (tmp_path / "bolt.kmn").write_text(hashlib.sha256(b"an earlier one").hexdigest())
    found = _prepared(OfCard(), tmp_path, 3, said.append)
    assert {name: part.source_digest for name, part in found.items()} == {
        "bolt": (tmp_path / "bolt.kmn").read_text(),
        "lone": "of the file",
        "nut": (tmp_path / "nut.kmn").read_text(),
    }
    assert said == ["the part bolt is that of bolt.kmn, which was not made from bolt.STEP as it is now"]
    (tmp_path / "nut.step").touch()
    with pytest.raises(InputError, match=r"two files for the part nut, nut\.step and nut\.stl: remove one"):
        _prepared(OfCard(), tmp_path, 3)


def test_connections_are_kept_as_long_as_the_next_head_may_take() -> None:
    assert uvicorn_config(None, ServeConfig(head_limit=7.2)).timeout_keep_alive == 8


@contextmanager
def other_server(status: int, content: bytes, part: str = "/parts/a", location: str = "") -> Iterator[str]:
    """Serve something else."""

    class Other(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(status)
            self.send_header("Part", part)
            if location:
                self.send_header("Location", location)
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Other) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_detect_sends_all_of_a_request_to_a_server(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part, scene, camera, empty = (tmp_path / name for name in ("my nut.stl", "depth.npy", "camera.json", "empty.ply"))
    part.write_bytes(b"solid")
    np.save(scene, np.ones((4, 5), np.float32))
    camera.write_text("{}")
    empty.write_bytes(some_scan())
    outputs = {flag: tmp_path / name for flag, name in (("--json", "a.json"), ("--bop-csv", "a.csv"))}
    flags = {"--object": part, "--scene": scene, "--camera": camera, "--background": empty, "--units": "m", **outputs}
    flags |= {"--save-picture": tmp_path / "a.png", "--roi": "0,0,0,1,1,1", "--plane": "always", "--random-seed": 5}
    flags |= {"--effort": "fast"}
    given = [str(text) for pair in flags.items() for text in pair] + ["--at", "-1,2,3", "--at", "4,5,6"]
    (tmp_path / "private").mkdir()
    with running(tmp_path / "private") as server:
        url = f"http://127.0.0.1:{server.port}"
        assert main(["detect", *given, "--top", "1", "--server", url]) == 0, capsys.readouterr().err
        (asked,) = server.known.asked
        assert asked["content"] == scene.read_bytes()
        assert asked["unit"] == "m"
        assert asked["config"] == FAST
        np.testing.assert_array_equal(asked["at"], [[-1, 2, 3], [4, 5, 6]])
        options = asked["background"]
        assert (options.roi, options.remove_plane) == ((0, 0, 0, 1, 1, 1), "always")
        assert options.background.points.tobytes() == some_scan()
        found = json.loads((tmp_path / "a.json").read_text())
        assert (found["object"], found["scene"], found["seed"]) == (str(part), str(scene), 5)
        assert len(found["poses"]) == 1
        assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
        assert (tmp_path / "a.csv").read_text().count("\n") == 2
        assert "my nut: 1 found" in capsys.readouterr().out
        for changes, message in (
            ({"--object": tmp_path / "none.stl"}, "none.stl cannot be read"),
            ({"--weights": "other"}, "the server has weights of its own"),
            ({"--grasps": scene}, "a server knows no robot"),
            ({"--roi": "1,2"}, "says: roi is '1,2', but must be 6 or 9 numbers"),
            ({"--server": "127.0.0.1:1"}, "is no address of a server"),
            ({"--server": url + "/elsewhere"}, "says: Not Found"),
        ):
            flags_then = {"--server": url, **flags, **changes}
            assert main(["detect", *(str(text) for pair in flags_then.items() for text in pair)]) == 2
            error = capsys.readouterr().err
            assert message in error
            assert error.count("\n") == 1
    deep = b"[" * 100_000
    for status, content, path in ((200, b"{}", "@other.host/"), (200, b"{}", ""), (200, deep, "/"), (500, deep, "/")):
        with other_server(status, content, path) as address:
            assert main(["detect", *given, "--server", address]) == 2
            error = capsys.readouterr().err
            other = "does not answer as kmn serve does" if status == 200 else "says: it answered 500"
            assert f"the server at {address} {other}" in error
            assert error.count("\n") == 1
    with (
        running(tmp_path / "private") as server,
        other_server(302, b"", "/", f"http://127.0.0.1:{server.port}/parts") as one,
    ):
        assert main(["detect", *given, "--server", one]) == 2
        assert f"the server at {one} says: it answered 302" in capsys.readouterr().err
        assert server.server.server_state.total_requests == 0
    assert main(["detect", *given, "--server", url]) == 2
    assert f"no answer from a server at {url}" in capsys.readouterr().err


def test_a_server_that_hangs_up_while_much_is_sent_is_no_missing_one() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def hang_up() -> None:
            connection, _ = listener.accept()
            connection.recv(1)
            connection.close()  # with data that was not read, which resets it

        thread = threading.Thread(target=hang_up)
        thread.start()
        address = f"http://127.0.0.1:{listener.getsockname()[1]}"
        message = "hung up while 30.0 MB were sent: they may be above its --max-megabytes, or it is no kmn serve"
        with pytest.raises(InputError, match=message):
            _client._request(address, "/detect", b"0" * 30_000_000)
        thread.join()
