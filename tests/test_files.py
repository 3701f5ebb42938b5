from __future__ import annotations

import os
import stat
import threading
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.files import check_output, read_safetensors, safetensors_bytes, write_whole


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


def test_what_cannot_be_written_is_told_before(tmp_path: Path) -> None:
    source = tmp_path / "part.stl"
    source.write_bytes(b"x")
    (tmp_path / "link").symlink_to(source)
    check_output(tmp_path / "other", source, None, tmp_path / "none")
    check_output(Path(os.devnull), source)
    for target, text in (
        (source, "read, too"),
        (tmp_path / "link", "read, too"),
        (tmp_path / "no" / "a", "its folder does not exist"),
        (tmp_path, "it is a folder"),
    ):
        with pytest.raises(InputError, match=text):
            check_output(target, source)


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
