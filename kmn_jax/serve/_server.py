"""A server process: its parts, its socket, its private folder, and its end."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import math
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from kmn_jax.detection import PoseEstimator
from kmn_jax.errors import InputError, require
from kmn_jax.io import CLOUD_SUFFIXES, MESH_SUFFIXES, Scan
from kmn_jax.objects import CARD_SUFFIX, Part
from kmn_jax.released import RELEASED
from kmn_jax.serve._folder import private_folder
from kmn_jax.serve._parts import PartStore, check_name
from kmn_jax.serve._settings import ServeConfig
from kmn_jax.serve._warm_up import PLACE, bracket, brackets_on_a_floor
from kmn_jax.web import address, listen

_PART_SUFFIXES = tuple(dict.fromkeys((*MESH_SUFFIXES, *CLOUD_SUFFIXES, CARD_SUFFIX)))
_AFTER_LIMITS = 10.0  # s that answers are waited for once all limits have passed


def serve(
    config: ServeConfig,
    weights: str = RELEASED,
    parts: Path | None = None,
    example: Path | None = None,
    camera: Path | None = None,
    started: Callable[[str], None] = lambda url: None,
    told: Callable[[str], None] = lambda line: None,
) -> None:
    """Answer requests until SIGTERM or SIGINT, then those that are under way, and return.

    Parts of a folder are prepared before; `started` is told the address. While an example scan, or else one that is
    made up, is searched for the first part, which compiles everything, the server answers that it is not ready. After
    the address, `told` gets a line for each part that may not be what its user thinks, one when the server is ready,
    and one when it stops. Raises InputError if a part or the example cannot be used, or if the port is in use.
    """
    import uvicorn

    from kmn_jax.serve._app import make_app
    from kmn_jax.serve._searches import Searches

    require(camera is None or example is not None, "the camera is that of an example scan: name this, too (--example)")
    listening = listen(config.host, config.port)
    with contextlib.closing(listening), private_folder() as folder:
        estimator = PoseEstimator.from_pretrained(weights)
        notes: list[str] = []
        named = {} if parts is None else _prepared(estimator, parts, config.most_parts, notes.append)
        store = PartStore(config.most_parts, named)
        scan: Scan | None = None
        if example is not None:
            if not named:
                raise InputError("an example scan needs the parts that are to be found in it: name their folder, too")
            scan = estimator.read(example, next(iter(named.values())), None, camera)
        stopping: list[Any] = []
        failures: list[Exception] = []

        def warm_up() -> None:
            try:
                search_all(estimator, next(iter(named.values()), None), scan)
            except Exception as error:
                failures.append(error)
                stopping[0].should_exit = True
                raise

        def tell_later(line: str) -> None:
            with contextlib.suppress(InputError):  # what cannot be printed is no reason to leave a request unanswered
                told(line)

        def ready() -> None:
            if not stopping[0].should_exit:
                tell_later("ready: all that searches need is compiled")

        def stop() -> None:
            if not failures:
                tell_later("stopping: answering what is in flight")

        app = make_app(Searches(estimator, weights, store, folder), config, warm_up, ready)
        server = stoppable(uvicorn.Server(uvicorn_config(app, config)), stop)
        stopping.append(server)
        started(address(config.host, listening.getsockname()[1]))
        for note in notes:
            told(note)
        server.run(sockets=[listening])
    if failures:
        raise failures[0]


def uvicorn_config(app: Any, config: ServeConfig) -> Any:
    """Return uvicorn's settings for an application."""
    import uvicorn

    from kmn_jax.serve._connections import BoundedConnection

    log = logging.getLogger("uvicorn")
    log.propagate = False
    if logging.lastResort is not None:
        log.addHandler(logging.lastResort)  # what stderr is at the time
    return uvicorn.Config(
        app,
        http=functools.partial(BoundedConnection, config),  # type: ignore[arg-type]
        ws="none",
        loop="asyncio",
        log_config=None,  # uvicorn's own would end all handlers that the process has
        log_level="error",  # what clients do wrong is no news
        access_log=False,
        proxy_headers=False,
        server_header=False,
        timeout_keep_alive=math.ceil(config.head_limit),
        timeout_graceful_shutdown=int(config.body_limit + config.time_limit + _AFTER_LIMITS),
    )


def stoppable(server: Any, stop: Callable[[], None] = lambda: None) -> Any:
    """Return a uvicorn server that SIGTERM and SIGINT end as if it had nothing more to do: its own dies of them.

    `stop` is called before it ends, outside of the signals' handlers, which may not print.
    """
    shutdown = server.shutdown

    @contextlib.contextmanager
    def handled() -> Iterator[None]:
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        signals = (signal.SIGINT, signal.SIGTERM)
        before = {number: signal.signal(number, server.handle_exit) for number in signals}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    async def shut_down(sockets: Any = None) -> None:
        stop()
        await shutdown(sockets)

    server.capture_signals, server.shutdown = handled, shut_down
    return server


def search_all(estimator: PoseEstimator, part: Part | None, scan: Scan | None) -> None:
    """Search a whole scan, one place of it, and draw it: so everything is compiled and imported that requests need."""
    from kmn_jax.viz import save_picture

    made_up = part is None or scan is None
    used = estimator.prepare(bracket(), "mm", "bracket") if part is None or scan is None else part
    scene = estimator.scene(brackets_on_a_floor() if scan is None else scan, used)
    found = estimator.detect(used, scene)
    place = np.array(PLACE) if made_up else found.poses[0].seed if found.poses else None
    if place is not None:
        estimator.detect(used, scene, at=place)
    with tempfile.TemporaryDirectory() as folder:
        save_picture(Path(folder, "picture.png"), scene, used, found)


def _prepared(
    estimator: PoseEstimator, folder: Path, most: int, told: Callable[[str], None] = lambda line: None
) -> dict[str, Part]:
    """Return the parts of a folder's files by their names; where a card lies beside a CAD file, the card's.

    `told` gets a line for each card that was not made from the file beside it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: name one that holds CAD files or cards")
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in _PART_SUFFIXES)
    if not files:
        raise InputError(f"{folder} holds no part: put CAD files or cards into it ({', '.join(_PART_SUFFIXES)})")
    cards: dict[str, Path] = {}
    sources: dict[str, Path] = {}
    for path in files:
        alike = cards if path.suffix.lower() == CARD_SUFFIX else sources
        if path.stem in alike:
            other = alike[path.stem].name
            raise InputError(f"{folder} holds two files for the part {path.stem}, {other} and {path.name}: remove one")
        alike[path.stem] = path
    used = sources | cards
    if len(used) > most:
        raise InputError(f"{folder} holds {len(used)} parts, but at most {most} are kept: leave some out")
    named: dict[str, Part] = {}
    for name, path in sorted(used.items()):
        part = named[check_name(name)] = estimator.prepare(path)
        source = sources.get(name, path)
        if source != path and part.source_digest != _digest(source):
            told(f"the part {name} is that of {path.name}, which was not made from {source.name} as it is now")
    return named


def _digest(path: Path) -> str | None:
    """Return a file's SHA-256, or nothing if it cannot be read."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
    return None
