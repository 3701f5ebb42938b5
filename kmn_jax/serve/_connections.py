"""Connections whose clients may not keep the server waiting, of which there are only so many."""

from __future__ import annotations

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from kmn_jax.serve._settings import ServeConfig

_AFTER_REFUSAL = 1.0  # s after the body's limit: its end is answered before the connection is closed


class BoundedConnection(H11Protocol):
    """An HTTP connection that is closed when its client is too slow to send a request, or to take an answer.

    If there are too many of them, the one that has been waited for longest makes room for the newest.
    """

    def __init__(self, limits: ServeConfig, **given: Any) -> None:
        super().__init__(**given)
        self._limits = {
            "head": limits.head_limit,
            "body": limits.body_limit + _AFTER_REFUSAL,
            "write": limits.write_limit,
        }
        self._most = limits.most_connections
        self._awaited: str | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._is_writing_paused = False
        self.waits_since: float | None = None  # for the client; None while the server is at work

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a request, in the place of another connection if there are too many."""
        super().connection_made(transport)
        self._watch()
        if len(self.connections) > self._most:
            others = [one for one in self.connections if one is not self and isinstance(one, BoundedConnection)]
            waiting = [(one.waits_since, one) for one in others if one.waits_since is not None]
            longest = min(waiting, key=lambda pair: pair[0], default=(0.0, self))[1]
            longest.drop()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no longer."""
        super().connection_lost(exc)
        self._wait_for(None)

    def data_received(self, data: bytes) -> None:
        """Take what the client sent."""
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._watch()

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP, instead of the request that it is the rest of."""
        if self.conn.our_state not in (h11.IDLE, h11.SEND_RESPONSE):
            self.drop()
            return
        if self.cycle is not None:
            self.cycle.disconnected = True
        super().send_400_response(msg)

    def pause_writing(self) -> None:
        """Wait for the client to take what is sent."""
        super().pause_writing()
        self._is_writing_paused = True
        self._watch()

    def resume_writing(self) -> None:
        """Go on sending."""
        super().resume_writing()
        self._is_writing_paused = False
        self._watch()

    def drop(self) -> None:
        """Close the connection at once, whatever is still to be sent."""
        self._wait_for(None)
        self.connections.discard(self)
        self.transport.abort()

    def _watch(self) -> None:
        """Look what the client is waited for; a client that sends a little of it is given no more time."""
        awaited = None
        if self not in self.connections:
            pass
        elif self._is_writing_paused or self.transport.is_closing():
            awaited = "write"
        elif self.conn.their_state is h11.SEND_BODY:
            awaited = "body"
        elif self.conn.their_state is h11.IDLE:
            awaited = "head"
        if awaited != self._awaited:
            self._wait_for(awaited)

    def _wait_for(self, awaited: str | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._awaited, self._timer, self.waits_since = awaited, None, None
        if awaited is not None:
            self.waits_since = self.loop.time()
            self._timer = self.loop.call_later(self._limits[awaited], self.drop)
