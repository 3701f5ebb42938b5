"""STEP files that refer to other files, as assemblies of several files do."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.io import read_mesh
from tests.io.mesh_sample import STEP

PLAIN = b"#5 = PRODUCT_DEFINITION('design','',#6,#9);"
REFERRING = """#5 = PRODUCT_DEFINITION_WITH_ASSOCIATED_DOCUMENTS('design','',#6,#9,(#9001));
#9001 = DOCUMENT_FILE('{file}','','',#9002,'',$);
#9002 = DOCUMENT_TYPE('geometry');
#9003 = APPLIED_EXTERNAL_IDENTIFICATION_ASSIGNMENT('{file}',#9004,(#9001),#9005);
#9004 = IDENTIFICATION_ROLE('external document id and location',$);
#9005 = EXTERNAL_SOURCE(IDENTIFIER(''));
#9006 = DOCUMENT_REPRESENTATION_TYPE('digital',#9001);
#9007 = PROPERTY_DEFINITION('external definition',$,#9001);"""
IN_OPEN, IN_NONBLOCK = 0x20, 0o4000


@contextmanager
def opened(path: Path) -> Iterator[list[bool]]:
    """Tell, when it is over, whether any process has opened a file."""
    handle, found = ctypes.CDLL(None).inotify_init1(IN_NONBLOCK), list[bool]()
    assert ctypes.CDLL(None).inotify_add_watch(handle, os.fsencode(path), IN_OPEN) >= 0
    try:
        yield found
        try:
            found.append(bool(os.read(handle, 4096)))
        except BlockingIOError:
            found.append(False)
    finally:
        os.close(handle)


@pytest.mark.skipif(sys.platform != "linux", reason="who opens a file can be watched on Linux only")
@pytest.mark.parametrize("place", ["absolute", "beside"])
def test_files_that_a_step_file_refers_to_are_not_read(place: str, tmp_path: Path) -> None:
    assert PLAIN in STEP
    other, path = tmp_path / "other.step", tmp_path / "assembly.step"
    other.write_bytes(STEP.replace(b"(-10.,", b"(-90.,"))
    with opened(other) as control:
        other.read_bytes()
    assert control == [True]
    file = str(other) if place == "absolute" else other.name
    path.write_bytes(STEP.replace(PLAIN, REFERRING.format(file=file).encode()))
    with opened(other) as found:
        try:
            size = np.ptp(read_mesh(path).vertices, axis=0)
        except InputError:  # what refers to others may be refused
            size = np.array([0.02, 0.01, 0.005])
    assert found == [False]
    np.testing.assert_allclose(size, [0.02, 0.01, 0.005], atol=1e-9)
