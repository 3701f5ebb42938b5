"""What the server refuses, and that slow, large and malformed clients keep nobody else waiting."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gc
import http.client
import socket
import threading
import time
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from starlette.exceptions import HTTPException

from kmn_jax.errors import InputError
from kmn_jax.serve import ServeConfig
from kmn_jax.serve._gate import Gate
from kmn_jax.serve._worker import Worker
from kmn_jax.web import is_allowed_host, is_same_origin
from tests.serve.serve_sample import Running, eventually, form, running, some_scan

SCAN = ("scan.ply", some_scan())
QUICK = ServeConfig(
    port=0,
    most_bytes=200_000,
    most_queued=2,
    most_connections=12,
    time_limit=20.0,
    head_limit=1.0,
    body_limit=2.0,
    write_limit=1.0,
)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with running(tmp_path_factory.mktemp("private"), QUICK) as one:
        yield one


def opened(server: Running, sent: bytes = b"") -> socket.socket:
    """Return a connection on which something has been sent."""
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=20)
    with contextlib.suppress(ConnectionError):  # it may be refused before it has all been sent
        connection.sendall(sent)
    return connection


def rest(connection: socket.socket) -> bytes:
    """Return what comes until the connection is closed."""
    pieces = []
    with contextlib.suppress(ConnectionResetError):
        while piece := connection.recv(1 << 16):
            pieces.append(piece)
    connection.close()
    return b"".join(pieces)


def search(server: Running) -> tuple[int, dict[str, str]]:
    status, said, headers = server.send("POST", "/detect", object=b"solid", scene=SCAN)
    return status, {**said, **dict(headers)}


@pytest.mark.parametrize(
    ("host", "names", "allowed"),
    [
        ("127.0.0.1", (), True),
        ("127.0.0.1:8000", (), True),
        ("localhost:1", (), True),
        ("LOCALHOST", (), True),
        ("[::1]:8000", (), True),
        ("192.168.1.7:80", (), True),
        ("cell.example:8000", ("cell.example",), True),
        ("Cell.Example", ("cell.example",), True),
        ("cell.example", (), False),
        ("evil.example:8000", ("cell.example",), False),
        ("localhost.evil.example", (), False),
        ("127.0.0.1.evil.example", (), False),
        ("127.0.0.1:80@evil.example", (), False),
        ("[::1", (), True),
        ("", (), False),
        ("1", (), False),
    ],
)
def test_hosts(host: str, names: tuple[str, ...], allowed: bool) -> None:
    assert is_allowed_host(host, names) == allowed


@pytest.mark.parametrize(
    ("origin", "same"),
    [
        (None, True),
        ("http://127.0.0.1:8000", True),
        ("http://127.0.0.1", False),
        ("http://127.0.0.1:8001", False),
        ("http://evil.example", False),
        ("null", False),
        ("", False),
    ],
)
def test_origins(origin: str | None, same: bool) -> None:
    assert is_same_origin(origin, "127.0.0.1:8000") == same


def test_other_hosts_and_pages_of_other_sites_are_refused(server: Running) -> None:
    own = f"127.0.0.1:{server.port}"
    body, kind = form(object=b"solid", scene=SCAN)
    for headers, status in (
        ({"Host": "evil.example"}, 421),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": f"http://{own}"}, 200),
        ({"Host": f"localhost:{server.port}", "Origin": f"http://localhost:{server.port}"}, 200),
    ):
        code, said, sent = server.ask("POST", "/detect", body, {"Content-Type": kind, **headers})
        assert code == status, said
        assert "Access-Control-Allow-Origin" not in sent
        assert server.ask("GET", "/parts", None, headers)[0] == status
    assert b" 421 " in rest(opened(server, b"GET /parts HTTP/1.0\r\n\r\n"))  # it names no host


def test_bodies_that_are_too_large_are_refused_before_they_are_read(server: Running) -> None:
    head = b"POST /detect HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=x\r\n"
    connection = opened(server, head + b"Content-Length: 1000000000\r\n\r\n")
    assert connection.recv(1000).startswith(b"HTTP/1.1 413 ")
    connection.close()
    # Without a length, they are counted as they come; what is sent on is not kept, and not for ever.
    connection = opened(server, head + b"Transfer-Encoding: chunked\r\n\r\n")
    piece = b"10000\r\n" + bytes(0x10000) + b"\r\n"
    end, is_closed = time.monotonic() + 20, False
    while not is_closed and time.monotonic() < end:
        try:
            connection.sendall(piece)
        except ConnectionError:
            is_closed = True
    connection.close()
    assert is_closed
    body, kind = form(object=b"solid", scene=("scan.ply", bytes(200_000)))
    code, said, _ = server.ask("POST", "/detect", body, {"Content-Type": kind})
    assert (code, "larger than 0.2 MB" in said["error"]) == (413, True)

    def pieces() -> Iterator[bytes]:
        yield body

    asking = http.client.HTTPConnection("127.0.0.1", server.port, timeout=20)
    asking.request("POST", "/detect", pieces(), {"Content-Type": kind}, encode_chunked=True)
    assert asking.getresponse().status == 413
    asking.close()
    assert search(server)[0] == 200


def test_forms_of_other_kinds_and_charsets_are_refused_before_they_are_read(server: Running) -> None:
    body, kind = form(object=b"solid", scene=SCAN, part="a-" * 50_000)
    for one in (f"{kind}; charset=punycode", f"{kind}; CHARSET*=punycode", "application/x-www-form-urlencoded", ""):
        status, said, _ = server.ask("POST", "/detect", body, {"Content-Type": one})
        assert (status, said["error"]) == (415, "send fields and files as multipart/form-data, without a charset"), one
    assert server.ask("PUT", "/parts/a", b"solid", {"Content-Type": "model/stl"})[0] == 415
    for first, second in ((f"{kind}; charset=punycode", kind), (kind, f"{kind}; charset=punycode")):
        head = "POST /detect HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nContent-Length: 0\r\n"
        twice = f"{head}Content-Type: {first}\r\nContent-Type: {second}\r\n\r\n"
        assert rest(opened(server, twice.encode())).startswith(b"HTTP/1.1 415 ")


def test_bodies_that_wait_are_bounded_together() -> None:
    held, most = 16, 10

    async def run() -> list[int | None]:
        answered = asyncio.Event()

        async def app(scope: Any, receive: Any, send: Any) -> None:
            await receive()
            await answered.wait()

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": bytes(most), "more_body": False}

        async def ask() -> int | None:
            headers = [(b"host", b"localhost"), (b"content-type", b"multipart/form-data; boundary=x")]
            scope = {"type": "http", "method": "POST", "headers": headers}
            try:
                await gate(scope, receive, receive)  # type: ignore[arg-type]  # nothing is sent
            except HTTPException as error:
                return error.status_code
            return None

        gate = Gate(app, ServeConfig(most_bytes=most))
        asked = [asyncio.create_task(ask()) for _ in range(held + 1)]
        done, _ = await asyncio.wait(asked, timeout=20, return_when=asyncio.FIRST_COMPLETED)
        answered.set()
        await asyncio.wait(asked)
        return [*(one.result() for one in [*done, *asked]), await ask()]

    first, *others = asyncio.run(run())
    assert first == 503
    assert others.count(503) == 1  # all are answered, and their places free again
    assert others.count(None) == held + 1


def test_slow_clients_are_given_up_and_others_answered(server: Running) -> None:
    body, kind = form(object=b"solid", scene=SCAN)
    head = f"POST /detect HTTP/1.1\r\nHost: localhost\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n\r\n"
    half_head = opened(server, b"GET /parts HTTP/1.1\r\nHost: loc")
    nothing = opened(server)
    half_body = opened(server, head.encode() + body[: len(body) // 2])
    start = time.monotonic()
    assert search(server)[0] == 200
    for _ in range(20):  # a byte now and then gains no time
        time.sleep(0.05)
        with contextlib.suppress(ConnectionError):
            half_head.sendall(b"a")
    assert rest(half_head) == b""
    assert rest(nothing) == b""
    assert rest(half_body).startswith(b"HTTP/1.1 408 ")
    assert time.monotonic() - start < 10
    # One that does not take its answers is given up, too.
    lazy = opened(server, 2000 * b"GET /openapi.json HTTP/1.1\r\nHost: localhost\r\n\r\n")
    eventually(lambda: bool(server.server.server_state.connections))
    eventually(lambda: not server.server.server_state.connections)
    assert 0 < len(rest(lazy)) < 2000 * 10_000


def test_a_client_that_does_not_take_its_last_answer_is_given_up(tmp_path: Path) -> None:
    with running(tmp_path, QUICK) as server, socket.socket() as lazy:
        size = int(server.ask("GET", "/openapi.json")[2]["Content-Length"])
        server.server.servers[0].sockets[0].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
        lazy.connect(("127.0.0.1", server.port))
        lazy.sendall(b"GET /openapi.json HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        state = server.server.server_state
        eventually(lambda: state.total_requests == 2)
        eventually(lambda: not state.connections)
        assert len(rest(lazy)) < size


def test_many_connections_do_not_keep_a_client_out(server: Running) -> None:
    crowd = []
    for number in range(300):
        with contextlib.suppress(ConnectionError):
            crowd.append(opened(server, b"" if number % 2 else b"POST /detect HTTP/1.1\r\n"))
        if number % 60 == 59:
            assert server.ask("GET", "/parts")[0] == 200
            assert len(server.server.server_state.connections) <= 12
    assert search(server)[0] == 200
    for connection in crowd:
        connection.close()


def test_garbage_is_refused_without_a_traceback(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with running(tmp_path, QUICK) as server:
        for garbage in (
            b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(500),
            b"\x00" * 100 + b"\r\n\r\n",
            b"GET / HTTP/9.9\r\n\r\n",
            b"GET /\xff\xfe HTTP/1.1\r\nHost: localhost\r\n\r\n",
            b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n",
            b"POST /detect HTTP/1.1\r\nHost: localhost\r\nContent-Length: -5\r\n\r\n",
            b"POST /detect HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
            b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"A: " + b"a" * 1_000_000 + b"\r\n\r\n",
        ):
            assert rest(opened(server, garbage)).startswith(b"HTTP/1.1 4"), garbage[:60]
        upgrade = b"GET /detect HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\n"
        assert rest(opened(server, upgrade)).startswith(b"HTTP/1.1 405 ")
        assert search(server)[0] == 200
    assert capsys.readouterr().err == ""


def test_a_full_queue_is_told_and_what_is_in_it_answered(server: Running) -> None:
    server.known.may_answer.clear()
    with ThreadPoolExecutor(2) as threads:
        waiting = [threads.submit(search, server) for _ in range(2)]
        eventually(lambda: server.app.state.service.worker.queued == 2)
        status, said = search(server)
        assert (status, said["error"]) == (503, "2 requests are waiting already: try again later")
        assert int(said["retry-after"]) >= 1
        assert server.ask("GET", "/health")[1]["queued"] == 2
        server.known.may_answer.set()
        assert [one.result()[0] for one in waiting] == [200, 200]
    eventually(lambda: server.app.state.service.worker.queued == 0)


def test_a_client_that_has_gone_is_not_searched_for(server: Running) -> None:
    server.known.may_answer.clear()
    server.known.searching.clear()
    with ThreadPoolExecutor(1) as threads:
        first = threads.submit(search, server)
        assert server.known.searching.wait(20)
        del server.known.asked[:]
        body, kind = form(object=b"solid", scene=SCAN)
        head = (
            f"POST /detect HTTP/1.1\r\nHost: localhost\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        second = opened(server, head.encode() + body)
        eventually(lambda: server.app.state.service.worker.queued == 2)
        second.close()
        eventually(lambda: server.app.state.service.worker.queued == 1)
        server.known.may_answer.set()
        assert first.result()[0] == 200
    assert server.known.asked == []


def test_a_job_that_is_cancelled_is_held_no_longer() -> None:
    class Form:
        pass

    may_end, worker, sent = threading.Event(), Worker(2, 20.0), Form()
    still_there = weakref.ref(sent)
    first = worker.start(may_end.wait)
    second = worker.start(functools.partial(id, sent))
    del sent
    try:
        assert still_there() is not None
        assert second.cancel()
        gc.collect()
        assert still_there() is None
        assert not first.done()
        assert worker.queued == 1
    finally:
        may_end.set()
        worker.close()


def test_a_request_that_takes_too_long_is_given_up(tmp_path: Path) -> None:
    with running(tmp_path, ServeConfig(port=0, time_limit=0.3)) as server:
        server.known.may_answer.clear()
        status, said = search(server)
        assert (status, said["error"]) == (504, "no answer within 0.3 s: try again later, or narrow it down")
        assert server.ask("GET", "/health")[1]["queued"] == 1  # it still runs
        server.known.may_answer.set()
        eventually(lambda: server.app.state.service.worker.queued == 0)


def test_a_server_that_is_stopped_answers_what_is_under_way(tmp_path: Path) -> None:
    with running(tmp_path) as server, ThreadPoolExecutor(2) as threads:
        server.known.may_answer.clear()
        idle = opened(server)
        waiting = [threads.submit(search, server) for _ in range(2)]
        eventually(lambda: server.app.state.service.worker.queued == 2)
        server.server.should_exit = True

        def is_refused() -> bool:
            try:
                opened(server).close()
            except ConnectionError:
                return True
            return False

        eventually(is_refused)
        assert rest(idle) == b""
        assert not any(one.done() for one in waiting)
        server.known.may_answer.set()
        assert [one.result()[0] for one in waiting] == [200, 200]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"most_queued": 0}, "most_queued is 0"),
        ({"time_limit": float("nan")}, "time_limit is nan"),
        ({"allowed_hosts": ("http://a",)}, "must be a name without scheme and port"),
    ],
)
def test_limits_that_are_none_are_refused(given: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ServeConfig(**given)


def test_threads_end_with_their_server(tmp_path: Path) -> None:
    before = set(threading.enumerate())
    with running(tmp_path) as server:
        assert search(server)[0] == 200
    eventually(lambda: set(threading.enumerate()) <= before)
