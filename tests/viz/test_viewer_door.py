"""Who gets a page and its scan: those with the token, from the page itself; and garbage stops nothing."""

from __future__ import annotations

import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import pytest
import viser
import websockets.sync.client
from websockets.exceptions import ConnectionClosed, InvalidStatus

from kmn_jax.errors import InputError
from kmn_jax.viz import Viewer
from kmn_jax.viz._viewer_server import Door, start_server
from tests.detection.box_sample import both_boxes, box_part, box_view

PART = box_part()


@pytest.fixture(scope="module")
def page() -> Iterator[Viewer]:
    view = box_view()
    with Viewer(view, PART, both_boxes(PART, view), port=0) as one:
        yield one


def place(page: Viewer) -> str:
    return urlsplit(page.url).netloc


def fetched(url: str, **headers: str) -> tuple[int, str, str]:
    """Return status, beginning and cookie of an answer."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=20) as answer:
            return answer.status, answer.read(100).decode(), answer.headers.get("Set-Cookie", "")
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode(), ""


def connected(page: Viewer, origin: str | None, token: str = "", **headers: str) -> Any:
    return websockets.sync.client.connect(
        f"ws://{place(page)}/{token}",
        origin=origin,  # type: ignore[arg-type]
        subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
        additional_headers=headers,
        max_size=None,
        compression=None,
    )


def drain(socket: Any) -> None:
    while True:
        socket.recv(timeout=20)


def test_the_page_asks_for_its_token(page: Viewer) -> None:
    status, content, cookie = fetched(page.url)
    assert status == 200
    assert content.startswith("<!doctype html>")
    assert "HttpOnly; SameSite=Strict" in cookie
    bare = f"http://{place(page)}/"
    assert fetched(bare)[:2] == (403, "Open the whole address that was printed, with its token.\n")
    assert fetched(bare + "?token=other")[0] == 403
    assert fetched(bare, Cookie=cookie.partition(";")[0])[0] == 200
    assert fetched(page.url, Host="evil.example")[:2] == (403, "This page is not served under that name.\n")


def test_a_page_of_another_site_gets_no_scan(page: Viewer) -> None:
    cookie = fetched(page.url)[2].partition(";")[0]
    own = f"http://{place(page)}"
    with connected(page, own, Cookie=cookie) as socket:
        assert len(socket.recv(timeout=20)) > 16
    with connected(page, None, "?" + urlsplit(page.url).query) as socket:  # a program with the whole address
        assert len(socket.recv(timeout=20)) > 16
    for origin, token, headers in (
        ("http://evil.example", "", {"Cookie": cookie}),
        ("http://evil.example", "?" + urlsplit(page.url).query, {}),
        ("null", "", {"Cookie": cookie}),
        ("http://127.0.0.1:1", "", {"Cookie": cookie}),
        (own, "", {}),
        (None, "", {}),
        (own, "", {"Cookie": cookie[:-1]}),
    ):
        with pytest.raises(InvalidStatus) as refused:
            connected(page, origin, token, **headers)
        assert refused.value.response.status_code == 403


@pytest.mark.parametrize("message", [b"garbage", "text", b"", b"\x80", bytes(2_000_000)])
def test_garbage_closes_its_connection_alone(
    page: Viewer, message: bytes | str, capfd: pytest.CaptureFixture[str]
) -> None:
    token = "?" + urlsplit(page.url).query
    with connected(page, None, token) as socket, connected(page, None, token) as other:
        socket.send(message)
        with pytest.raises(ConnectionClosed):
            drain(socket)
        assert other.recv(timeout=20)
    assert capfd.readouterr().err == ""


def test_a_request_that_cannot_be_understood_is_refused() -> None:
    from websockets.datastructures import Headers

    door = Door("127.0.0.1")
    good = [("Host", "127.0.0.1:1"), ("Cookie", door.cookie.partition(";")[0])]
    assert door.refusal(Headers(good), "/") is None
    for wrong in ([*good, ("Host", "127.0.0.1:1")], [good[0], ("Cookie", 'a=";;;=')], [good[1]]):
        assert door.refusal(Headers(wrong), "/")
    assert door.refusal(Headers(good[:1]), f"/?token={door.token}") is None
    for path in ("/?token=%00%ff", "/?token=\udcff", "//["):
        assert door.refusal(Headers(good[:1]), path)
    assert door.refusal(Headers(good), "//[")
    assert door.token not in repr(door)


def test_a_page_that_the_door_does_not_guard_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped = []

    class Unguarded:
        def __init__(self, **_: object) -> None:
            pass

        def stop(self) -> None:
            stopped.append(self)

    monkeypatch.setattr(viser, "ViserServer", Unguarded)
    with pytest.raises(InputError, match="cannot be guarded by a token"):
        start_server("127.0.0.1", 0)
    assert len(stopped) == 1


@pytest.mark.parametrize("package", ["viser", "matplotlib"])
def test_without_a_package_a_command_that_installs_it_is_named(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"needs packages that are not installed: pip install .*{package}"):
        start_server("127.0.0.1", 0)
