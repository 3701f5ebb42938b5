"""What is counted, for Prometheus."""

from __future__ import annotations

import time
from collections.abc import Callable, MutableMapping
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, generate_latest

from kmn_jax.serve._gate import Asgi, AsgiScope, Receive, Send

_SECONDS = (0.01, 0.03, 0.1, 0.3, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 30.0, 100.0)
_METHODS = ("GET", "PUT", "POST", "DELETE")
_NO_ANSWER = "499"  # the client was gone before


class Metrics:
    """Counters of one server."""

    def __init__(self, queued: Callable[[], int], parts: Callable[[], int]) -> None:
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        of_request = ("method", "route")
        self._requests = Counter(
            "kmn_requests", "Requests that were answered", (*of_request, "status"), registry=self._registry
        )
        self._seconds = Histogram(
            "kmn_request_seconds", "From head to answer", of_request, buckets=_SECONDS, registry=self._registry
        )
        self.search_seconds = Histogram(
            "kmn_search_seconds", "Searches alone", buckets=_SECONDS, registry=self._registry
        )
        self.poses = Counter("kmn_poses", "Poses that were found", registry=self._registry)
        for name, text, value in (("queue_length", "Requests that wait or run", queued), ("parts", "Parts", parts)):
            gauge = Gauge(f"kmn_{name}", text, registry=self._registry)
            gauge.set_function(value)

    def text(self) -> bytes:
        """Return all values in Prometheus's format."""
        return generate_latest(self._registry)

    def around(self, app: Asgi) -> Asgi:
        """Return an application whose requests are counted."""

        async def counted(scope: AsgiScope, receive: Receive, send: Send) -> None:
            if scope["type"] != "http":
                await app(scope, receive, send)
                return
            start, status = time.perf_counter(), _NO_ANSWER

            async def sent(message: MutableMapping[str, Any]) -> None:
                nonlocal status
                if message["type"] == "http.response.start":
                    status = str(message["status"])
                await send(message)

            try:
                await app(scope, receive, sent)
            finally:
                # What clients make up, as paths and methods, must not make counters.
                route = getattr(scope.get("route"), "path", "other")
                method = scope["method"] if route != "other" and scope["method"] in _METHODS else "other"
                self._requests.labels(method, route, status).inc()
                self._seconds.labels(method, route).observe(time.perf_counter() - start)

        return counted
