from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from multiprocessing import parent_process
from pathlib import Path

import numpy as np
import pytest
import trimesh

from kmn_jax.data import Pack, PackConfig, Record, Source, build_pack
from kmn_jax.data._build import _Journal
from kmn_jax.errors import InputError

CONFIG = PackConfig(surfels=128, bin_surfels=64, drops=2, copies=(1, 2))
ROOT = Path(__file__).parents[2]


class CrashingSource(Source):
    """A file whose reader takes its process down."""

    def __getattribute__(self, name: str) -> object:
        return os._exit(3) if name == "path" and parent_process() else super().__getattribute__(name)


class HangingSource(Source):
    """A file that is never done."""

    def __getattribute__(self, name: str) -> object:
        return time.sleep(1000) if name == "path" and parent_process() else super().__getattribute__(name)


def box_sources(folder: Path, count: int = 3) -> list[Source]:
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        trimesh.creation.box((10 + 3 * index, 20, 30)).export(folder / f"box{index}.stl")
    return [Source(f"box{index}", "train", folder / f"box{index}.stl") for index in range(count)]


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "journal.jsonl"
    }


def seconds_apart(records: list[Record]) -> list[tuple[str, str | None]]:
    return [(record.name, record.reason) for record in records]


def test_builds_what_it_can_names_the_rest_and_goes_on_where_it_stopped(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    good = box_sources(tmp_path / "cad")
    broken = tmp_path / "cad" / "broken.stl"
    broken.write_bytes(good[0].path.read_bytes()[:-10])
    sources = [
        good[0],
        Source("broken", "train", broken),
        CrashingSource("crashing", "test", good[0].path),
        good[1],
    ]
    folder = tmp_path / "pack"
    records = {record.name: record for record in build_pack(folder, sources, CONFIG, workers=2, licence="ours")}
    assert list(records) == [source.name for source in sources]
    assert "is truncated" in str(records["broken"].reason)
    assert "its process ended (exit code 3)" in str(records["crashing"].reason)
    assert "rejected crashing" in capfd.readouterr().out
    pack = Pack(folder)
    assert pack.names() == ["box0", "box1"]
    assert pack.problems() == []
    assert pack.manifest["licence"] == "ours"
    assert [entry["name"] for entry in pack.manifest["rejected"]] == ["broken", "crashing"]
    assert [len(drop.scene.T_bin_object) for drop in pack.load("box0").drops] == [1, 2]
    facts = records["box0"].facts
    assert facts is not None
    assert max(facts["penetrations"]) < 0.003

    # A second call makes only what is new, and the files of the first stay as they are.
    before = {name: (folder / name).stat().st_mtime_ns for name in contents(folder) if name != "manifest.json"}
    again = build_pack(folder, [*sources, good[2]], CONFIG, workers=1)
    assert seconds_apart(again[:4]) == seconds_apart(list(records.values()))
    assert Pack(folder).names() == ["box0", "box1", "box2"]
    assert {name: (folder / name).stat().st_mtime_ns for name in before} == before

    # What was rejected is tried again only when that is asked for, what was lost always; the rest stays listed.
    broken.write_bytes(good[0].path.read_bytes())
    (folder / "visibility" / "box1.safetensors").unlink()
    mended = build_pack(folder, [sources[1], sources[3]], CONFIG, workers=1, retry_rejected=True)
    assert seconds_apart(mended) == [("broken", None), ("box1", None)]
    assert Pack(folder).names() == ["box0", "box1", "box2", "broken"]
    assert Pack(folder).problems() == []

    with pytest.raises(InputError, match="records a build by another recipe"):
        build_pack(folder, sources, PackConfig(surfels=256, drops=2, copies=(1, 2)))


def test_gives_up_an_object_that_takes_too_long(tmp_path: Path) -> None:
    sources = [HangingSource("hanging", "train", box_sources(tmp_path, 1)[0].path)]
    records = build_pack(tmp_path / "pack", sources, CONFIG, workers=1, minutes_per_object=0.05)
    assert records[0].reason == "took over 3 s"
    assert Pack(tmp_path / "pack").names() == []


def test_survives_kill_9_and_ends_with_the_same_files(tmp_path: Path) -> None:
    sources = box_sources(tmp_path / "cad", 3)
    build_pack(tmp_path / "whole", sources, CONFIG, workers=2)
    script = (
        "from pathlib import Path\n"
        "from tests.data.test_build import CONFIG, box_sources\n"
        "from kmn_jax.data._build import build_pack\n"
        "if __name__ == '__main__':\n"
        f"    folder = Path({str(tmp_path)!r})\n"
        "    build_pack(folder / 'killed', box_sources(folder / 'cad', 3), CONFIG, workers=1)\n"
    )
    (tmp_path / "build.py").write_text(script)
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "build.py")], env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=tmp_path
    )
    journal = tmp_path / "killed" / "journal.jsonl"
    deadline = time.monotonic() + 120
    while not (journal.exists() and journal.read_bytes().count(b"\n") >= 2):
        assert process.poll() is None, "the build ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = journal.read_bytes().count(b"\n") - 1
    assert done < 3
    # What a write cut short would leave: half a line, and a file without one.
    with journal.open("ab") as file:
        file.write(b'{"name": "box2", "spl')
    (tmp_path / "killed" / "objects" / "box2.safetensors").write_bytes(b"half")
    build_pack(tmp_path / "killed", sources, CONFIG, workers=1)
    assert len(journal.read_bytes().splitlines()) == 4
    assert contents(tmp_path / "killed") == contents(tmp_path / "whole")


def test_refuses_what_cannot_be_built_before_it_starts(tmp_path: Path) -> None:
    sources = box_sources(tmp_path / "cad", 1)
    with pytest.raises(InputError, match="1 sources have the name of another"):
        build_pack(tmp_path / "pack", sources * 2, CONFIG)
    absent = Source("absent", "train", tmp_path / "absent.stl")
    with pytest.raises(InputError, match=r"absent\.stl is missing: nothing was built"):
        build_pack(tmp_path / "pack", [*sources, absent], CONFIG)
    with pytest.raises(InputError, match="workers = -1 must be 1 or more"):
        build_pack(tmp_path / "pack", sources, CONFIG, workers=-1)
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="file/pack cannot be written to"):
        build_pack(tmp_path / "file" / "pack", sources, CONFIG)
    (tmp_path / "pack").mkdir()
    journal = tmp_path / "pack" / "journal.jsonl"
    _Journal(journal, CONFIG)
    begin = journal.read_bytes()
    other = b'{"name": ["a"], "split": "train", "seconds": 1, "reason": "b", "entry": null}'
    endless = other.replace(b'["a"]', b'"a"').replace(b"1", b"NaN")
    rows = (b"3", b"{}", b'{"entry": 3}', b'{"entry": null}', other, endless)
    for content in (b"nonsense", *(begin + row for row in rows)):
        journal.write_bytes(content + b"\n")
        with pytest.raises(InputError, match=r"journal\.jsonl is damaged"):
            build_pack(tmp_path / "pack", sources, CONFIG)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"surfels": 100}, "multiples of 8"),
        ({"drops": -1}, "drops = -1 must be 0 or more"),
        ({"copies": (3, 2)}, r"copies = \(3, 2\) a range"),
        ({"copies": (1, 300)}, "within 1 to 255"),
    ],
)
def test_refuses_a_recipe_that_cannot_be(fields: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PackConfig(**fields)


def test_published_range_of_copies() -> None:
    assert PackConfig().copies_per_drop.tolist() == list(range(1, 21))
    assert PackConfig(drops=3, copies=(2, 4)).copies_per_drop.tolist() == [2, 3, 4]


def test_sources_of_one_file_may_have_other_scenes(tmp_path: Path) -> None:
    (source,) = box_sources(tmp_path / "cad", 1)
    again = Source("again", "train", source.path)
    other = Source("other", "validation", source.path, scenes=1)
    build_pack(tmp_path / "pack", [source, again, other], CONFIG, workers=1)
    pack = Pack(tmp_path / "pack")
    first, same, different = (pack.load(name).drops[0].scene.T_bin_object for name in ("box0", "again", "other"))
    np.testing.assert_array_equal(first, same)
    assert np.abs(first - different).max() > 1e-3
