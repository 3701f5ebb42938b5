from __future__ import annotations

import fcntl
import os
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.files import check_outputs, read_safetensors, safetensors_bytes, write_whole


def test_file_appears_whole_and_replaces(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    for content in (b"first", b"second"):
        write_whole(path, content)
        assert path.read_bytes() == content
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


def test_nothing_is_left_when_it_fails(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        write_whole(tmp_path / "missing" / "a.bin", b"x")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="cannot write"):
        write_whole(tmp_path / "folder", b"x")
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_links_are_followed_and_modes_kept(tmp_path: Path) -> None:
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "real").chmod(0o640)
    (tmp_path / "link").symlink_to("real")
    write_whole(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes() == b"new"
    assert stat.S_IMODE((tmp_path / "real").stat().st_mode) == 0o640
    before = os.umask(0o027)
    try:
        write_whole(tmp_path / "fresh", b"new")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "fresh").stat().st_mode) == 0o640


def test_devices_and_pipes_are_written_to(tmp_path: Path) -> None:
    write_whole(os.devnull, b"x")
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)
    pipe, got = tmp_path / "pipe", list[bytes]()
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()))
    reader.start()
    write_whole(pipe, b"through")
    reader.join(timeout=20)
    assert got == [b"through"]
    assert [p.name for p in tmp_path.iterdir()] == ["pipe"]
    read, write = os.pipe()  # which has no other name, as stdout and what shells substitute
    check_outputs((Path(f"/dev/fd/{write}"),))
    write_whole(f"/dev/fd/{write}", b"through")
    assert os.read(read, 100) == b"through"
    os.close(read)
    os.close(write)


def test_names_of_many_bytes_leave_room_for_what_stands_beside(tmp_path: Path) -> None:
    path = tmp_path / ("\u90e8" * 85)
    write_whole(path, b"whole")
    assert path.read_bytes() == b"whole"


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    program = (
        "import os, pathlib, signal, sys; from kmn_jax.files import write_whole\n"
        "pathlib.Path.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)\n"
        "write_whole(sys.argv[1], b'half')\n"
    )
    subprocess.run([sys.executable, "-c", program, tmp_path / "a.bin"], check=False)
    assert not (tmp_path / "a.bin").exists()
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".a.bin.")
    other = tmp_path / f".a.bin.txt.{'0' * 16}"
    other.write_bytes(b"of another target")
    folder = tmp_path / f".a.bin.{'1' * 16}"  # which is not of this making, nor a link
    folder.mkdir()
    link = tmp_path / f".a.bin.{'2' * 16}"
    link.symlink_to(other)
    write_whole(tmp_path / "a.bin", b"too soon to tell")
    assert left.exists()
    for path in (left, other, folder):
        os.utime(path, (time.time() - 60,) * 2)
    with left.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        write_whole(tmp_path / "a.bin", b"another process is at it")
        assert left.exists()
    write_whole(tmp_path / "a.bin", b"whole")
    assert {path.name for path in tmp_path.iterdir()} == {"a.bin", other.name, folder.name, link.name}
    assert (tmp_path / "a.bin").read_bytes() == b"whole"


def test_a_file_is_locked_until_it_is_in_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = list[bool]()

    def replace(self: Path, target: Path) -> None:
        with self.open("rb") as file, pytest.raises(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        seen.append(self.read_bytes() == b"whole")

    monkeypatch.setattr(Path, "replace", replace)
    write_whole(tmp_path / "a.bin", b"whole")
    assert seen == [True]


def test_what_cannot_be_written_is_told_before(tmp_path: Path) -> None:
    source = tmp_path / "part.stl"
    source.write_bytes(b"x")
    (tmp_path / "link").symlink_to(source)
    check_outputs((tmp_path / "other", None, Path(os.devnull), Path(os.devnull)), source, None, tmp_path / "none")
    for target, text in (
        (source, "read, too"),
        (tmp_path / "link", "read, too"),
        (tmp_path / "no" / "a", "its folder does not exist"),
        (tmp_path, "it is a folder"),
        (tmp_path / ("a" * 300), "name too long"),
        (tmp_path / ".." / tmp_path.name / "other", "another result, too"),
    ):
        with pytest.raises(InputError, match=text):
            check_outputs((tmp_path / "other", target), source, tmp_path / ("b" * 300))


def test_tensors_beyond_the_budget_and_pipes_are_not_read(tmp_path: Path) -> None:
    with (tmp_path / "large").open("wb") as file:
        file.truncate(2_000_000_001)  # without a byte on the disk
    os.mkfifo(tmp_path / "pipe")  # nobody writes to it
    for name, message in (
        ("large", "takes 2000000001 bytes"),
        ("pipe", "not a regular file"),
        ("no", "not a readable"),
    ):
        with pytest.raises(InputError, match=message):
            read_safetensors(tmp_path / name)


def test_the_same_tensors_make_the_same_bytes(tmp_path: Path) -> None:
    tensors = {"b": np.arange(6.0).reshape(2, 3), "a": np.ones((0, 3), np.float32), "c": np.arange(3, dtype=np.uint8)}
    metadata = {name: f'"{name}" \u00fc\n' for name in "hgfedcba"}
    contents = {safetensors_bytes(tensors, metadata) for _ in range(20)}
    assert len(contents) == 1
    (tmp_path / "x.safetensors").write_bytes(contents.pop())
    found, facts = read_safetensors(tmp_path / "x.safetensors")
    assert facts == metadata
    assert found.keys() == tensors.keys()
    assert all((found[name] == tensor).all() and found[name].dtype == tensor.dtype for name, tensor in tensors.items())
