"""Open many connections to a server that never ask for anything whole, and see that others are answered meanwhile.

python -m tests.attack.crowd --connections 10000 [--json FILE]

It is the server of `kmn serve` with its own limits, in this process; what it answers is known, so that no search takes
time. Connections are kept open on this side as long as the process may hold them.
"""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import sys
import tempfile
import time
from collections import deque
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from tqdm import trange

from kmn_jax.errors import InputError
from kmn_jax.report import check_target, print_table, write_json
from kmn_jax.serve import ServeConfig
from tests.serve.serve_sample import Running, form, running, some_scan

# What they send, in turn: nothing, half a head, a head without its body, and half a body.
_HEAD = b"POST /detect HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=x\r\n"
_BEGINNINGS = (b"", _HEAD, _HEAD + b"Content-Length: 1000\r\n\r\n", _HEAD + b"Content-Length: 1000\r\n\r\n--x\r\n")
_EVERY = 250  # connections, after which somebody asks
_SPARE = 600  # files that the server and this process need beside


@dataclass
class Crowd:
    """What came of it."""

    connections: int = 0
    refused: int = 0
    held_at_once: int = 0  # on this side
    most_at_server: int = 0
    asked: int = 0
    slowest_answer_s: float = 0.0
    growth_mb: float = 0.0
    seconds: float = 0.0


def main(connections: int = 10_000, json: Path | None = None) -> int:
    """Crowd a server; return 1 if it held more connections than it allows.

    Args:
        connections: how many.
        json: where the figures go.
    """
    check_target(json)
    config = ServeConfig(port=0)
    with tempfile.TemporaryDirectory() as folder, running(Path(folder), config) as server:
        found = crowded(server, connections)
    print_table(f"{connections} connections", [asdict(found)])
    write_json(json, asdict(found))
    return int(found.most_at_server > config.most_connections + 1)  # the newest, for a moment


def crowded(server: Running, connections: int) -> Crowd:
    """Open so many connections, and ask for an answer now and then. Raises AssertionError if there is none."""
    found, held, start, before = Crowd(connections), deque[socket.socket](), time.perf_counter(), _megabytes()
    most = _most_files() - _SPARE
    try:
        for number in trange(connections, unit="connection", disable=connections < _EVERY):
            if len(held) >= most:
                held.popleft().close()
            try:
                connection = socket.create_connection(("127.0.0.1", server.port), timeout=20)
                held.append(connection)
                connection.sendall(_BEGINNINGS[number % len(_BEGINNINGS)])
            except ConnectionError:
                found.refused += 1
            found.held_at_once = max(found.held_at_once, len(held))
            found.most_at_server = max(found.most_at_server, len(server.server.server_state.connections))
            if number % _EVERY == _EVERY - 1 or number == connections - 1:
                asked = time.perf_counter()
                status, said, _ = server.ask("GET", "/parts")
                assert status == 200, said
                body, kind = form(object=b"solid", scene=("scan.ply", some_scan()))
                status, said, _ = server.ask("POST", "/detect", body, {"Content-Type": kind})
                assert status == 200, said
                found.asked += 1
                found.slowest_answer_s = round(max(found.slowest_answer_s, time.perf_counter() - asked), 3)
        found.growth_mb = round(_megabytes() - before, 1)
    finally:
        for connection in held:
            connection.close()
    found.seconds = round(time.perf_counter() - start, 1)
    return found


def _most_files() -> int:
    """Let this process hold as many files as it may, and return their number."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        soft = hard
    return soft


def _megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main))
    except InputError as error:
        print(f"crowd: {error}", file=sys.stderr)
        sys.exit(2)
