"""Programs and parts that are kept for the next process: the same results, without tracing; damage is no failure."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from kmn_jax import programs
from kmn_jax.detection import PoseEstimator, prepare_kept
from kmn_jax.errors import InputError
from kmn_jax.programs import KeptProgram, ended_by_interrupt, keep_programs, kept, kept_folder, read_kept

INDUSTRIAL = Path(__file__).parents[1] / "experiments" / "assets" / "industrial"


class Pair(NamedTuple):
    """A result of two arrays."""

    total: Array
    scaled: Array


def counted() -> tuple[KeptProgram[..., Pair], list[int]]:
    """Return a program and the list of its traces."""
    traces: list[int] = []

    def scaled_sum(values: Pair, key: Array, factor: float) -> Pair:
        traces.append(1)
        return Pair(values.total.sum(), values.scaled * factor + jax.random.uniform(key))

    return kept("factor", results=(Pair,))(scaled_sum), traces


def given(size: int = 3) -> tuple[Pair, Array]:
    return Pair(jnp.arange(float(size)), jnp.ones(2)), jax.random.key(1)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    keep_programs(tmp_path)
    yield tmp_path
    keep_programs(None)


def next_process(folder: Path) -> None:
    """Forget what this process has compiled, and read what is kept."""
    keep_programs(folder)
    read_kept()


def files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*/*.export"))


def test_another_process_gets_the_same_without_tracing(folder: Path) -> None:
    program, traces = counted()
    first = program(*given(), factor=2.0)
    assert sum(traces) == 1
    next_process(folder)
    again, traces = counted()
    second = again(*given(), factor=2.0)
    assert not traces
    assert isinstance(second, Pair)
    keep_programs(None)
    plain = again(*given(), factor=2.0)
    for result in (first, second):
        jax.tree.map(np.testing.assert_array_equal, result, plain)


def test_a_version_without_the_compilers_options_compiles_without_them(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = counted()[0](*given(), factor=2.0)
    next_process(folder / "other")
    monkeypatch.setattr(programs, "_QUICK", {"xla_cpu_of_another_version": True})
    jax.tree.map(np.testing.assert_allclose, counted()[0](*given(), factor=2.0), plain)
    assert files(folder / "other")


def test_where_nothing_is_kept_it_is_compiled_as_quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    real = jax.jit

    def jit(function: Any, **settings: Any) -> Any:
        asked.append(settings.get("compiler_options"))
        return real(function, **settings)

    program, traces = counted()
    monkeypatch.setattr(programs.jax, "jit", jit)
    assert float(program(*given(), factor=2.0).total) == 3
    assert program(*given(), factor=2.0).total == 3
    assert sum(traces) == 1
    assert asked[-1] == programs._QUICK
    monkeypatch.setattr(programs, "_QUICK", {"xla_cpu_of_another_version": True})
    assert counted()[0](*given(), factor=2.0).total == 3
    assert asked[-1] is None


def test_in_a_trace_arguments_may_be_known() -> None:
    program, _ = counted()
    values, key = given()
    with jax.ensure_compile_time_eval():
        known = Pair(values.total + 0, values.scaled + 0)

    def doubled(factor: Array) -> Array:
        return program(known, key, factor=2.0).total * factor

    assert program(known, key, factor=2.0).total == 3
    for result in (
        jax.jit(doubled)(2.0),
        jax.vmap(doubled)(jnp.full(1, 2.0))[0],
        jax.lax.scan(lambda total, factor: (total + doubled(factor), None), jnp.float32(0), jnp.ones(2))[0],
        jax.value_and_grad(doubled)(2.0)[0],
    ):
        assert result == 6
    assert jax.eval_shape(doubled, 2.0).shape == ()


def test_programs_are_called_in_place_where_that_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, bool]] = []
    monkeypatch.setattr(programs.jax.config, "update", lambda name, value: asked.append((name, value)))
    programs.call_in_place()
    assert asked == [("jax_cpu_enable_async_dispatch", False)]
    assert "jax_cpu_enable_async_dispatch" in jax.config.values


def test_other_arguments_are_another_program(folder: Path) -> None:
    program, traces = counted()
    program(*given(), factor=2.0)
    program(*given(), factor=2.0)
    assert sum(traces) == 1
    assert float(program(*given(), factor=3.0).scaled[0] - program(*given(), factor=2.0).scaled[0]) == pytest.approx(1)
    assert program(*given(4), factor=2.0).total == 6
    assert len(files(folder)) == 3


def test_a_damaged_file_is_made_again(folder: Path) -> None:
    program, traces = counted()
    expected = program(*given(), factor=2.0)
    (file,) = files(folder)
    content = file.read_bytes()
    file.write_bytes(content[:100] + b"?" + content[101:])
    next_process(folder)
    again, traces = counted()
    jax.tree.map(np.testing.assert_array_equal, again(*given(), factor=2.0), expected)
    assert sum(traces) == 1
    next_process(folder)
    again(*given(), factor=2.0)
    assert sum(traces) == 1


def test_inside_of_a_trace_it_is_a_part_of_the_trace(folder: Path) -> None:
    program, _ = counted()
    values, key = given()
    mapped = jax.jit(jax.vmap(lambda total: program(Pair(total, values.scaled), key, factor=2.0).total))
    np.testing.assert_array_equal(mapped(jnp.ones((2, 3))), [3, 3])
    assert not files(folder)


def test_what_cannot_be_exported_is_compiled_as_ever(folder: Path) -> None:
    @kept()
    def called(values: Float[Array, " n"]) -> Float[Array, " n"]:
        return jax.pure_callback(lambda array: np.asarray(array) + 1, values, values)

    np.testing.assert_array_equal(called(jnp.zeros(2)), [1, 1])
    assert not files(folder)


def test_a_folder_does_not_grow_without_bound(folder: Path) -> None:
    program, _ = counted()
    program(*given(), factor=1.0)
    (first,) = files(folder)
    for number in range(programs._MOST):
        (first.parent / f"old-{number}.export").write_bytes(b"")
        os.utime(first.parent / f"old-{number}.export", (number, number))
    program(*given(), factor=2.0)
    left = files(folder)
    assert len(left) == programs._MOST
    assert first in left  # what was used last
    assert not (first.parent / "old-0.export").exists()
    for number in range(4):
        (folder / f"version{number}").mkdir()
    keep_programs(folder)
    own = kept_folder()
    assert own is not None
    assert own.is_dir()
    assert len(list(folder.iterdir())) == programs._FOLDERS


def test_a_folder_that_cannot_be_made_is_done_without(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    keep_programs(tmp_path / "file")
    assert kept_folder() is None
    program, _ = counted()
    assert program(*given(), factor=1.0).total == 3


def test_a_part_is_made_once(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    estimator = PoseEstimator.from_pretrained()
    source = tmp_path / "part.stl"
    source.write_bytes((INDUSTRIAL / "screw.stl").read_bytes())
    part = prepare_kept(estimator, source, None)
    calls = []
    real = PoseEstimator.prepare
    monkeypatch.setattr(PoseEstimator, "prepare", lambda *given: calls.append(1) or real(*given))
    again = prepare_kept(estimator, source, None)
    assert not calls
    for name in ("points", "normals", "features", "minimum", "maximum"):
        np.testing.assert_array_equal(getattr(again, name), getattr(part, name))
    assert (again.name, again.unit, again.diameter, again.area) == (part.name, part.unit, part.diameter, part.area)

    assert prepare_kept(estimator, source, "m").unit == "m"  # another unit, ...
    source.write_bytes((INDUSTRIAL / "shaft.stl").read_bytes())
    assert prepare_kept(estimator, source, None).diameter != part.diameter  # ... or another file is another part
    assert len(calls) == 2


def test_a_damaged_card_is_made_again_and_bad_files_are_told(folder: Path, tmp_path: Path) -> None:
    estimator = PoseEstimator.from_pretrained()
    part = prepare_kept(estimator, INDUSTRIAL / "screw.stl", None)
    (card,) = folder.glob("*/parts/*.kmn")
    content = card.read_bytes()
    card.write_bytes(content[: len(content) // 2])
    assert prepare_kept(estimator, INDUSTRIAL / "screw.stl", None).diameter == part.diameter
    assert card.read_bytes() == content
    (tmp_path / "part.stl").write_bytes(b"solid")
    with pytest.raises(InputError, match=r"part\.stl"):
        prepare_kept(estimator, tmp_path / "part.stl", None)
    with pytest.raises(InputError, match=r"none\.stl"):
        prepare_kept(estimator, tmp_path / "none.stl", None)


def test_two_threads_make_a_program_once(folder: Path) -> None:
    program, traces = counted()
    with ThreadPoolExecutor(4) as pool:
        totals = list(pool.map(lambda _: float(program(*given(), factor=2.0).total), range(8)))
    assert totals == [3.0] * 8
    assert sum(traces) == 1


def test_work_is_done_ahead_in_a_process_that_found_nothing(folder: Path) -> None:
    done: Queue[int] = Queue()

    def work(values: np.ndarray, name: str) -> None:
        done.put(len(values))

    programs.meanwhile(work, np.zeros(3), "a")
    assert done.get(timeout=10) == 3
    programs.meanwhile(work, np.ones(3), "a")  # was done
    programs.meanwhile(work, np.ones(4), "a")
    assert done.get(timeout=10) == 4
    programs.meanwhile(work, np.ones(4), "b")
    assert done.get(timeout=10) == 4
    counted()[0](*given(), factor=2.0)
    next_process(folder)
    programs.meanwhile(work, np.zeros(6), "a")  # programs were kept
    keep_programs(None)
    programs.meanwhile(work, np.zeros(5), "a")
    assert done.get(timeout=10) == 5
    assert done.empty()


def test_it_is_known_whether_a_program_is_kept(folder: Path) -> None:
    read_kept()
    program, _ = counted()
    assert program.is_to_be_made
    program(*given(), factor=2.0)
    next_process(folder)
    assert not counted()[0].is_to_be_made
    assert kept()(given).is_to_be_made, "another one is kept"
    keep_programs(None)
    assert not program.is_to_be_made, "nothing is to be kept"


@pytest.mark.parametrize("is_busy", [True, False])
def test_an_interrupt_ends_what_python_would_wait_for(is_busy: bool) -> None:
    """The child is in a call that returns to Python after minutes, as compiling does, or a thread of it is."""
    call = "long()" if is_busy else "threading.Thread(target=long).start(); time.sleep(300)"
    code = (
        "import hashlib, signal, sys, threading, time\n"
        "from kmn_jax.programs import ended_by_interrupt\n"
        "def long(): hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1)\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored where tests run in the background
        "try:\n"
        "    with ended_by_interrupt():\n"
        "        print('waits', flush=True)\n"
        f"        {call}\n"
        "except KeyboardInterrupt:\n"
        "    sys.exit(130)\n"  # as the command does, which then waits for its threads
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, stderr=-1) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "waits\n"
        child.send_signal(signal.SIGINT)
        assert child.wait(30) == 130


def test_interrupts_are_as_before_where_they_are_ignored_and_in_other_threads() -> None:
    def watched() -> bool:
        with ended_by_interrupt():
            before = threading.active_count()
            return before > outside

    outside = threading.active_count()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert watched()
        while threading.active_count() > outside:  # until the thread that watched has ended
            time.sleep(0.02)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        assert not watched()
    finally:
        signal.signal(signal.SIGINT, before)
    with ThreadPoolExecutor(1) as pool:
        outside += 1
        assert not pool.submit(watched).result()
