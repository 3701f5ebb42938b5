"""Programs that are kept for the next process: compiled, and, before that, traced.

JAX's cache keeps what XLA makes of a program. To find it there, a process must trace the program first, which takes
several times as long as reading what was found. Programs that are marked as `kept` are exported as well, into a folder
beside that cache; another process reads them in the background, while it reads its input. Where nothing
asked for a folder, as in a library or in tests, a kept program is what `jax.jit` returns, compiled as quickly.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import os
import shutil
import signal
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, cached_property, update_wrapper
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar, cast

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jax import export
from jax.extend.core import get_opaque_trace_state

from kmn_jax.files import write_whole

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
_MOST = 24  # programs of a folder that are kept
_FOLDERS = 2  # of programs: of this version of the package, and of the one that was used before
_DIGEST = 32  # bytes
_GRACE = 1.0  # seconds that an interrupted process has to end of its own accord
_PROCESS = 60.0  # seconds: what was used within so many was used by one process
# Halves the time of compiling; programs are as fast, and round otherwise.
_QUICK: dict[str, str | bool] = {"xla_cpu_use_fusion_emitters": False}
_store: _Store | None = None
_begun: set[Any] = set()  # what was done in the background
_OUTSIDE = get_opaque_trace_state(convention="nnx")  # of all traces, as Flax tells it


def keep_compiled() -> None:
    """Keep programs between processes, in the user's cache, or where JAX_COMPILATION_CACHE_DIR says.

    Without a home, or with one that cannot be written to, nothing is kept. What cannot be read from, or written to, a
    folder that is named is compiled without a word: JAX would warn for each program.
    """
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        with contextlib.suppress(OSError, RuntimeError):
            folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "kmn_jax"
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK):
                jax.config.update("jax_compilation_cache_dir", str(folder))
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    chosen = jax.config.values["jax_compilation_cache_dir"]
    if chosen:
        keep_programs(Path(chosen) / "programs")


def call_in_place() -> None:
    """Let programs on CPUs run in the thread that calls them, not in one of XLA's: call it before JAX is used.

    Searches call many small ones from two threads, which then wait for each other less. Programs for accelerators, or
    of several devices, run as before.
    """
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def keep_programs(folder: Path | None) -> None:
    """Keep programs in a folder from now on, where `read_kept` finds those of before; None: keep none."""
    global _store
    _store = None
    if folder is not None:
        with contextlib.suppress(OSError):
            _store = _Store(folder)


def kept_folder() -> Path | None:
    """Return the folder in which this version of the package keeps things, if it does."""
    return None if _store is None else _store.folder


def compiled_size(count: int) -> int:
    """Return the power of two that so many rows are filled up to, so that few numbers of them are ever compiled for."""
    return 1 << max(count - 1, 0).bit_length()


def read_kept() -> None:
    """Begin to read what is kept, if anything is; call it once the modules are imported whose programs these are."""
    if _store is not None:
        _store.begin()


@contextlib.contextmanager
def ended_by_interrupt() -> Iterator[None]:
    """Let Ctrl+C end the process soon, also while it compiles; its exit status is then 130, too.

    Python would take notice when compiling has ended, and then wait for threads that still compile. Where interrupts
    are ignored, as by what a script has put into the background, and in other threads than the first, it does nothing.
    """
    is_first = threading.current_thread() is threading.main_thread()
    if not is_first or signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        yield
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_end_when_interrupted, args=(reader,), daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        writer.close()  # with which the thread ends


def _end_when_interrupted(signals: socket.socket) -> None:
    with signals:
        while number := signals.recv(1):
            if number[0] == signal.SIGINT:
                time.sleep(_GRACE)  # in which Python mostly ends it, and what is being written is finished
                os._exit(128 + signal.SIGINT)


def meanwhile(work: Callable[..., object], *args: Any) -> None:
    """Call what will be asked for later in the background, in a process that found nothing kept: compiling takes long.

    That is done once for arguments of the same shapes. Whatever goes wrong goes wrong later on as well, where it is
    told. A process that ends before waits for it.
    """
    leaves, tree = jax.tree.flatten(args)
    like = (work, tree, *((leaf.shape, leaf.dtype) if _is_array(leaf) else leaf for leaf in leaves))
    if like not in _begun and (_store is None or not _store.read):
        _begun.add(like)
        pool = ThreadPoolExecutor(1, thread_name_prefix="programs")
        pool.submit(work, *args)
        pool.shutdown(wait=False)


def kept(
    *static: str, results: tuple[type, ...] = ()
) -> Callable[[Callable[_Arguments, _Result]], KeptProgram[_Arguments, _Result]]:
    """Return what compiles a function as `jax.jit` does, and keeps it.

    Args:
        static: names of arguments that are no arrays; their `repr` must say all about them.
        results: the named tuples among what the function returns.
    """
    return lambda function: KeptProgram(function, static, results)


class KeptProgram(Generic[_Arguments, _Result]):
    """A compiled function; see `kept`."""

    def __init__(self, function: Callable[_Arguments, _Result], static: tuple[str, ...], results: tuple[type, ...]):
        update_wrapper(self, function)
        self.traced = jax.jit(function, static_argnames=static)  # as a part of another program
        self.function, self.static = function, static
        self.signature = inspect.signature(function)
        for result in results:
            with contextlib.suppress(ValueError):  # another program returns it, too
                export.register_namedtuple_serialization(result, serialized_name=f"kmn_jax.{result.__name__}")

    @property
    def is_to_be_made(self) -> bool:
        """Tell, after `read_kept`, whether it is to be kept, but was not: then it has to be compiled."""
        return _store is not None and not any(name.startswith(f"{self.function.__name__}-") for name in _store.read)

    @cached_property
    def compiled(self) -> Callable[_Arguments, _Result]:
        """What is called where nothing is kept."""
        return jax.jit(self.function, static_argnames=self.static, compiler_options=_options())

    def __call__(self, *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        """Call it; inside of a trace, and where nothing is kept, as `jax.jit` would."""
        if get_opaque_trace_state(convention="nnx") != _OUTSIDE:
            return self.traced(*args, **kwargs)
        if _store is None:
            return self.compiled(*args, **kwargs)
        bound = self.signature.bind(*args, **kwargs)
        bound.apply_defaults()
        fixed = {name: bound.arguments.pop(name) for name in self.static}
        leaves, tree = jax.tree.flatten(bound.arguments)
        if not all(map(_is_array, leaves)):
            return self.compiled(*args, **kwargs)
        shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        program = _store.program(self, fixed, tree, shapes, leaves)
        return cast(_Result, program(*leaves)) if program else self.compiled(*args, **kwargs)


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


def _options() -> dict[str, str | bool] | None:
    """Return how the compiler of the devices that are used is asked to be quick; None if it does not know how."""
    return _QUICK if jax.default_backend() == "cpu" and _are_known(tuple(_QUICK.items())) else None


@cache
def _are_known(options: tuple[tuple[str, str | bool], ...]) -> bool:
    """Tell whether this version's compiler for CPUs has some options."""
    try:
        jax.jit(jnp.negative).lower(0.0).compile(compiler_options=dict(options))
    except jax.errors.JaxRuntimeError:
        return False
    return True


class _Store:
    """A folder of exported programs, and those of them that this process has compiled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / _version()
        self.folder.mkdir(parents=True, exist_ok=True)
        os.utime(self.folder)
        _forget_old(folder)
        self.programs: dict[Any, Future[Callable[..., Any] | None]] = {}
        self.lock = threading.Lock()
        self.read: dict[str, Future[Any]] = {}

    def begin(self) -> None:
        """Begin to read all programs, unless that was done: those of the last process first, as it used them."""
        if self.read:
            return
        files = self._files()
        last = [path for path in files if _last_used(path) > _last_used(files[0]) - _PROCESS]
        files = [*reversed(last), *files[len(last) :]]
        pool = ThreadPoolExecutor(2, thread_name_prefix="programs")
        self.read = {path.name: pool.submit(_read, path) for path in files[:_MOST]}
        pool.shutdown(wait=False)

    def program(
        self, of: KeptProgram[Any, Any], fixed: dict[str, Any], tree: Any, shapes: Any, leaves: list[Any]
    ) -> Callable[..., Any] | None:
        """Return the program for arguments like these; None if it cannot be exported."""
        key = (of.function, *fixed.values(), tree, shapes)
        with self.lock:  # of two threads that ask for the same program, one makes it
            found = self.programs.get(key)
            made: Future[Callable[..., Any] | None] = Future()
            if found is None:
                self.programs[key] = made
        if found is not None:
            return found.result()
        try:
            text = "\n".join(map(repr, (*fixed.items(), tree, shapes)))
            name = f"{of.function.__name__}-{hashlib.sha256(text.encode()).hexdigest()[:32]}.export"
            read = self.read.get(name)
            program = read and read.result()
            if program:
                with contextlib.suppress(OSError):
                    os.utime(self.folder / name)
            made.set_result(program or self._make(name, of, fixed, tree, leaves))
        except BaseException as error:
            made.set_exception(error)
            raise
        return made.result()

    def _make(
        self, name: str, of: KeptProgram[Any, Any], fixed: dict[str, Any], tree: Any, leaves: list[Any]
    ) -> Callable[..., Any] | None:
        def flat(*leaves: Any) -> Any:
            return of.function(**jax.tree.unflatten(tree, leaves), **fixed)

        try:
            exported = export.export(jax.jit(flat))(*leaves)
            content = bytes(exported.serialize())
        except (NotImplementedError, ValueError):  # what JAX says of programs that cannot be exported
            return None
        with contextlib.suppress(OSError):
            for unused in self._files()[_MOST - 1 :]:
                unused.unlink(missing_ok=True)
            write_whole(self.folder / name, hashlib.sha256(content).digest() + content)
        return _compiled(exported)

    def _files(self) -> list[Path]:
        """Return what is kept, what was used last first."""
        return sorted(self.folder.glob("*.export"), key=_last_used, reverse=True)


def _last_used(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # another process has removed it
        return 0.0


def _read(path: Path) -> Callable[..., Any] | None:
    """Return the program in a file, compiled; None if it is damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    if hashlib.sha256(content[_DIGEST:]).digest() != content[:_DIGEST]:
        return None
    return _compiled(export.deserialize(bytearray(content[_DIGEST:])))


def _compiled(exported: export.Exported) -> Callable[..., Any]:
    like = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in exported.in_avals]
    return jax.jit(exported.call).lower(*like).compile(compiler_options=_options())


def _version() -> str:
    """Return a digest of what programs depend on beside their arguments: this package's source, JAX, and the device."""
    digest = hashlib.sha256()
    package = Path(__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    settings = [jax.config.values[name] for name in ("jax_enable_x64", "jax_default_matmul_precision")]
    facts = (jax.__version__, jaxlib.__version__, jax.default_backend(), *settings, os.environ.get("XLA_FLAGS"))
    digest.update(repr(facts).encode())
    return digest.hexdigest()[:32]


def _forget_old(folder: Path) -> None:
    """Remove what versions that were not used lately have left."""
    folders = sorted((path for path in folder.iterdir() if path.is_dir()), key=_last_used, reverse=True)
    for old in folders[_FOLDERS:]:
        shutil.rmtree(old, ignore_errors=True)
