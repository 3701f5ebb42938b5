"""Small files that would become large ones: refused by what they announce, before memory or time is taken."""

from __future__ import annotations

import io
import json
import struct
import time
import tracemalloc
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from kmn_jax.bop import BopDataset, bop_scan
from kmn_jax.errors import InputError
from kmn_jax.io import read_mesh, read_scan
from kmn_jax.limits import SETTING
from tests.bop.bop_sample import write_sample
from tests.io.mesh_sample import STEP, written

FEW_BYTES = 30_000_000
CAMERA = json.dumps({"fx": 80.0, "fy": 82.0, "cx": 7.5, "cy": 5.5})


def refused(path: Path, message: str) -> None:
    read = read_mesh if path.suffix in (".glb", ".step", ".obj") else lambda name: read_scan(name, "mm", camera)
    camera = written(path.parent, "camera.json", CAMERA)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=message) as caught:
            read(path)
        assert tracemalloc.get_traced_memory()[1] < FEW_BYTES
    finally:
        tracemalloc.stop()
    assert str(caught.value).startswith(f"{path} cannot be used: ")
    assert len(str(caught.value)) < len(str(path)) + 300


def glb(nodes: list[dict[str, Any]], roots: list[int], count: int = 3, **changes: Any) -> bytes:
    """Return a GLB file of one mesh of triangles in many places."""
    points = np.random.default_rng(0).normal(size=(count, 3)).astype("<f4").tobytes()
    vectors = {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": roots}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "buffers": [{"byteLength": len(points)}],
        "bufferViews": [{"buffer": 0, "byteLength": len(points)}],
        "accessors": [{**vectors, "min": [-9, -9, -9], "max": [9, 9, 9]}],
    } | changes
    head = json.dumps(tree).encode()
    head += b" " * (-len(head) % 4)
    chunks = struct.pack("<I4s", len(head), b"JSON") + head + struct.pack("<I4s", len(points), b"BIN\0") + points
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def chain(length: int) -> list[dict[str, Any]]:
    return [{"mesh": 0, "children": [index + 1]} for index in range(length - 1)] + [{"mesh": 0}]


def views(number: int) -> list[dict[str, int]]:
    return [{"buffer": 0, "byteLength": 36_000}] * number


MADE_UP = {"componentType": 5126, "count": 30_000, "type": "MAT4"}
GLB = {
    "one mesh in many places": (glb([{"mesh": 0}] * 2000, list(range(2000)), 33_000), "it has 66033000 points"),
    "many nodes": (glb([{}] * 30_000, list(range(30_000))), "30000 and 1, are too many or too deep"),
    "a chain of nodes": (glb(chain(150), [0]), "nested deeper than 100 levels"),
    "many chains": (
        glb([{"children": [i + 1]} if (i + 1) % 90 else {} for i in range(9000)], list(range(0, 9000, 90))),
        "are too many or too deep",
    ),
    "a node within itself": (glb([{"mesh": 0, "children": [0]}], [0]), "nested deeper than 100 levels"),
    "one child of all": (
        glb([{"children": list(range(200, 400))}] * 200 + [{"mesh": 0}] * 200, list(range(200))),
        "are too many or too deep",
    ),
    "made up values": (glb([{"mesh": 0}], [0], accessors=[MADE_UP] * 2000), "takes .* bytes, more than 2000000000"),
    "one view many times": (glb([{"mesh": 0}], [0], 3000, bufferViews=views(60_000)), "bytes, more than 2000000000"),
    "many pieces of a mesh": (
        glb([{"mesh": 0}] * 3, [0, 1, 2], meshes=[{"primitives": [{"attributes": {"POSITION": 0}}] * 5100}]),
        "are too many or too deep",
    ),
    "fewer than none": (
        glb([{"mesh": 0}], [0], accessors=[MADE_UP | {"count": 3}, MADE_UP | {"count": -5}]),
        "fewer values than none",
    ),
    "deep JSON": (
        glb([{"extras": json.loads("[" * 80 + "]" * 80)}], [0]),
        "its header cannot be read: it is nested deeper than 64",
    ),
}


@pytest.mark.parametrize("name", GLB)
def test_glb_that_unfolds(name: str, tmp_path: Path) -> None:
    content, message = GLB[name]
    path = written(tmp_path, "a.glb", content)
    start = time.process_time()
    refused(path, message)
    assert time.process_time() - start < 10


def test_glb_of_a_few_places_is_read(tmp_path: Path) -> None:
    nodes = [{"mesh": 0, "translation": [10 * i, 0, 0]} for i in range(5)]
    mesh = read_mesh(written(tmp_path, "a.glb", glb([*nodes, {"children": list(range(5))}], [5])))
    assert len(mesh.triangles) == 5


def archive(how: int, **arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", how) as file:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.save(content, array)
            file.writestr(f"{name}.npy", content.getvalue())
    return buffer.getvalue()


def test_npz_of_several_arrays_shares_one_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).normal(size=(5000, 3))
    path = written(tmp_path, "a.npz", archive(zipfile.ZIP_STORED, points=points, normals=points))
    assert len(read_scan(path, "mm").points) == 5000
    monkeypatch.setenv(SETTING, "239000")  # each has 120 kB
    refused(path, "it takes 240... bytes, more than 239000")


@pytest.mark.parametrize("how", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_npz_compressed_in_ways_without_a_bound(how: int, tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    refused(written(tmp_path, "a.npz", archive(how, points=points)), "in a way that NumPy does not write")


def test_npz_that_unpacks_to_more_than_it_says(tmp_path: Path) -> None:
    content = archive(zipfile.ZIP_DEFLATED, points=np.zeros((3_000_000, 3)))
    true = (128 + 72_000_000).to_bytes(4, "little")
    assert content.count(true) == 2
    refused(written(tmp_path, "a.npz", content.replace(true, (60_000).to_bytes(4, "little"))), "not a readable .npz")


def npy(shape: str) -> bytes:
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + np.ones(3).tobytes()


@pytest.mark.parametrize("shape", ["(True, 3)", "(1, 3.0)", "(10**9, 3)", "(1000000000, 3)", "[1, 3]"])
def test_npy_shapes_that_are_none(shape: str, tmp_path: Path) -> None:
    refused(written(tmp_path, "a.npy", npy(shape)), "not a readable .npy file")
    assert len(read_scan(written(tmp_path, "a.npy", npy("(1, 3)")), "mm").points) == 1


def png(width: int, height: int) -> bytes:
    """Return an image of zeros, of which most rows are missing."""
    pack, row = zlib.compressobj(1), bytes(1 + 2 * width)
    data = b"".join(pack.compress(row) for _ in range(min(height, 10))) + pack.flush()
    content = b"\x89PNG\r\n\x1a\n"
    for name, chunk in (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)),
        (b"IDAT", data),
        (b"IEND", b""),
    ):
        content += struct.pack(">I", len(chunk)) + name + chunk + struct.pack(">I", zlib.crc32(name + chunk))
    return content


def test_images_of_many_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refused(written(tmp_path, "a.png", png(13_000, 13_000)), "it has 169000000 pixels, more than 50000000")
    monkeypatch.setenv(SETTING, "400000")
    for kind, options in (("PNG", {}), ("TIFF", {}), ("TIFF", {"compression": "tiff_lzw"})):
        Image.fromarray(np.ones((100, 101), np.uint16)).save(tmp_path / f"a.{kind.lower()}", **options)
        refused(tmp_path / f"a.{kind.lower()}", "it has 10100 pixels, more than 10000")


def tiff(tags: dict[int, int]) -> bytes:
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    directory = struct.pack("<H", len(tags)) + entries + bytes(4)
    return b"II*\0" + struct.pack("<I", 8 + 384) + bytes(384) + directory


def test_libraries_keep_quiet(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    scene = write_sample(tmp_path, num_frames=1) / "test" / "000000"
    Image.fromarray(np.arange(192, dtype=np.uint16).reshape(12, 16)).save(tmp_path / "a.tif", compression="tiff_lzw")
    content = bytearray((tmp_path / "a.tif").read_bytes())
    content[12:200] = b"\xff" * 188
    many_samples = tiff({256: 16, 257: 12, 258: 16, 259: 1, 262: 1, 273: 8, 277: 100, 278: 12, 279: 384})
    (scene / "depth" / "000000.png").unlink()
    for damaged in (bytes(content), many_samples):
        refused(written(tmp_path, "a.tif", damaged), "it is not a readable image")
        with pytest.raises(InputError, match="is not a readable image"):
            bop_scan(written(scene / "depth", "000000.tif", damaged))
    assert tuple(capfd.readouterr()) == ("", "")
    assert caplog.records == []


def test_tiff_of_tiles_larger_than_the_image(tmp_path: Path) -> None:
    content = tiff({256: 16, 257: 12, 258: 16, 259: 1, 262: 1, 277: 1, 322: 40_000, 323: 40_000, 324: 8, 325: 384})
    refused(written(tmp_path, "a.tif", content), "it has 1600000000 pixels in a tile")


def test_images_of_datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = write_sample(tmp_path, num_frames=1) / "test" / "000000"
    image = written(scene / "depth", "000000.png", png(100, 90))
    monkeypatch.setenv(SETTING, "200000")
    with pytest.raises(InputError, match=r"000000.png has 9000 pixels, more than 5000"):
        bop_scan(image)
    (fault,) = [fault for fault in BopDataset(tmp_path, "test").problems(decode=False) if fault.file == image]
    assert "has 9000 pixels" in str(fault)
    monkeypatch.setenv(SETTING, "200")
    with pytest.raises(InputError, match=r"scene_camera.json takes .* bytes, more than 200"):
        bop_scan(image)


def test_masks_of_many_instances(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = write_sample(tmp_path, num_frames=1) / "test" / "000000"
    truth = json.loads((scene / "scene_gt.json").read_text())
    truth["0"] *= 67
    (scene / "scene_gt.json").write_text(json.dumps(truth))
    (scene / "scene_gt_info.json").unlink()
    monkeypatch.setenv(SETTING, "500000")
    with pytest.raises(InputError, match=r"names 201 instances, and of their masks: it takes 617472 bytes"):
        BopDataset(tmp_path, "test").frame(0, 0, masks=True)


def test_exr_of_many_channels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import OpenEXR

    depth = np.ones((64, 64), np.float32)
    channels = {"Z": depth} | {f"c{index}": depth for index in range(9)}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(tmp_path / "a.exr"))
    camera = written(tmp_path, "camera.json", CAMERA)
    assert len(read_scan(tmp_path / "a.exr", "m", camera).points) == 4096
    monkeypatch.setenv(SETTING, "300000")
    refused(tmp_path / "a.exr", "its channels take more than 300000 bytes")


def test_step_that_takes_much_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from kmn_jax.io import _apart, _step

    path = written(tmp_path, "a.step", STEP)
    monkeypatch.setattr(_apart, "_OWN_BYTES", 50_000_000)
    monkeypatch.setattr(_step, "_PROGRAM", "import sys\nheld = bytes(10**8)\nopen(sys.argv[2], 'wb').write(b'glTF')")
    monkeypatch.setenv(SETTING, "100000000")
    refused(path, "not a GLB file")
    monkeypatch.setenv(SETTING, "1000000")
    refused(path, r"takes more than 1000000 bytes to decode \(MemoryError\)")
    monkeypatch.setattr(_step, "_PROGRAM", "import sys\nopen(sys.argv[2], 'wb').write(bytes(2_000_000))")
    refused(path, "takes more than 1000000 bytes to decode")


def test_files_beyond_the_budget_are_not_read(tmp_path: Path) -> None:
    for name in ("a.step", "a.glb", "a.npz", "a.png", "a.ply"):
        with (tmp_path / name).open("wb") as file:
            file.truncate(2_000_000_001)  # without a byte on the disk
        refused(tmp_path / name, "it takes 2000000001 bytes, more than 2000000000")


def test_ply_polygons_of_many_corners(tmp_path: Path) -> None:
    """A corner takes a byte, but a triangle takes twenty-four."""
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    )
    header += "element face 2\nproperty list uint uchar vertex_indices\nend_header\n"
    faces = struct.pack("<I", 5_000_000) + bytes(5_000_000) + struct.pack("<I", 3) + bytes(3)
    content = header.encode() + np.eye(3, dtype="<f4").tobytes() + faces
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(SETTING, "100000000")
        refused(written(tmp_path, "a.ply", content), "it takes .* bytes, more than 100000000")


def test_obj_polygons_of_many_corners(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SETTING, "1000000")
    for corners, message in ((40_000, "it has 39998 triangles, more than 25000"), (600_000, "line 4 is longer than")):
        text = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf" + b" 1" * corners
        refused(written(tmp_path, "a.obj", text), message)
        monkeypatch.delenv(SETTING, raising=False)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.obj", b"v 0 0 0\n" * 30_000 + b"f 1 2 3\n"),
        ("a.stl", b"solid a\n" + b"facet normal 0 0 1 outer loop" + b" vertex 0 0 0" * 3 + b" endloop endfacet\n"),
        ("a.xyz", (b"1 2 3" + b" 1" * 500 + b"\n") * 500),
    ],
)
def test_text_that_is_short_for_what_it_holds(
    name: str, content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "a.stl":
        head, _, facet = content.partition(b"\n")
        content = head + b"\n" + facet * 9000 + b"endsolid a\n"
    monkeypatch.setenv(SETTING, "1000000")
    with pytest.raises(InputError, match=r"it (has|takes) \d+ (points|bytes), more than"):
        read_mesh(written(tmp_path, name, content))


def test_a_table_of_one_line(tmp_path: Path) -> None:
    refused(written(tmp_path, "a.xyz", b"1 " * 2_000_000), "it has a line of megabytes")


def test_pcd_that_unpacks_to_more_than_it_says(tmp_path: Path) -> None:
    header = (
        "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA binary_compressed\n"
    )
    packed = b"\x00\x01" + b"\xe0\xff\x00" * 1_000_000  # a byte, then 264 like the one before again and again
    cases = (
        (100, 1200, "not the LZF of 1200 bytes"),
        (200_000_000, 2_400_000_000, "takes 2400000000 bytes"),
    )
    for points, size, message in cases:
        content = header.format(points).encode() + struct.pack("<II", len(packed), size) + packed
        refused(written(tmp_path, "a.pcd", content), message)
