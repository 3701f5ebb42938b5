"""What a server allows: where it listens, how much it takes, and how long it waits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from kmn_jax.errors import require

MEGABYTE = 1_000_000
Units = Literal["auto", "mm", "cm", "m", "in"]  # that requests may say


@dataclass(frozen=True)
class ServeConfig:
    """Limits of a server; times are in seconds."""

    host: str = "127.0.0.1"
    port: int = 8000
    allowed_hosts: tuple[str, ...] = ()  # names that requests may call this machine by; addresses they always may
    most_bytes: int = 100 * MEGABYTE  # of a request's body
    most_queued: int = 16  # searches and preparations that wait or run
    time_limit: float = 120.0  # from the end of a request's body to its answer
    most_parts: int = 64  # that are kept by name; as many again are remembered of those sent with a scan
    most_connections: int = 256  # beyond, the one that has kept the server waiting longest is closed
    head_limit: float = 10.0  # for a request's head, from the connection or the answer before
    body_limit: float = 60.0  # for a request's body
    write_limit: float = 30.0  # in which a client has to take an answer that does not fit the connection's buffer

    def __post_init__(self) -> None:
        for name in ("most_bytes", "most_queued", "most_parts", "most_connections"):
            require(getattr(self, name) >= 1, f"{name} is {getattr(self, name)}, but must be at least 1")
        for name in ("time_limit", "head_limit", "body_limit", "write_limit"):
            value = getattr(self, name)
            require(0 < value < math.inf, f"{name} is {value}, but must be above zero and finite")
        for name in self.allowed_hosts:
            require(
                bool(name) and not set(name) & set("/: \t"), f"host {name!r} must be a name without scheme and port"
            )
