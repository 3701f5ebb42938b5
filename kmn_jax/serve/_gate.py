"""What stands before all requests: whom they are for, where they come from, how large they are, how long they take."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from starlette.exceptions import HTTPException

from kmn_jax.serve._settings import MEGABYTE, ServeConfig
from kmn_jax.web import is_allowed_host, is_same_origin

AsgiScope: TypeAlias = MutableMapping[str, Any]
Receive: TypeAlias = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send: TypeAlias = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Asgi: TypeAlias = Callable[[AsgiScope, Receive, Send], Awaitable[None]]

_MOST_HELD = 16  # bodies of the largest size, together
_LATER = {"Retry-After": "5"}


class Gate:
    """Refuses requests for other hosts and from other pages, and bodies that are too large or too slow."""

    def __init__(self, app: Asgi, config: ServeConfig) -> None:
        self._app, self._config = app, config
        self._held = 0  # bytes of bodies whose requests are not answered yet

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it with an error."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers: dict[str, str] = {}
        for name, value in scope["headers"]:  # what is there twice is checked as a whole
            earlier = headers.get(name.decode("latin-1"))
            headers[name.decode("latin-1")] = ", ".join(filter(None, (earlier, value.decode("latin-1"))))
        refusal = self._refusal(scope["method"], headers)
        if refusal is not None:
            await _answer(send, *refusal)
            return
        body = _Body(receive, asyncio.get_running_loop().time() + self._config.body_limit)
        try:
            await self._app(scope, lambda: self._next_piece(body), send)
        finally:
            self._held -= body.size

    def _refusal(self, method: str, headers: dict[str, str]) -> tuple[int, str] | None:
        host = headers.get("host", "")
        if not is_allowed_host(host, self._config.allowed_hosts):
            return (
                421,
                f"this server does not answer for the host {host[:80]!r}: start it with --allow-host to allow it",
            )
        if not is_same_origin(headers.get("origin"), host):
            return 403, "this server does not answer pages of other sites"
        # Forms of other kinds are not asked for, and decoding by a client's charset can take minutes.
        kind = headers.get("content-type", "").lower()
        if method in ("POST", "PUT") and (not kind.startswith("multipart/form-data") or "charset" in kind):
            return 415, "send fields and files as multipart/form-data, without a charset"
        length = headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > self._config.most_bytes:
            return 413, self._too_large
        return None

    @property
    def _too_large(self) -> str:
        return (
            f"the request is larger than {self._config.most_bytes / MEGABYTE:g} MB: send less, or start the server with"
            " a larger --max-megabytes"
        )

    async def _next_piece(self, body: _Body) -> MutableMapping[str, Any]:
        """Return the next piece of a body, or raise HTTPException when it is too large or takes too long."""
        if body.is_whole:
            return await body.receive()  # that the client is gone
        try:
            async with asyncio.timeout_at(body.end):
                message = await body.receive()
        except TimeoutError:
            raise HTTPException(408, f"the request took longer than {self._config.body_limit:g} s") from None
        size = len(message.get("body", b""))
        body.size += size
        self._held += size
        if body.size > self._config.most_bytes:
            raise HTTPException(413, self._too_large)
        if self._held > _MOST_HELD * self._config.most_bytes:
            raise HTTPException(503, "other requests are as much as the server can hold: try again later", _LATER)
        body.is_whole = not message.get("more_body", False)
        return message


@dataclass
class _Body:
    """How much of a request's body has come."""

    receive: Receive
    end: float  # when the rest must have come
    size: int = 0
    is_whole: bool = False


async def _answer(send: Send, status: int, sentence: str) -> None:
    content = json.dumps({"error": sentence}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(content)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": content})
