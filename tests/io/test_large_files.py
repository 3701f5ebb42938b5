"""Readers take seconds for large files, however these are made, and little more memory than the files."""

from __future__ import annotations

import struct
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.io import read_mesh
from kmn_jax.io._lzf import unpack_lzf
from kmn_jax.io._text import parse_numbers
from tests.io.mesh_sample import written


def test_text_takes_little_more_than_its_numbers() -> None:
    text = b"12 " * 1_000_000
    tracemalloc.start()
    try:
        assert parse_numbers(text).sum() == 12_000_000
        # The result and its pieces take 16 MB, the words of a piece 20; all words at once would take 56.
        assert tracemalloc.get_traced_memory()[1] < 45_000_000
    finally:
        tracemalloc.stop()


def test_lzf_in_short_matches_takes_a_second() -> None:
    packed = b"\x02abc" + b"\x20\x02" * 400_000
    start = time.process_time()
    assert unpack_lzf(packed, 3 + 1_200_000) == b"abc" * 400_001
    assert time.process_time() - start < 5


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
