"""Settings that hold under pytest only: run-time shape checks and no silent promotion."""

from __future__ import annotations

import gc
import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path

from tests.reference.compiled import kept_programs, quick_flags
from tests.reference.order import is_optimised, place

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the workers have all cores: more threads wait for each other
if os.environ["JAX_PLATFORMS"] == "cpu":
    os.environ["XLA_FLAGS"] = quick_flags()

# Compiling is most of what tests take: what a run, a worker or a command of a test has compiled is read by the next.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = kept_programs()
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.02"

import jax
import pytest
from jaxtyping import install_import_hook

install_import_hook("kmn_jax", "beartype.beartype")

_MEMORY_MAPS = Path("/proc/self/maps")
_MANY_MAPS = 20_000
_FEW = "jax_disable_most_optimizations"

# Tracing makes a great many objects that stay: looking through all of them is a twentieth of the time. So that is left
# to `_forget`.
gc.set_threshold(200_000, 20, 50)

# A product of float32 and an accidental float64 or int32 array, or a (n,) added to a (n, 3), is a bug here.
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(autouse=True, scope="session")
def trace_what_is_tested() -> Iterator[None]:
    """Let commands that are called by tests keep no traced programs: they are those of the code as it is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kmn_jax.programs.keep_programs", lambda folder: None)
        yield


@pytest.fixture(autouse=True, scope="module")
def make_each_object_once(request: pytest.FixtureRequest) -> Iterator[None]:
    """Keep surfaces and models of a few objects for what asks for them again, but where these are what is tested."""
    from tests.reference.objects import kept_model, kept_surface

    with pytest.MonkeyPatch.context() as patch:
        if request.path.parent.name != "objects":
            patch.setattr("kmn_jax.objects._object_model.outer_surface", kept_surface)
            patch.setattr("kmn_jax.objects._object_model._model", kept_model)
        yield


@pytest.fixture(autouse=True, scope="module")
def compile_as_the_file_runs(request: pytest.FixtureRequest) -> Iterator[None]:
    """Compile in half of the time what runs for moments only: programs are slower, and round otherwise.

    Caches are not asked how a program was compiled, so all is forgotten where that changes; also before programs take
    all the memory maps that Linux allows a process (65,530).
    """
    few = not is_optimised(request.path)
    if few != jax.config.values[_FEW]:
        _forget()
        jax.config.update(_FEW, few)
    yield
    if _MEMORY_MAPS.exists() and _MEMORY_MAPS.read_bytes().count(b"\n") > _MANY_MAPS:
        _forget()


@pytest.fixture
def all_optimisations() -> Iterator[None]:
    """Compile with what else is left out in this file: without, each use of a value may be rounded otherwise."""
    few = jax.config.values[_FEW]
    jax.config.update(_FEW, False)
    yield
    jax.config.update(_FEW, few)


def _forget() -> None:
    jax.clear_caches()
    gc.collect()  # what programs are in may be in cycles


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: place(item.path))
    has_torch = importlib.util.find_spec("torch") is not None
    for item in items:
        if item.get_closest_marker("torch") and not has_torch:
            item.add_marker(pytest.mark.skip(reason="torch is not installed: run `make bench-env`"))
        if item.get_closest_marker("gpu") and jax.default_backend() == "cpu":
            item.add_marker(pytest.mark.skip(reason="no accelerator: run with JAX_PLATFORMS set to it"))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print what passing tests measured and recorded with `record_property`."""
    for report in terminalreporter.getreports("passed"):
        for name, value in report.user_properties:
            terminalreporter.write_line(f"{report.nodeid}: {name} {value}")
