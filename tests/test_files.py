from __future__ import annotations

from pathlib import Path

import pytest

from kmn_jax.errors import InputError
from kmn_jax.files import write_whole


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
