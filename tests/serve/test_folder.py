"""What a server that was killed left in the folder for temporary files is removed by the next one."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import pytest

from kmn_jax.serve._folder import private_folder


@pytest.mark.skipif(sys.platform == "win32", reason="it cannot tell whose folders are in use")
def test_what_killed_servers_left_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with private_folder() as running:
        tempfile.tempdir = str(tmp_path)  # as in another process
        left, just_made, other = (tmp_path / name for name in ("kmn-serve-left", "kmn-serve-new", "another"))
        for folder in (left, just_made, other):
            (folder / "upload").mkdir(parents=True)
            (folder / "upload" / "scan.ply").write_bytes(b"half")
        link, file = tmp_path / "kmn-serve-link", tmp_path / "kmn-serve-file"
        link.symlink_to(other)
        file.touch()
        for path in (running, left, other, file):
            os.utime(path, (0, 0))
        with private_folder() as second:
            assert tempfile.gettempdir() == str(second)
            assert set(tmp_path.iterdir()) == {running, just_made, other, link, file, second}
            assert (other / "upload" / "scan.ply").read_bytes() == b"half"
    assert not running.exists()
    assert not second.exists()
