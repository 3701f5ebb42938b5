"""A real server on a free port of this machine, with an estimator whose answer is known and whose time is ours."""

from __future__ import annotations

import http.client
import json
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn

from kmn_jax.detection import Detections, PoseEstimator, Scene
from kmn_jax.errors import InputError
from kmn_jax.io import Scan
from kmn_jax.objects import Part
from kmn_jax.released import RELEASED
from kmn_jax.serve import ServeConfig
from kmn_jax.serve._app import make_app
from kmn_jax.serve._parts import PartStore
from kmn_jax.serve._searches import Searches
from kmn_jax.serve._server import uvicorn_config
from tests.detection.box_sample import both_boxes, box_part, box_view

PART = box_part()
VIEW = box_view()
FOUND = both_boxes(PART, VIEW)


@dataclass(frozen=True)
class KnownAnswer(PoseEstimator):
    """Finds both boxes, once it may."""

    model: Any = None
    digest: str = "0"
    probabilities: Any = None
    may_answer: threading.Event = field(default_factory=threading.Event)
    searching: threading.Event = field(default_factory=threading.Event)
    asked: list[dict[str, Any]] = field(default_factory=list)

    def prepare(self, path: Any, unit: str | None = None, name: str | None = None) -> Part:
        if not isinstance(path, Path):  # what a server makes up to warm up
            return PART
        if path.read_bytes() == b"broken":
            raise InputError(f"{path} cannot be used: it is broken")
        return replace(PART, name=path.stem, unit=unit or "m")

    def read(self, path: Path, part: Part, unit: str, camera: Path | None) -> Scan:
        return Scan(np.frombuffer(path.read_bytes(), np.float32).reshape(-1, 3), None, None, None, unit)

    def scene(self, path: Any, part: Part, **given: Any) -> Scene:
        if isinstance(path, Scan):
            return VIEW
        self.asked.append({"content": path.read_bytes(), "folder": path.parent, **given})
        if path.read_bytes() == b"fault":
            raise RuntimeError("a fault of ours")
        return VIEW

    def detect(self, part: Part, scene: Scene, **given: Any) -> Detections:
        self.searching.set()
        assert self.may_answer.wait(30)
        if self.asked:  # not as the server warms up
            self.asked[-1]["config"] = self.config
        return replace(FOUND, poses=FOUND.poses[: given.get("top")])


@dataclass
class Running:
    """A server that runs."""

    port: int
    known: KnownAnswer
    app: Any
    server: uvicorn.Server
    folder: Path

    def ask(
        self, method: str, path: str, body: bytes | None = None, headers: dict[str, str] | None = None
    ) -> tuple[int, Any, Any]:
        """Return status, content (JSON if it is) and headers of an answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        try:
            connection.request(method, path, body, headers or {})
            answer = connection.getresponse()
            content = answer.read()
            is_json = content and answer.headers.get_content_type() == "application/json"
            return answer.status, json.loads(content) if is_json else content, answer.headers
        finally:
            connection.close()

    def send(self, method: str, path: str, **fields: Any) -> tuple[int, Any, Any]:
        """Send a form; bytes are files, which may come with a name."""
        body, kind = form(**fields)
        return self.ask(method, path, body, {"Content-Type": kind})


def form(**fields: Any) -> tuple[bytes, str]:
    """Return a form as multipart/form-data, and its type."""
    boundary, pieces = secrets.token_hex(8), []
    for name, values in fields.items():
        for value in values if isinstance(values, list) else [values]:
            called, content = value if isinstance(value, tuple) else (f"{name}.bin", value)
            file = f'; filename="{called}"' if isinstance(content, bytes) else ""
            head = f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"{file}\r\n\r\n'
            pieces.append(head.encode() + (content if isinstance(content, bytes) else str(content).encode()) + b"\r\n")
    return b"".join([*pieces, f"--{boundary}--\r\n".encode()]), f"multipart/form-data; boundary={boundary}"


def eventually(condition: Callable[[], object], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it has not come true"
        time.sleep(0.01)


@contextmanager
def running(
    folder: Path, config: ServeConfig | None = None, estimator: Any = None, warm_up: Any = None
) -> Iterator[Running]:
    """Run a server in a thread; it answers at once unless `may_answer` is cleared."""
    known = KnownAnswer()
    known.may_answer.set()
    config = config or ServeConfig(port=0)
    app = make_app(Searches(estimator or known, RELEASED, PartStore(config.most_parts, {}), folder), config, warm_up)
    ready = threading.Event()

    class Told(uvicorn.Server):
        async def startup(self, sockets: Any = None) -> None:
            await super().startup(sockets)
            ready.set()

    settings = uvicorn_config(app, config)
    settings.port = 0
    server = Told(settings)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        assert ready.wait(30)
        service = app.state.service
        if warm_up is None:
            eventually(lambda: service.is_ready and service.worker.queued == 0)
        port = server.servers[0].sockets[0].getsockname()[1]
        yield Running(port, known, app, server, folder)
    finally:
        known.may_answer.set()
        server.should_exit = True
        thread.join(30)
    assert not thread.is_alive()


def some_scan() -> bytes:
    return np.arange(30, dtype=np.float32).tobytes()
