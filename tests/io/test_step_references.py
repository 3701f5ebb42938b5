"""STEP files that refer to other files, as assemblies of several files do."""

from __future__ import annotations

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


@pytest.mark.parametrize("place", ["absolute", "beside"])
def test_files_that_a_step_file_refers_to_are_not_read(place: str, tmp_path: Path) -> None:
    assert PLAIN in STEP
    other = tmp_path / "other.step"
    other.write_bytes(STEP.replace(b"(-10.,", b"(-90.,"))
    before = other.stat().st_mtime_ns
    assert other.read_bytes() != STEP
    file = str(other) if place == "absolute" else other.name
    path = tmp_path / "assembly.step"
    path.write_bytes(STEP.replace(PLAIN, REFERRING.format(file=file).encode()))
    try:
        found = read_mesh(path)
    except InputError as error:
        assert "\n" not in str(error)  # noqa: PT017  (either is right: the file is not read as if it were whole)
    else:
        np.testing.assert_allclose(np.ptp(found.vertices, axis=0), [0.02, 0.01, 0.005], atol=1e-9)
    assert other.stat().st_mtime_ns == before
