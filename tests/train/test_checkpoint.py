from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.train._checkpoint import Checkpoints
from kmn_jax.train._step import TrainState
from tests.reference.compiled import with_devices
from tests.train.snapshot_sample import (
    DAMAGES,
    TINY,
    abstract_state,
    assert_same,
    flip,
    mixed_state,
    random_snapshot,
    random_state,
    reversed_chunk,
    reversed_manifest,
    sign_again,
)

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def like() -> TrainState:
    return abstract_state()


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory, like: TrainState) -> Path:
    """A folder with checkpoints of steps 10 and 20: copy it before changing it."""
    folder = tmp_path_factory.mktemp("two") / "checkpoints"
    checkpoints = Checkpoints(folder)
    for step in (10, 20):
        checkpoints.save(random_snapshot(step, like))
    return folder


def files_by_kind(folder: Path) -> dict[str, Path]:
    """Return a file for each kind of file of a checkpoint; the largest, where there are several."""
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*"), key=lambda path: path.stat().st_size):
        if path.is_file():
            parent = path.parent.relative_to(folder)
            found[str(parent / ("data" if parent.name == "d" else path.name))] = path
    return found


def test_round_trip_is_bitwise(two: Path, like: TrainState) -> None:
    reports: list[str] = []
    checkpoints = Checkpoints(two, report=reports.append)
    assert_same(checkpoints.latest(like), random_snapshot(20, like))
    concrete = random_state(like, 0)
    assert_same(checkpoints.latest(concrete), random_snapshot(20, like))
    assert checkpoints.steps == [10, 20]
    assert checkpoints.best(like) is None
    assert reports == []


def test_restored_arrays_can_be_donated(two: Path, like: TrainState) -> None:
    checkpoints = Checkpoints(two)
    placed = jax.tree.map(lambda leaf: jax.device_put(leaf, jax.devices()[0]), random_state(like, 0))
    advance = jax.jit(lambda state: jax.tree.map(lambda leaf: leaf + leaf, state), donate_argnums=0)
    for target in (like, placed):
        first = checkpoints.latest(target)
        assert first is not None
        advance(first.state)
        assert_same(checkpoints.latest(target), random_snapshot(20, like))
    assert all(leaf.committed for leaf in jax.tree.leaves(checkpoints.latest(placed).state))
    assert not any(leaf.committed for leaf in jax.tree.leaves(checkpoints.latest(random_state(like, 0)).state))


def test_odd_leaves(tmp_path: Path, like: TrainState) -> None:
    snapshot = replace(random_snapshot(3, like), state=mixed_state(like, 3), batches=bytes(range(256)))
    checkpoints = Checkpoints(tmp_path / "a" / "b")
    checkpoints.save(snapshot)
    assert_same(checkpoints.latest(snapshot.state), snapshot)


def test_keeps_the_latest_and_the_best(tmp_path: Path, like: TrainState) -> None:
    checkpoints = Checkpoints(tmp_path)
    for step in range(1, 7):
        checkpoints.save(random_snapshot(step, like), best=step in (1, 2))
    assert checkpoints.steps == [2, 5, 6]
    assert_same(checkpoints.best(like), random_snapshot(2, like))
    assert_same(checkpoints.latest(like), random_snapshot(6, like))
    checkpoints.save(random_snapshot(7, like), best=True)
    assert checkpoints.steps == [6, 7]
    assert_same(checkpoints.best(like), random_snapshot(7, like))
    assert len(list(tmp_path.iterdir())) == 2


def test_a_step_can_be_saved_again(tmp_path: Path, like: TrainState) -> None:
    checkpoints = Checkpoints(tmp_path)
    for step, loss, best in [(1, 0.5, False), (2, 0.4, False), (2, 0.3, True), (2, 0.2, False)]:
        checkpoints.save(replace(random_snapshot(step, like), facts={"loss": loss}), best)
    assert checkpoints.steps == [1, 2]
    assert checkpoints.latest(like).facts == {"loss": 0.2}
    assert checkpoints.best(like).facts == {"loss": 0.3}
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_reported_and_the_one_before_used(two: Path, tmp_path: Path, like: TrainState, damage: str) -> None:
    kinds = files_by_kind(two / "step-00000020")
    assert {"record.json", "state/_METADATA", "state/manifest.ocdbt", "state/ocdbt.process_0/d/data"} <= kinds.keys()
    for number, path in enumerate(kinds.values()):
        folder = shutil.copytree(two, tmp_path / str(number))
        DAMAGES[damage](folder / path.relative_to(two))
        reports: list[str] = []
        assert_same(Checkpoints(folder, report=reports.append).latest(like), random_snapshot(10, like))
        assert len(reports) == 1
        assert "step-00000020 is damaged and is not used: " in reports[0]
        assert path.name in reports[0] or path.name == "record.json"  # which may not be JSON any more


def test_what_cannot_be_read_but_is_whole_is_no_damage(
    tmp_path: Path, like: TrainState, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(random_snapshot(1, like))
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "orbax.checkpoint", None)
        with pytest.raises(ImportError):
            checkpoints.latest(like)
    with monkeypatch.context() as patch:
        patch.setattr("kmn_jax.train._snapshot._FORMAT", "kmn_jax snapshot 9")
        checkpoints.save(random_snapshot(2, like))
    with pytest.raises(InputError, match=r"step-00000002: .*its format is 'kmn_jax snapshot 9'"):
        checkpoints.latest(like)
    assert checkpoints.steps == [1, 2]


def empty(path: Path) -> None:
    shutil.rmtree(path)
    path.mkdir()


def lose_state(path: Path) -> None:
    shutil.rmtree(path / "state")


def become_file(path: Path) -> None:
    shutil.rmtree(path)
    path.write_bytes(b"")


@pytest.mark.parametrize("damage", [empty, lose_state, become_file])
def test_broken_folders(two: Path, tmp_path: Path, like: TrainState, damage: Callable[[Path], None]) -> None:
    folder = shutil.copytree(two, tmp_path / "checkpoints")
    damage(folder / "step-00000020")
    reports: list[str] = []
    checkpoints = Checkpoints(folder, report=reports.append)
    assert_same(checkpoints.latest(like), random_snapshot(10, like))
    assert len(reports) == 1
    # The run goes on from there, and past the damaged one.
    checkpoints.save(random_snapshot(15, like))
    assert checkpoints.steps == [10, 15]
    assert_same(Checkpoints(folder).latest(like), random_snapshot(15, like))


@pytest.mark.parametrize("damage", [reversed_manifest, reversed_chunk])
def test_what_orbax_cannot_decode_gives_way(
    two: Path, tmp_path: Path, like: TrainState, damage: Callable[[Path], Path]
) -> None:
    folder = shutil.copytree(two, tmp_path / "checkpoints")
    sign_again(folder / "step-00000020", damage(folder / "step-00000020"))
    reports: list[str] = []
    checkpoints = Checkpoints(folder, report=reports.append)
    assert_same(checkpoints.latest(like), random_snapshot(10, like))
    assert ["step-00000020 cannot be decoded and is not used: " in text for text in reports] == [True]
    checkpoints.save(random_snapshot(15, like))
    assert checkpoints.steps == [10, 15]


def test_if_none_can_be_decoded_all_stay(two: Path, tmp_path: Path, like: TrainState) -> None:
    folder = shutil.copytree(two, tmp_path / "checkpoints")
    for name in ("step-00000010", "step-00000020"):
        sign_again(folder / name, reversed_manifest(folder / name))
    with pytest.raises(InputError, match=r"step-00000020 is as it was written, but cannot be decoded"):
        Checkpoints(folder, report=lambda _: None).latest(like)
    assert Checkpoints(folder).steps == [10, 20]


def test_half_written_one(two: Path, tmp_path: Path, like: TrainState) -> None:
    folder = shutil.copytree(two, tmp_path / "checkpoints")
    (folder / "step-00000020").rename(folder / ".step-00000020")
    (folder / ".step-00000005").mkdir()
    (folder / "notes.txt").write_text("not ours")
    reports: list[str] = []
    checkpoints = Checkpoints(folder, report=reports.append)
    assert_same(checkpoints.latest(like), random_snapshot(10, like))
    assert len(reports) == 2
    assert ".step-00000020 was not finished" in reports[1]
    checkpoints.save(random_snapshot(20, like))
    assert sorted(path.name for path in folder.iterdir()) == ["notes.txt", "step-00000010", "step-00000020"]


def test_nothing_usable(two: Path, tmp_path: Path, like: TrainState) -> None:
    reports: list[str] = []
    assert Checkpoints(tmp_path / "none", report=reports.append).latest(like) is None
    assert reports == []
    folder = shutil.copytree(two, tmp_path / "checkpoints")
    for name in ("step-00000010", "step-00000020"):
        flip(folder / name / "record.json")
    checkpoints = Checkpoints(folder, report=reports.append)
    assert checkpoints.latest(like) is None
    assert [("step-00000010" in report, "step-00000020" in report) for report in reports] == [
        (False, True),
        (True, False),
    ]


def test_best_falls_back(tmp_path: Path, like: TrainState) -> None:
    reports: list[str] = []
    checkpoints = Checkpoints(tmp_path, report=reports.append)
    for step in (1, 2):
        checkpoints.save(random_snapshot(step, like), best=True)
    flip(tmp_path / "step-00000002-best" / "record.json")
    assert_same(checkpoints.best(like), random_snapshot(1, like))
    assert len(reports) == 1


def test_another_network_or_optimizer_is_an_error(two: Path, like: TrainState) -> None:
    for other in (abstract_state(replace(TINY, pair_width=16)), abstract_state(clip_norm=0.0)):
        with pytest.raises(InputError, match=r"step-00000020: the saved state is of another network or optimizer"):
            Checkpoints(two).latest(other)


def test_unusable_saves(two: Path, tmp_path: Path, like: TrainState) -> None:
    with pytest.raises(InputError, match="a checkpoint of step 20, later than step 15"):
        Checkpoints(two).save(random_snapshot(15, like))
    with pytest.raises(InputError, match="what JSON can hold"):
        Checkpoints(tmp_path).save(replace(random_snapshot(1, like), facts={"array": np.zeros(2)}))
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="cannot read the folder of checkpoints"):
        Checkpoints(tmp_path / "file").save(random_snapshot(1, like))
    with pytest.raises(InputError, match="cannot read the folder of checkpoints"):
        Checkpoints(tmp_path / "file" / "deeper").save(random_snapshot(1, like))


KILLED = """
import os, sys
from tests.train.snapshot_sample import random_snapshot, abstract_state
import orbax.checkpoint
from kmn_jax.train._checkpoint import Checkpoints
print("ready", flush=True)
for line in sys.stdin:
    child = os.fork()  # nothing of JAX has been started yet, only loaded
    if child == 0:
        like, checkpoints = abstract_state(), Checkpoints(sys.argv[1])
        step = max(checkpoints.steps, default=0)
        print("saving", os.getpid(), flush=True)
        while True:
            step += 1
            checkpoints.save(random_snapshot(step, like), best=step % 2 == 1)
            print(step, flush=True)
    os.waitpid(child, 0)
    print("killed", flush=True)
"""


def run_python(program: str, *arguments: object, **settings: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", program, *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT), **settings},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def test_kill_at_any_moment(tmp_path: Path, like: TrainState) -> None:
    random = np.random.default_rng(0)
    reports: list[str] = []
    with run_python(KILLED, tmp_path) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        for _ in range(4):
            process.stdin.write("\n")
            process.stdin.flush()
            child = int(process.stdout.readline().split()[1])
            done = [int(process.stdout.readline()) for _ in range(2)][-1]
            time.sleep(random.uniform(0.0, 0.3))
            os.kill(child, signal.SIGKILL)
            for line in iter(process.stdout.readline, "killed\n"):
                done = int(line)
            checkpoints = Checkpoints(tmp_path, report=reports.append)
            found = checkpoints.latest(like)
            assert found is not None
            step = int(found.state.step)
            assert step in (done, done + 1)
            assert_same(found, random_snapshot(step, like))
            best = checkpoints.best(like)
            assert best is not None
            assert_same(best, random_snapshot(step - 1 + step % 2, like))
        process.stdin.close()
    assert all("was not finished" in report for report in reports)


EIGHT_DEVICES = """
import sys, jax, numpy as np
from dataclasses import replace
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from kmn_jax.train._checkpoint import Checkpoints
from tests.train.snapshot_sample import abstract_state, assert_same, random_snapshot
mesh = Mesh(np.array(jax.devices()), ("data",))
def sharding(leaf):
    split = leaf.ndim > 0 and leaf.shape[0] % 8 == 0
    return NamedSharding(mesh, PartitionSpec("data") if split else PartitionSpec())
plain = abstract_state()
like = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding(leaf)), plain)
checkpoints = Checkpoints(sys.argv[1])
found = checkpoints.latest(like)
assert_same(found, random_snapshot(20, plain))
assert all(leaf.sharding == want.sharding for leaf, want in zip(jax.tree.leaves(found.state), jax.tree.leaves(like)))
assert len(found.state.step.addressable_shards) == 8
checkpoints.save(replace(found, state=found.state._replace(step=found.state.step + 1)))
"""


def test_other_number_of_devices(two: Path, tmp_path: Path, like: TrainState) -> None:
    folder = shutil.copytree(two, tmp_path / "checkpoints")
    with run_python(EIGHT_DEVICES, folder, XLA_FLAGS=with_devices(8)) as process:
        assert process.wait(timeout=240) == 0
    found = Checkpoints(folder).latest(like)
    wanted = random_snapshot(20, like)
    assert_same(found, replace(wanted, state=wanted.state._replace(step=jax.numpy.int32(21))))


TWO_PROCESSES = """
import sys, jax, numpy as np
from dataclasses import replace
from jax.sharding import Mesh, NamedSharding, PartitionSpec
port, process, folder = sys.argv[1], int(sys.argv[2]), sys.argv[3]
jax.distributed.initialize(f"localhost:{port}", 2, process)
from kmn_jax.errors import InputError
from kmn_jax.train._checkpoint import Checkpoints
from kmn_jax.train._snapshot import unpack, pack
from tests.train.snapshot_sample import abstract_state, random_snapshot
mesh = Mesh(np.array(jax.devices()), ("data",))
def sharding(leaf):
    split = leaf.ndim > 0 and leaf.shape[0] % 2 == 0
    return NamedSharding(mesh, PartitionSpec("data") if split else PartitionSpec())
plain = abstract_state()
like = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding(leaf)), plain)
reports = []
# Only the first process has the folder.
checkpoints = Checkpoints(folder if process == 0 else "/nowhere", report=reports.append)
assert checkpoints.latest(like) is None
wanted = pack(random_snapshot(3, plain))
checkpoints.save(unpack(wanted, like))
found = checkpoints.latest(like)
assert not found.state.parameters["scene"]["out"]["kernel"][...].is_fully_addressable
again = pack(found)
assert again.record == wanted.record
assert all(again.arrays[name].tobytes() == array.tobytes() for name, array in wanted.arrays.items())
for attempt in (lambda: checkpoints.latest(abstract_state(clip_norm=0.0)), lambda: checkpoints.save(found_earlier)):
    found_earlier = unpack(pack(random_snapshot(2, plain)), like)
    try:
        attempt()
    except InputError as error:
        assert folder in str(error), error
    else:
        raise AssertionError("no error")
assert not reports
"""


def test_two_processes(tmp_path: Path, like: TrainState) -> None:
    with socket.create_server(("localhost", 0)) as server:
        port = server.getsockname()[1]
    with run_python(TWO_PROCESSES, port, 0, tmp_path) as first, run_python(TWO_PROCESSES, port, 1, tmp_path) as second:
        assert (first.wait(timeout=240), second.wait(timeout=240)) == (0, 0)
    assert_same(Checkpoints(tmp_path).latest(like), random_snapshot(3, like))
