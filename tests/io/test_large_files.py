"""Readers take seconds for large files, however these are made, and little more memory than the files."""

from __future__ import annotations

import struct
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.io import _text, read_mesh
from kmn_jax.io._lzf import unpack_lzf
from kmn_jax.io._text import parse_numbers
from tests.io.mesh_sample import written


def test_text_takes_little_more_than_its_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_text, "_PIECE", 10_000)
    text = b"12 " * 100_000
    tracemalloc.start()
    try:
        assert parse_numbers(text).sum() == 1_200_000
        # The numbers and their pieces take 1.6 MB; all words at once would take 5.6.
        assert tracemalloc.get_traced_memory()[1] < 3_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("token", "piece"), [(b"\x20\x02", 3), (b"\xe0\xff\x02", 264), (b"\xe0\x00\x02", 9)])
def test_lzf_in_matches_of_any_length(token: bytes, piece: int) -> None:
    number = 30_000
    size = 3 + number * piece
    assert unpack_lzf(b"\x02abc" + token * number, size) == (b"abc" * size)[:size]
    for wrong in (size - 1, size + 1):
        with pytest.raises(ValueError, match="not the LZF of"):
            unpack_lzf(b"\x02abc" + token * number, wrong)


@pytest.mark.parametrize(("count", "code"), [("uchar", "B"), ("int", "i")])
def test_ply_of_mixed_polygons(count: str, code: str, tmp_path: Path) -> None:
    """Each face took forty microseconds where a quad follows a triangle follows a quad."""
    number = 100_000
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_big_endian 1.0\nelement vertex 4\n{names}"
    header += f"element face {2 * number}\nproperty uchar colour\n"
    header += f"property list {count} int vertex_indices\nproperty list {count} float texcoord\nend_header\n"
    pair = struct.pack(f">B{code}3i{code}2f", 7, 3, 0, 1, 2, 2, 0.5, 0.5) + struct.pack(
        f">B{code}4i{code}", 8, 4, 3, 2, 1, 0, 0
    )
    content = header.encode() + np.arange(12, dtype=">f4").tobytes() + pair * number
    path = written(tmp_path, "a.ply", content)
    start = time.process_time()
    mesh = read_mesh(path)
    assert time.process_time() - start < 5
    np.testing.assert_array_equal(mesh.triangles[-3:], [[0, 1, 2], [3, 2, 1], [3, 1, 0]])
    assert len(mesh.triangles) == 3 * number
