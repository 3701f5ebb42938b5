"""The server of a page, on this machine only unless another host is named, for those who know the page's address.

The page is viser's, which answers everybody. What stands before it here asks for the token in the page's address, and
refuses other hosts and pages of other sites.
"""

from __future__ import annotations

import contextlib
import http
import io
import logging
import secrets
import threading
from collections.abc import Awaitable, Callable, Iterator
from http.cookies import CookieError, SimpleCookie
from importlib.util import find_spec
from typing import Any
from urllib.parse import parse_qs, urlsplit

from kmn_jax.errors import InputError
from kmn_jax.extras import install_command
from kmn_jax.web import is_allowed_host, is_same_origin, listen

_MOST_BYTES = 1_000_000  # of a message; the page's own are small
_NOT_READABLE = 1007  # of WebSocket's codes
_STARTING = threading.Lock()
_LOG = logging.getLogger("kmn_jax.page")  # where what clients do wrong ends
_LOG.addHandler(logging.NullHandler())
_LOG.propagate = False


class Door:
    """Lets those in who come with the token: in the address at first, in a cookie from then on."""

    def __init__(self, host: str) -> None:
        self._hosts = (host,) if host else ()
        self._cookie = f"kmn_{secrets.token_hex(4)}"  # browsers do not tell the ports of a host apart
        self.token = secrets.token_urlsafe(16)

    def refusal(self, headers: Any, path: str) -> str | None:
        """Tell why a request is refused, None if it is not."""
        try:
            host, origin, cookies = headers.get("Host", ""), headers.get("Origin"), headers.get("Cookie", "")
            tokens = parse_qs(urlsplit(path).query).get("token", [])
        except (LookupError, ValueError):  # one of them is there twice, or the path is none
            return "This request cannot be understood."
        if not is_allowed_host(host, self._hosts):
            return "This page is not served under that name."
        if not is_same_origin(origin, host):
            return "This page is not for pages of other sites."
        given = [one.encode(errors="surrogateescape") for one in (*tokens, self._cookie_in(cookies))]
        if not any(secrets.compare_digest(one, self.token.encode()) for one in given):
            return "Open the whole address that was printed, with its token."
        return None

    @property
    def cookie(self) -> str:
        """What a browser is told to send from then on."""
        return f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _cookie_in(self, header: str) -> str:
        try:
            found = SimpleCookie(header).get(self._cookie)
        except CookieError:
            return ""
        return "" if found is None else found.value


def check_page(host: str, port: int) -> None:
    """Raise InputError if no page can be served there: the port is in use, or viser or matplotlib is not there."""
    listen(host, port).close()
    for package in ("viser", "matplotlib"):
        if find_spec(package) is None:
            raise InputError(f"the page needs packages that are not installed: {install_command(package)}")


def start_server(host: str, port: int) -> tuple[Any, str]:
    """Return a running server, and the token of its page; viser would take another port if this one is in use."""
    check_page(host, port)
    import viser

    door = Door(host)
    with contextlib.redirect_stdout(io.StringIO()), _behind(door) as used:  # our caller says where the page is
        server = viser.ViserServer(host=host, port=port, verbose=False)
    if not used:
        stop_server(server)
        raise InputError("this version of viser cannot be guarded by a token: install another one")
    # The page could ask for a public address by a server elsewhere; scans stay here.
    server.request_share_url = lambda verbose=True: None
    if port not in (0, server.get_port()):
        stop_server(server)
        raise InputError(f"port {port} has just come into use: choose another one, or 0 for any that is free")
    return server, door.token


def stop_server(server: Any) -> None:
    """Stop a server and its threads; pages that are open lose their connection."""
    with contextlib.redirect_stdout(io.StringIO()):  # it says so otherwise
        server.stop()


@contextlib.contextmanager
def _behind(door: Door) -> Iterator[list[Any]]:
    """Let the server that viser starts meanwhile be one behind the door: viser has no setting for it.

    Yields the handlers that stand behind the door, none if viser has found another way.
    """
    import websockets.asyncio.server as servers

    used: list[Any] = []

    def serve(handler: Callable[[Any], Awaitable[None]], *place: Any, **given: Any) -> Any:
        answer = given["process_request"]

        def checked(connection: Any, request: Any) -> Any:
            refusal = door.refusal(request.headers, request.path)
            if refusal is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, refusal + "\n")
            response = answer(connection, request)
            if response is not None:
                response.headers["Set-Cookie"] = door.cookie
            return response

        async def handled(connection: Any) -> None:
            try:
                await handler(connection)
            except Exception as error:
                _LOG.info("a message could not be read", exc_info=error)
                await connection.close(_NOT_READABLE, "a message could not be read")

        limits = {"process_request": checked, "max_size": _MOST_BYTES, "logger": _LOG}
        used.append(handler)
        return plain(handled, *place, **given | limits)

    with _STARTING:
        plain = servers.serve
        servers.serve = serve  # type: ignore[assignment, misc]
        try:
            yield used
        finally:
            servers.serve = plain  # type: ignore[misc]
