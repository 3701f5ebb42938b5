"""What is killed: commands that write, what must hold after a kill, and when two results are the same.

To add one, write a class with the members of `Activity` and put it into ACTIVITIES.
"""

from __future__ import annotations

import json
import sys
from functools import cache
from pathlib import Path
from typing import Protocol

import numpy as np

from kmn_jax.data import Pack, PackConfig, Source, build_pack
from kmn_jax.files import read_safetensors
from kmn_jax.train import create_state
from kmn_jax.train._checkpoint import Checkpoints
from kmn_jax.train._step import TrainState
from tests.train.loop_sample import assert_same_runs, flags, tiny

_ASSETS = Path(__file__).parents[2] / "experiments" / "assets"
_PACK = PackConfig(surfels=128, bin_surfels=64, drops=2, copies=(1, 2))
_CLOCKS = ("seconds", "refine_seconds")


class Activity(Protocol):
    """A command that begins anew or goes on in a folder, whatever ended the one before."""

    def command(self, folder: Path) -> list[str]:
        """Return the command; before its first run the folder is empty."""

    def begun(self, folder: Path) -> bool:
        """Tell whether it has written something: most kills fall between then and its end."""

    def intact(self, folder: Path, whole: Path) -> None:
        """Raise AssertionError if a kill has left what cannot be used, or lost what was done."""

    def same(self, folder: Path, whole: Path) -> None:
        """Raise AssertionError if what is finished differs from the run without a stop by more than clocks."""


class Training:
    """Training of a small network with the config "debug"."""

    def command(self, folder: Path) -> list[str]:
        """See Activity."""
        changes = {"num_steps": 20, "validate_every": 10, "checkpoint_every": 3, "log_every": 2}
        arguments = [*flags(**changes), "--folder", str(folder / "run"), "--resume"]
        return [sys.executable, "-m", "experiments.train", *arguments]

    def begun(self, folder: Path) -> bool:
        """See Activity."""
        return (folder / "run" / "checkpoints").exists()

    def intact(self, folder: Path, whole: Path) -> None:
        """The newest checkpoint can be read, and is not older than those that a restart has seen."""
        if Checkpoints(folder / "run" / "checkpoints").steps:
            seen, step = folder / "seen", _newest_step(folder / "run" / "checkpoints")
            assert step >= int(seen.read_text() if seen.exists() else 0), "a checkpoint was lost"
            seen.write_text(str(step))

    def same(self, folder: Path, whole: Path) -> None:
        """State, metrics and both models are equal to the bit."""
        assert_same_runs(folder / "run", whole / "run")


class PackBuilding:
    """A training pack of four boxes."""

    def command(self, folder: Path) -> list[str]:
        """See Activity."""
        program = "from tests.attack.activities import build\nfrom pathlib import Path\nimport sys\n"
        return [sys.executable, "-c", f"{program}build(Path(sys.argv[1]))", str(folder)]

    def begun(self, folder: Path) -> bool:
        """See Activity."""
        return (folder / "pack" / "journal.jsonl").exists()

    def intact(self, folder: Path, whole: Path) -> None:
        """Objects whose line is in the journal have whole files."""
        journal = folder / "pack" / "journal.jsonl"
        lines = journal.read_bytes().split(b"\n")[1:-1] if journal.exists() else []
        for line in lines:
            name = line.split(b'"name": "')[1].split(b'"')[0].decode()
            _assert_same_file(folder, whole, f"pack/objects/{name}.safetensors")

    def same(self, folder: Path, whole: Path) -> None:
        """All files but the journal, which has times, are the same."""
        assert not Pack(folder / "pack").problems()
        for path in sorted((whole / "pack").rglob("*")):
            if path.is_file() and path.name != "journal.jsonl":
                _assert_same_file(folder, whole, str(path.relative_to(whole)))


class Preparing:
    """`kmn prepare`."""

    def command(self, folder: Path) -> list[str]:
        """See Activity."""
        part = _ASSETS / "industrial" / "idler.stl"
        return [sys.executable, "-m", "kmn_jax.cli", "prepare", str(part), "-o", str(folder / "part.kmn")]

    def begun(self, folder: Path) -> bool:
        """See Activity: there is no sign of it before the card is there."""
        return any(folder.iterdir())

    def intact(self, folder: Path, whole: Path) -> None:
        """The card is whole or not there."""
        if (folder / "part.kmn").exists():
            self.same(folder, whole)

    def same(self, folder: Path, whole: Path) -> None:
        """Tensors and facts are the same."""
        assert_same_tensors(folder / "part.kmn", whole / "part.kmn")


class Evaluating:
    """An evaluation as in the demo: our method and one RANSAC of it, on a few crops of an image."""

    def command(self, folder: Path) -> list[str]:
        """See Activity."""
        data = ["bop", "--folder", str(_ASSETS / "small_test_set"), "--objects", "gear_motor", "--images", "1"]
        how = ["--methods", "ours", "ours_ransac", "--crops", "2", "--noise", "0", "0.01"]
        return [sys.executable, "-m", "experiments.evaluate", *data, *how, "--output", str(folder / "out")]

    def begun(self, folder: Path) -> bool:
        """See Activity."""
        return (folder / "out" / "recipe.json").exists()

    def intact(self, folder: Path, whole: Path) -> None:
        """Every file of predictions that is there is whole, and none is lost."""
        names = [str(path.relative_to(folder)) for path in sorted(folder.glob("out/*/[!.]*.safetensors"))]
        seen = folder / "seen"
        lost = set(seen.read_text().splitlines() if seen.exists() else ()) - set(names)
        assert not lost, f"predictions were lost: {sorted(lost)}"
        for name in names:
            assert_same_tensors(folder / name, whole / name)
        seen.write_text("\n".join(names))

    def same(self, folder: Path, whole: Path) -> None:
        """All predictions are the same but for their times, and there is a report."""
        assert (folder / "out" / "report.md").exists()
        names = sorted(path.relative_to(whole) for path in whole.glob("out/*/[!.]*.safetensors"))
        assert names
        for name in names:
            assert_same_tensors(folder / name, whole / name)


class Serving:
    """`kmn serve` on a folder of parts, with a client that sends others and searches for all of them."""

    def command(self, folder: Path) -> list[str]:
        """See Activity."""
        return [sys.executable, "-m", "tests.attack.serving", str(folder)]

    def begun(self, folder: Path) -> bool:
        """See Activity: the server has made its private folder, and prepares parts next."""
        return any(folder.glob("temporary/*"))

    def intact(self, folder: Path, whole: Path) -> None:
        """The parts are as they were, and what the server has confirmed is as without a stop."""
        for path in folder.glob("parts/[!.]*"):
            _assert_same_file(folder, whole, f"parts/{path.name}")
        names = sorted(path.name for path in folder.glob("[!.]*.json"))
        seen = folder / "seen"
        lost = set(seen.read_text().splitlines() if seen.exists() else ()) - set(names)
        assert not lost, f"answers were lost: {sorted(lost)}"
        for name in names:
            _assert_same_file(folder, whole, name)
        seen.write_text("\n".join(names))

    def same(self, folder: Path, whole: Path) -> None:
        """All is answered as without a stop, with poses among it, and no server has left a file."""
        names = sorted(path.name for path in whole.glob("*.json"))
        assert any(json.loads((whole / name).read_text()).get("poses") for name in names)
        for name in names:
            _assert_same_file(folder, whole, name)
        left = [str(path.relative_to(folder)) for path in folder.glob("temporary/*")]
        assert not left, f"servers left {left}"


ACTIVITIES: dict[str, Activity] = {
    "training": Training(),
    "pack building": PackBuilding(),
    "prepare": Preparing(),
    "evaluation": Evaluating(),
    "serve": Serving(),
}


def build(folder: Path) -> None:
    """Build the pack of boxes, or go on with it."""
    import trimesh

    from kmn_jax.files import write_whole

    sources = []
    for index in range(4):
        path = folder / f"box{index}.stl"
        write_whole(path, trimesh.creation.box((10 + 3 * index, 20, 30)).export(file_type="stl"))
        sources.append(Source(path.stem, "train", path))
    build_pack(folder / "pack", sources, _PACK, workers=1)


def _newest_step(folder: Path) -> int:
    """Return the step of the newest checkpoint; whole are all but those that a kill left unfinished."""
    reports: list[str] = []
    found = Checkpoints(folder, report=reports.append).latest(_state())
    assert all("was not finished" in report for report in reports), reports
    assert found is not None
    return int(found.state.step)


@cache
def _state() -> TrainState:
    return create_state(tiny().step, tiny().optimizer.build(tiny().num_steps))[1]


def assert_same_tensors(path: Path, other: Path) -> None:
    """Compare all of two safetensors files but clocks, and the commit: what this writes makes files differ from it."""
    (found, facts), (wanted, wanted_facts) = read_safetensors(path), read_safetensors(other)
    assert facts | {"commit": ""} == wanted_facts | {"commit": ""}, f"{path.name}: other facts"
    assert found.keys() == wanted.keys()
    for name in found.keys() - set(_CLOCKS):
        assert np.array_equal(found[name], wanted[name]), f"{path.name}: {name} differs"


def _assert_same_file(folder: Path, whole: Path, name: str) -> None:
    assert (folder / name).exists(), f"{name} is missing"
    assert (folder / name).read_bytes() == (whole / name).read_bytes(), f"{name} differs"
