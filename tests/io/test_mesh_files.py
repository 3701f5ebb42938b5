import json
import struct

import numpy as np
import open3d
import pytest
import trimesh

from kmn_jax.errors import InputError
from kmn_jax.io import read_mesh
from kmn_jax.units import METRES, check_unit
from tests.io.mesh_sample import (
    BOX,
    CLOUDS,
    MESHES,
    NORMALS,
    POINTS,
    POLYGONS_PLY,
    STEP,
    cloud_bytes,
    whole_files,
    written,
)


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    return whole_files(tmp_path_factory.mktemp("valid"))


@pytest.fixture(autouse=True)
def silent(capfd, caplog):
    """Whatever a file holds, readers leave the user's terminal alone."""
    yield
    assert tuple(capfd.readouterr()) == ("", "")
    assert caplog.records == []


def corners(mesh):
    return mesh.vertices[mesh.triangles]


@pytest.mark.parametrize("name", MESHES[:-1])
def test_mesh_formats_give_the_same_triangles(name, valid, tmp_path):
    mesh = read_mesh(written(tmp_path, name, valid[name]))
    np.testing.assert_allclose(corners(mesh), BOX.vertices[BOX.faces], atol=1e-6)
    assert mesh.normals is None
    assert mesh.unit == ("m" if name.endswith("glb") else "mm")
    upper = written(tmp_path, name.upper(), valid[name])
    np.testing.assert_array_equal(corners(read_mesh(upper)), corners(mesh))


@pytest.mark.parametrize(
    ("unit", "metres", "suffix"), [(".MILLI.", 0.001, ".step"), (".CENTI.", 0.01, ".stp"), ("$", 1.0, ".STEP")]
)
def test_step_files_state_their_unit(unit, metres, suffix, tmp_path):
    content = STEP.replace(b"SI_UNIT(.MILLI.,.METRE.)", f"SI_UNIT({unit},.METRE.)".encode())
    mesh = read_mesh(written(tmp_path, f"box{suffix}", content))
    assert mesh.unit == "m"
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), np.array([20, 10, 5]) * metres, rtol=1e-6)
    triangles = corners(mesh)
    volume = np.einsum("ti,ti->", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6
    np.testing.assert_allclose(volume, 1000 * metres**3, rtol=1e-5)


@pytest.mark.parametrize("name", CLOUDS)
def test_cloud_formats_give_the_same_points(name, valid, tmp_path):
    cloud = read_mesh(written(tmp_path, name, valid[name]))
    assert cloud.triangles.shape == (0, 3)
    assert cloud.unit == "mm"
    np.testing.assert_allclose(cloud.vertices, POINTS, atol=1e-6)
    if name == "cloud.xyz":
        assert cloud.normals is None
    else:
        np.testing.assert_allclose(cloud.normals, NORMALS, atol=1e-6)


@pytest.mark.parametrize("options", [{}, {"write_ascii": True}, {"compressed": True}])
@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_clouds_without_normals(suffix, options, tmp_path):
    cloud = read_mesh(written(tmp_path, f"cloud{suffix}", cloud_bytes(tmp_path, suffix, normals=False, **options)))
    np.testing.assert_allclose(cloud.vertices, POINTS, atol=1e-6)
    assert cloud.normals is None


def test_compressed_cloud_with_repeats(tmp_path):
    """Long runs of equal bytes are stored as pieces that overlap what they yield."""
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.tile([[1.0, 2, 3], [1, 5, 3]], (3000, 1))))
    open3d.io.write_point_cloud(str(tmp_path / "runs.pcd"), cloud, compressed=True)
    assert (tmp_path / "runs.pcd").stat().st_size < 5000
    np.testing.assert_array_equal(read_mesh(tmp_path / "runs.pcd").vertices, np.asarray(cloud.points))


def test_text_variants_of_obj(tmp_path):
    text = (
        "# made by hand\r\nmtllib not_there.mtl\ro \u00c5\n"
        "\tv\t0 0 0 1.0\nv 1 0 0 # corner\nv 1 1 \\\n0\nv 0 1 0 0.5 0.5 0.5\nvt 0 0\nvn 0 0 1\n"
        "usemtl steel\nf 1/1/1 2//1 3/1 4\ng second\nv 0 0 1\nusemtl brass\nf -5 2 -1\nl 1 2\n"
    )
    mesh = read_mesh(written(tmp_path, "a.obj", text))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(mesh.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 4]])


def test_text_variants_of_stl(tmp_path, valid):
    text = valid["text.stl"].decode()
    variants = [text.upper(), text.replace("\n", "\r\n"), text.replace("vertex", " \tvertex  "), f"\n{text}\n\0"]
    for variant in variants:
        mesh = read_mesh(written(tmp_path, "a.stl", variant))
        np.testing.assert_allclose(corners(mesh), BOX.vertices[BOX.faces], atol=1e-6)
    two = read_mesh(written(tmp_path, "two.stl", f"{text}\n{text}"))
    assert len(two.triangles) == 2 * len(BOX.faces)


def test_binary_stl_may_call_itself_solid(tmp_path, valid):
    content = b"solid made by a careless exporter".ljust(80) + valid["binary.stl"][80:]
    mesh = read_mesh(written(tmp_path, "a.stl", content))
    np.testing.assert_allclose(corners(mesh), BOX.vertices[BOX.faces], atol=1e-6)


@pytest.mark.parametrize("order", ["<", ">"])
def test_ply_polygons_and_extra_entries(order, tmp_path):
    text = read_mesh(written(tmp_path, "text.ply", POLYGONS_PLY))
    header = POLYGONS_PLY.partition("end_header\n")[0]
    encoding = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    body = b"".join(
        struct.pack(order + "B3d", 9, *xyz) for xyz in [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1.5)]
    )
    body += struct.pack(order + "2i", 0, 1)
    body += struct.pack(order + "B4iB", 4, 0, 1, 2, 3, 7) + struct.pack(order + "B3iB", 3, 0, 1, 4, 8)
    binary = read_mesh(written(tmp_path, "b.ply", header.replace("ascii", encoding).encode() + b"end_header\n" + body))
    for mesh in (text, binary):
        np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1.5]])
        np.testing.assert_array_equal(mesh.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 4]])


def test_glb_transforms_are_applied(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((1, 1, 1)), transform=np.diag([2, 3, 4, 1]))
    scene.add_geometry(trimesh.creation.box((1, 1, 1)), transform=trimesh.transformations.translation_matrix((9, 0, 0)))
    mesh = read_mesh(written(tmp_path, "a.glb", scene.export(file_type="glb")))
    assert len(mesh.triangles) == 24
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [-1, -1.5, -2])
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [9.5, 1.5, 2])


def test_units_are_explicit(tmp_path, valid):
    for unit in METRES:
        assert read_mesh(written(tmp_path, "a.stl", valid["binary.stl"]), unit).unit == unit
    assert read_mesh(written(tmp_path, "a.glb", valid["mesh.glb"]), "m").unit == "m"
    for name in ("mesh.glb", "solid.step"):
        with pytest.raises(InputError, match=r"in metres.*cannot be mm: leave it out"):
            read_mesh(written(tmp_path, name, valid[name]), "mm")
    for wrong in ("parsec", "MM", ""):
        with pytest.raises(InputError, match="use one of m, cm, mm, in"):
            read_mesh(tmp_path / "a.stl", wrong)
    assert check_unit("cm") == "cm"


def two_primitives_glb():
    """Return a mesh of two triangles, of which only the first has a material."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]], "<f4")
    data = points.tobytes() + np.array([0, 1, 2, 0, 1, 2], "<u4").tobytes()
    views = [{"buffer": 0, "byteOffset": start, "byteLength": size} for start, size in ((0, 36), (36, 36), (72, 12))]
    vectors = {"componentType": 5126, "count": 3, "type": "VEC3"}
    accessors = [{**vectors, "bufferView": view, "min": [0, 0, 0], "max": [1, 1, 1]} for view in (0, 1)]
    accessors.append({"bufferView": 2, "componentType": 5125, "count": 3, "type": "SCALAR"})
    primitives = [{"attributes": {"POSITION": part}, "indices": 2} for part in (0, 1)]
    primitives[0]["material"] = 0
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    head = json.dumps(document).encode()
    head += b" " * (-len(head) % 4)
    total = 12 + 8 + len(head) + 8 + len(data)
    chunks = struct.pack("<I4s", len(head), b"JSON") + head + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, total) + chunks, points.reshape(2, 3, 3)


def test_glb_whose_primitives_have_different_materials(tmp_path):
    content, triangles = two_primitives_glb()
    found = corners(read_mesh(written(tmp_path, "part.glb", content)))
    np.testing.assert_array_equal(found[np.argsort(found[:, 0, 2])], triangles)
