import re
import struct
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.io import _apart, _step, read_mesh
from tests.io.mesh_sample import CLOUDS, MESHES, POLYGONS_PLY, STEP, whole_files, written


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    return whole_files(tmp_path_factory.mktemp("valid"))


@pytest.fixture(autouse=True)
def silent(capfd, caplog):
    """Whatever a file holds, readers leave the user's terminal alone."""
    yield
    assert tuple(capfd.readouterr()) == ("", "")
    assert caplog.records == []


def refused(path, match=""):
    with pytest.raises(InputError) as caught:
        read_mesh(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert re.search(match, message), message
    return message


def test_paths_that_are_no_files(tmp_path, monkeypatch):
    refused(tmp_path / "missing.stl", "No such file")
    (tmp_path / "folder.stl").mkdir()
    refused(tmp_path / "folder.stl", "is a folder")
    refused(tmp_path / "folder.stl" / "part.stl", "No such file")
    refused(written(tmp_path, "file.stl", "x") / "part.stl", "Not a directory")
    refused(tmp_path / ("a" * 300 + ".stl"), "File name too long")
    with pytest.raises(InputError, match="null"):
        read_mesh("a\0.stl")
    path = written(tmp_path, "secret.stl", "x")
    monkeypatch.setattr(Path, "read_bytes", lambda _: (_ for _ in ()).throw(PermissionError(13, "Permission denied")))
    refused(path, "Permission denied")


@pytest.mark.skipif(not Path("/dev/null").is_char_device(), reason="no device files here")
def test_devices_are_not_read(tmp_path):
    (tmp_path / "endless.stl").symlink_to("/dev/zero")
    refused(tmp_path / "endless.stl", "not a regular file")


@pytest.mark.parametrize("name", ["a.wrl", "a", "a.stl.gz", "a.3mf"])
def test_unknown_formats(name, tmp_path):
    refused(written(tmp_path, name, b"x"), "use one of .stl, .obj, .ply, .glb, .step, .stp, .pcd, .xyz, .xyzn")


@pytest.mark.parametrize("name", MESHES + CLOUDS)
def test_empty_and_foreign_content(name, valid, tmp_path):
    refused(written(tmp_path, name, b""), r"empty \(0 bytes\)")
    png = b"\x89PNG\r\n\x1a\n" + np.random.default_rng(1).bytes(3000)
    for content in (png, b"\0" * 1000, b"hello, this is not a CAD file\n" * 30, b"\n", b"\xff\xfe", b"solid", b"ply\n"):
        refused(written(tmp_path, name, content))
    for other, content in valid.items():  # renamed files
        if Path(other).suffix != Path(name).suffix and {Path(other).suffix, Path(name).suffix} != {".xyz", ".xyzn"}:
            refused(written(tmp_path, name, content))


@pytest.mark.parametrize("name", [name for name in MESHES + CLOUDS if name not in ("mesh.obj", "cloud.xyz")])
def test_truncated_files(name, valid, tmp_path):
    content = valid[name] if "binary" in name or "compressed" in name else valid[name].rstrip()
    fewer = 4 if name.startswith("solid") else 12
    # Whole lines of a table may be missing without a trace; a cut within a number leaves a number.
    cuts = [len(content) - 1 - 17 * i for i in range(fewer)] + [len(content) * i // fewer for i in range(1, fewer)]
    for cut in cuts:
        if name == "cloud.xyzn":
            cut = content.rindex(b" ", 0, cut)
            if content.count(b" ", content.rindex(b"\n", 0, cut), cut) >= 5:
                continue
        elif name in ("text.ply", "text_cloud.ply", "text.pcd"):
            cut = content.rindex(b" ", 0, cut)
        refused(written(tmp_path, name, content[:cut]))


def test_truncated_obj(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4"
    refused(written(tmp_path, "a.obj", text[:-2]), r"line 6 is not a face: 'f 1 2'")
    refused(written(tmp_path, "a.obj", text[:-4]), "line 6 is not a face")
    refused(written(tmp_path, "a.obj", text[:29]), r"line 4 is not a vertex: 'v 0 0'")
    refused(written(tmp_path, "a.obj", text[:31]), "no triangles")
    refused(written(tmp_path, "a.xyz", "0 0 1\n0 0 2\n0 1"), "number of columns changed from 3 to 2 at row 3")


STL_FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
DAMAGED = {
    "count.stl": (lambda v: v["binary.stl"] + b"\0" * 10, "announces 12 triangles, which take 684"),
    "nan.stl": (
        lambda v: v["binary.stl"][:96] + struct.pack("<f", np.nan) + v["binary.stl"][100:],
        "1 of 36 vertices are NaN, infinite .* number 0",
    ),
    "none.stl": (lambda _: b"\0" * 84, "no triangles"),
    "no_facets.stl": (lambda _: "solid a\nendsolid a\n", "no triangles"),
    "word.stl": (lambda _: f"solid\n{STL_FACET.replace('1 0 0', '1 O 0')}endsolid", "could not convert"),
    "short.stl": (lambda _: f"solid\n{STL_FACET}{STL_FACET.replace('1 0 0', '1 0')}endsolid", "three numbers each"),
    "four.stl": (lambda _: f"solid\n{STL_FACET.replace('endloop', 'vertex 1 1 1' + chr(10) + 'endloop')}endsolid", ""),
    "cut.stl": (lambda _: f"solid\n{STL_FACET}{STL_FACET[:60]}\nendsolid", "three numbers each"),
    "nan_text.stl": (lambda _: f"solid\n{STL_FACET.replace('1 0 0', '1 nan inf')}endsolid", "NaN"),
    "nan.obj": (lambda _: "v 0 nan 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "1 of 3 vertices are NaN"),
    "huge.obj": (lambda _: "v 0 1e300 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "beyond 1e[+]18"),
    "beyond.obj": (lambda _: "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "vertices from 0 to 3, but there are 0 to 2"),
    "before.obj": (lambda _: "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n", "vertices from -1 to 1"),
    "zero.obj": (lambda _: "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 0\n", "line 4"),
    "large.obj": (lambda _: "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999\n", "line 4"),
    "edge.obj": (lambda _: "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n", "line 4"),
    "points.obj": (lambda _: "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles"),
    "flat.obj": (lambda _: "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "line 1"),
    "beyond.ply": (lambda _: POLYGONS_PLY.replace("3 0 1 4 8", "3 0 1 5 8"), "vertices from 0 to 5"),
    "negative.ply": (lambda _: POLYGONS_PLY.replace("3 0 1 4 8", "3 0 1 -1 8"), "vertices from -1 to 3"),
    "fraction.ply": (lambda _: POLYGONS_PLY.replace("3 0 1 4 8", "3 0 1.5 1 8"), "whole number"),
    "long.ply": (lambda _: POLYGONS_PLY.replace("3 0 1 4 8", "1e30 0 1 4 8"), "a list of face has 1e[+]30 entries"),
    "less.ply": (lambda _: POLYGONS_PLY.replace("3 0 1 4 8", "-1 0 1 4 8"), "a list of face has -1.0 entries"),
    "more.ply": (lambda _: POLYGONS_PLY + "1 2 3", "more data than its header announces"),
    "word.ply": (lambda _: POLYGONS_PLY.replace("1.5", "high"), "could not convert"),
    "many.ply": (lambda _: POLYGONS_PLY.replace("vertex 5", "vertex 5000000000000"), "fewer than the 5000000000000"),
    "faces.ply": (lambda _: POLYGONS_PLY.replace("face 2", "face 5000000000000"), "fewer than the 5000000000000"),
    "strips.ply": (lambda _: POLYGONS_PLY.replace("vertex_indices", "strips"), "no lists of three or more"),
    "type.ply": (lambda _: POLYGONS_PLY.replace("double x", "real x"), "a line that is not PLY: 'property real x'"),
    "twice.ply": (lambda _: POLYGONS_PLY.replace("double y", "double x"), "twice"),
    "flat.ply": (lambda _: POLYGONS_PLY.replace("double z", "double w"), "no vertices with x, y and z"),
    "format.ply": (lambda _: POLYGONS_PLY.replace("format ascii 1.0\n", ""), "no format line"),
    "nan.ply": (lambda _: POLYGONS_PLY.replace("0 0 1.5", "0 nan 1.5"), "1 of 5 vertices are NaN"),
    "none.ply": (lambda _: "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "no vertices"),
    "json.glb": (lambda v: v["mesh.glb"].replace(b'"accessors"', b'"accessorz"'), "damaged"),
    "length.glb": (lambda v: v["mesh.glb"] + b"\0", "truncated, or not a GLB"),
    "nan.glb": (lambda v: v["mesh.glb"].replace(struct.pack("<f", 11), struct.pack("<f", np.nan)), "NaN"),
    "self.step": (lambda _: re.sub(rb"(#\d+) = VECTOR\('',#\d+", rb"\1 = VECTOR('',\1", STEP), "ended with code"),
    "syntax.step": (lambda _: STEP.replace(b"CLOSED_SHELL('',(", b"CLOSED_SHELL('',"), ""),
    "hollow.step": (lambda _: STEP.partition(b"DATA;")[0] + b"DATA;\nENDSEC;\nEND-ISO-10303-21;\n", "nothing to read"),
    "cut.step": (lambda _: STEP[: len(STEP) // 2] + b"\nENDSEC;\nEND-ISO-10303-21;\n", "damaged"),
    "nan.xyz": (lambda _: "0 0 0\n1 nan 1\n2 2 2\n", "1 of 3 vertices are NaN, .* number 1"),
    "words.xyz": (lambda _: "x y z\n0 0 0\n", "could not convert string 'x'"),
    "commas.xyz": (lambda _: "0,0,0\n", "could not convert"),
    "narrow.xyz": (lambda _: "0 0\n1 1\n", "2 numbers a line, but 3 are needed"),
    "narrow.xyzn": (lambda _: "0 0 0\n1 1 1\n", "3 numbers a line, but 6 are needed"),
    "comment.xyz": (lambda _: "# nothing\n", "there are no points"),
    "more.pcd": (lambda v: v["binary.pcd"] + b"\0\0", "30 points take 720 bytes, but there are 722"),
    "type.pcd": (lambda v: v["binary.pcd"].replace(b"TYPE F", b"TYPE X"), "damaged"),
    "size.pcd": (lambda v: v["binary.pcd"].replace(b"SIZE 4", b"SIZE 3"), "damaged"),
    "flat.pcd": (lambda v: v["binary.pcd"].replace(b"FIELDS x", b"FIELDS w"), "no x, y and z"),
    "many.pcd": (lambda v: v["compressed.pcd"].replace(b"POINTS 30", b"POINTS 3000000000"), "do not hold 3000000000"),
    "minus.pcd": (lambda v: v["text.pcd"].replace(b"POINTS 30", b"POINTS -1"), "damaged"),
    "data.pcd": (lambda v: v["binary.pcd"].replace(b"DATA binary", b"DATA zip"), "damaged"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files(name, valid, tmp_path):
    make, match = DAMAGED[name]
    refused(written(tmp_path, name, make(valid)), match)


def test_a_converter_that_hangs_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(_step, "_PROGRAM", "import time; print('noise'); time.sleep(600)")
    monkeypatch.setattr(_apart, "_SECONDS", 0.5)
    refused(written(tmp_path, "a.step", STEP), r"longer than 0.5 s: save it in another format")


def test_working_folder_cannot_replace_the_converter(tmp_path, monkeypatch):
    (tmp_path / "cascadio.py").write_text("raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    assert len(read_mesh(written(tmp_path, "a.step", STEP)).triangles) == 12
