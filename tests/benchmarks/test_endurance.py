"""The verdict of an endurance run, on made up figures, and the frames that it is made of."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks import endurance
from benchmarks.endurance import Log, _empty, _step, relative_seconds, trend, verdict
from benchmarks.endurance_frames import FAULTS, Frame, bin_frames, faulty, schedule, small_frames
from kmn_jax.errors import InputError
from kmn_jax.io import read_scan
from tests.attack import __main__ as attack
from tests.attack import kills
from tests.reference.parts import box_part

RANDOM = np.random.default_rng(0)


def flat(count: int = 1000) -> Log:
    seconds = (0.1 * RANDOM.lognormal(sigma=0.2, size=count)).tolist()
    megabytes = (1000 + RANDOM.normal(scale=5, size=count)).tolist()
    return Log(
        seconds, [1.5 * value for value in seconds], megabytes, ["a" if row % 3 else "b" for row in range(count)]
    )


def test_flat_figures_hold() -> None:
    found = verdict(flat(), 1000)
    assert found["holds"]
    assert found["fails"] == "nothing"
    assert found["level MB"] == pytest.approx(1000, abs=3)


def test_what_grows_or_slows_or_lacks_does_not() -> None:
    leaking = flat()
    leaking.megabytes = [1000 + 0.1 * row for row in range(1000)]
    assert verdict(leaking, 1000)["fails"] == "memory"
    slowing = flat()
    slowing.cpu_seconds = [value * (1 + row / 4000) for row, value in enumerate(slowing.cpu_seconds)]
    assert verdict(slowing, 1000)["fails"] == "latency"
    wrong = flat()
    wrong.untold, wrong.differing = ["a"], ["b"]
    assert verdict(wrong, 1001)["fails"] == "all were done, faults, same bits"


def test_a_machine_that_does_more_besides_is_no_trend() -> None:
    busier = flat()
    busier.seconds = [value * (1 + row / 1000) for row, value in enumerate(busier.seconds)]
    found = verdict(busier, 1000)
    assert found["holds"]
    assert found["drift"] > 10 * abs(found["cpu drift"])


def test_a_step_early_in_memory_is_no_growth() -> None:
    warming = flat()
    warming.megabytes[:150] = [400.0] * 150
    assert verdict(warming, 1000)["holds"]


def test_kinds_of_frames_do_not_make_a_trend() -> None:
    seconds, frames = [0.1] * 50 + [1.0] * 50, ["quick"] * 50 + ["slow"] * 50
    np.testing.assert_allclose(relative_seconds(seconds, frames), 1)
    drift, noise = trend(relative_seconds(seconds, frames), shuffles=50)
    assert drift == noise == 0
    assert trend(np.linspace(1, 1.5, 600), shuffles=50)[0] == pytest.approx(0.5, rel=0.02)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> list[Frame]:
    folder = tmp_path_factory.mktemp("frames")
    parts = {"one": box_part(4000), "other": box_part(4000, seed=1)}
    small = small_frames(parts, folder, np.random.default_rng(0))
    return [*small, *bin_frames(folder)]


def test_frames_can_be_read_and_places_are_in_them(frames: list[Frame]) -> None:
    assert len({frame.name for frame in frames}) == len(frames)
    assert {frame.unit for frame in frames} == {"mm", "m"}
    for frame in frames:
        scan = read_scan(frame.scan, frame.unit, frame.camera)
        if frame.at is not None:
            apart = np.linalg.norm(scan.points - frame.at, axis=1).min()
            # Places in bins are the origins of copies, inside of them.
            assert apart < (0.02 if frame.camera is None else 0.2) * np.ptp(scan.points, axis=0).max()


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault != "another part"])
def test_faulty_frames_cannot_be_read(fault: str, frames: list[Frame], tmp_path: Path) -> None:
    for frame in frames:
        before = frame.scan.read_bytes()
        with pytest.raises(InputError):
            read_scan(faulty(frame, fault, tmp_path, {}).scan, frame.unit, frame.camera)
        assert frame.scan.read_bytes() == before


def test_the_schedule_has_all_kinds_and_faults(frames: list[Frame]) -> None:
    small = [frame for frame in frames if frame.camera is None]
    bins = [frame for frame in frames if frame.camera is not None]
    drawn = list(schedule(small, bins, 2000, np.random.default_rng(0)))
    assert {fault for _, fault in drawn} == {None, *FAULTS}
    assert {frame.name for frame, _ in drawn} == {frame.name for frame in frames}
    assert sum(frame.at is None for frame, _ in drawn) < 100


def test_frames_in_which_nothing_is_found_get_no_faults(
    frames: list[Frame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert _empty({"a": b"bits", "b": "no pose"}) == ["b"]
    with pytest.raises(InputError, match="nothing is found in any frame"):
        _empty({"b": "no pose"})
    monkeypatch.setattr(endurance, "_detected", lambda *_: "no pose")
    log = Log()
    _step(None, {}, frames[0], "empty", tmp_path, {frames[0].name: "no pose"}, log)  # type: ignore[arg-type]
    assert (log.faults.total(), log.untold, log.differing) == (0, [], [])


@pytest.mark.parametrize("run", [attack.main, kills.main])
def test_a_place_for_results_is_made_before_what_takes_time(run: Callable[..., int], tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="cannot be written to"):
        run(json=tmp_path / "file" / "a.json")


def test_faults_that_are_not_told_and_other_bits_are_noted(
    frames: list[Frame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = iter([b"first", b"second", "refused", b"as if nothing were wrong"])
    monkeypatch.setattr(endurance, "_detected", lambda *_: next(answers))
    log, first, frame = Log(), {frames[0].name: b"first"}, frames[0]
    for fault in (None, None, "empty", "all NaN"):
        _step(None, {}, frame, fault, tmp_path, first, log)  # type: ignore[arg-type]
    assert len(log.seconds) == len(log.cpu_seconds) == len(log.megabytes) == 4
    assert [line.startswith("detection 1, ") for line in log.differing] == [True]
    assert [line.startswith("detection 3, ") for line in log.untold] == [True]
    assert (log.faults["empty"], log.told["empty"], log.told["all NaN"]) == (1, 1, 0)
