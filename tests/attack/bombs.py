"""Small files that announce, unpack to, or ask for far more than they are."""

from __future__ import annotations

import io
import json
import pickle
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.attack import samples
from tests.attack.containers import glb_bytes, png_chunk, zip_bytes, zip_members

Bomb = Callable[[], bytes]
_DEEP = 100_000


@cache
def bombs() -> dict[str, tuple[Bomb, ...]]:
    """Return files by the format that they are of; they are made when they are called."""
    deep = tuple(partial(_constant, text) for text in (b"[" * _DEEP, b'{"a":' * _DEEP, b"[" * 900 + b"]" * 900))
    numbers = partial(_constant, b"9" * 10**6)
    json_files = ("camera", "camera-matrix", "calibration", "pack-manifest", "recipe", "poses-json", "pose", "grasps")
    of_bop = [f"bop-{name}" for name in ("scene-gt", "scene-camera", "scene-gt-info", "models-info", "camera")]
    bop = (*deep, numbers, partial(_constant, b'{"' + b"1" * 5000 + b'": 1}'))
    return {
        **dict.fromkeys(json_files, (*deep, numbers)),
        **dict.fromkeys(of_bop, bop),
        "mesh-mesh-glb": tuple(partial(_glb, *sizes) for sizes in ((1500, 40_000), (200_000, 1), (20_000, 5), (1, 1))),
        "mesh-binary-stl": (partial(_constant, b"a" * 80 + b"\xff" * 4), _many_triangles),
        "mesh-text-stl": (_many_facets,),
        "mesh-mesh-obj": (_wide_face, partial(_constant, b"v 0 0 0\n" * 10**6)),
        "mesh-text-ply": (partial(_ply, b"ascii", 10**9), partial(_ply, b"ascii", 2**63), _wide_ply),
        "mesh-binary-ply": (partial(_ply, b"binary_little_endian", 10**9), _empty_vertices),
        "mesh-mixed-ply": (_mixed_faces,),
        "scan-compressed-pcd": (_short_matches, partial(_pcd, 2**31), partial(_pcd, 2**62)),
        "scan-binary-pcd": (partial(_constant, _pcd_header(10**12, "binary")), _no_bytes_a_point),
        "scan-points-npy": (_true_shape, partial(_npy, "(9223372036854775807, 3)"), partial(_npy, "(" * 90 + ")" * 90)),
        "scan-points-npz": (partial(_npz_zeros, 10**8, False), partial(_npz_zeros, 24 * 10**7, False), _npz_bzip),
        "scan-depth-npz": (partial(_npz_zeros, 3 * 10**7, True),),
        "scan-depth-png": (partial(_png, 13_000), partial(_png, 7_000), partial(_png, 100_000), _png_text),
        "scan-depth-tiff": (partial(_tiff, 7_000),),
        "scan-exr": (partial(_exr, 5_000), partial(_exr, 7_000)),
        "mesh-step": (_step_references, _step_instances, _step_external),
        "torch-pt": (_long_pickle, _zip_bomb, _deep_pickle, _many_puts, *(partial(_strides, s) for s in _STRIDES)),
        "torch-t7": (partial(_constant, b"PK\5\6" + b"\xff" * 18),),
        "card": (partial(_tensors, 10**12), _many_tensors, partial(_constant, b"\xff" * 8)),
        "model": (partial(_tensors, 2**62), _many_tensors, partial(_constant, (10**8).to_bytes(8, "little") + b"{")),
    }


def _constant(content: bytes) -> bytes:
    return content


def _glb(nodes: int, triangles: int) -> bytes:
    """Many nodes that show one mesh."""
    side = np.arange(3 * triangles, dtype=np.float32)
    points = np.stack([side, side % 7, side % 5], axis=1)
    accessor = {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": len(points)}
    accessor |= {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    data = points.tobytes()
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(nodes))}],
        "nodes": [{"mesh": 0, "translation": [0, 0, row]} for row in range(nodes)],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [accessor],
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": len(data)}],
        "buffers": [{"byteLength": len(data)}],
    }
    if nodes == 1:  # a node that is its own child
        tree["nodes"] = [{"mesh": 0, "children": [0]}]
    return glb_bytes(json.dumps(tree).encode(), len(data).to_bytes(4, "little") + b"BIN\0" + data)


def _many_triangles() -> bytes:
    """Two million flat triangles."""
    count = 2_000_000
    return b"\0" * 80 + count.to_bytes(4, "little") + b"\0" * 50 * count


def _many_facets() -> bytes:
    facet = b"facet normal 0 0 1 outer loop vertex 0 0 0 vertex 1 0 0 vertex 0 1 0 endloop endfacet\n"
    return b"solid a\n" + facet * 300_000 + b"endsolid a\n"


def _wide_face() -> bytes:
    return b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf" + b" 1 2 3" * 10**6 + b"\n"


def _ply(kind: bytes, count: int) -> bytes:
    lines = [b"ply", b"format " + kind + b" 1.0", b"element vertex " + str(count).encode()]
    return b"\n".join([*lines, *(b"property float " + name for name in (b"x", b"y", b"z")), b"end_header", b"0 0 0\n"])


def _empty_vertices() -> bytes:
    """Vertices of no properties, which take no bytes."""
    return b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\nend_header\n"


def _wide_ply() -> bytes:
    return b"ply\nformat ascii 1.0\n" + b"property float x\n" * 10**5 + b"end_header\n"


def _mixed_faces() -> bytes:
    """Half a million faces of three and four corners in turn."""
    rounds = 250_000
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 4\n" + b"".join(
        b"property float " + name + b"\n" for name in (b"x", b"y", b"z")
    )
    header += b"element face %d\nproperty list uchar int vertex_indices\nend_header\n" % (2 * rounds)
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1]], "<f4").tobytes()
    three = b"\3" + np.array([0, 1, 2], "<i4").tobytes()
    return header + points + (three + b"\4" + np.array([0, 1, 2, 3], "<i4").tobytes()) * rounds


def _pcd_header(count: int, data: str, kinds: str = "F F F") -> bytes:
    lines = ["FIELDS x y z", "SIZE 4 4 4", f"TYPE {kinds}", "COUNT 1 1 1", f"WIDTH {count}", "HEIGHT 1"]
    return "\n".join([*lines, f"POINTS {count}", f"DATA {data}", ""]).encode()


def _pcd(count: int) -> bytes:
    return _pcd_header(count, "binary_compressed") + struct.pack("<II", 4, (12 * count) % 2**32) + b"\3aaaa"


def _no_bytes_a_point() -> bytes:
    return b"FIELDS x y z\nSIZE 0 0 0\nTYPE F F F\nCOUNT 0 0 0\nPOINTS 1000000000000\nDATA binary\n"


def _short_matches() -> bytes:
    """A million points, packed as matches of three bytes."""
    count = 1_000_000
    packed = b"\3" + np.float32(1).tobytes() + b"\x20\3" * ((12 * count - 4) // 3) + b"\1\0\0"
    return _pcd_header(count, "binary_compressed") + struct.pack("<II", len(packed), 12 * count) + packed


def _npy(shape: str, data: bytes = b"\0" * 36) -> bytes:
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\1\0" + len(text).to_bytes(2, "little") + text + data


def _true_shape() -> bytes:
    return _npy("(True, 3)")


def _npz_zeros(values: int, depth: bool) -> bytes:
    """An archive of numbers that are all the same."""
    columns = 6000 if depth else 3
    rows = values // columns
    member = _npy(f"({rows}, {columns})", b"\0\0\x80\x3f" * (rows * columns))
    matrix = _npy("(3, 3)", np.array([[80, 0, 7], [0, 80, 5], [0, 0, 1]], "<f4").tobytes())
    return zip_bytes({"depth.npy": member, "K.npy": matrix} if depth else {"points.npy": member}, packed=True)


def _npz_bzip() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        info = zipfile.ZipInfo("points.npy", (2000, 1, 1, 0, 0, 0))
        archive.writestr(info, _npy("(40000000, 3)", b"@" * 480_000_000), zipfile.ZIP_BZIP2)  # runs of bytes pack soon
    return file.getvalue()


def _png(side: int) -> bytes:
    """A square of one depth, of 16 bits."""
    header = struct.pack(">IIBBBBB", side, side, 16, 0, 0, 0, 0)
    row = b"\0" + b"\3\xe8" * side
    packer = zlib.compressobj(9)
    data = b"".join(packer.compress(row) for _ in range(min(side, 20_000))) + packer.flush()
    chunks = ((b"IHDR", header), (b"IDAT", data), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(*chunk) for chunk in chunks)


def _png_text() -> bytes:
    """A comment that unpacks to 400 MB before a small image."""
    content = samples.samples()["depth.png"]
    text = png_chunk(b"zTXt", b"a\0\0" + zlib.compress(b"a" * 400_000_000, 9))
    return content[:33] + text + content[33:]


def _tiff(side: int) -> bytes:
    values = np.full((side, side), 1000, dtype=np.uint16)
    return samples.image_bytes("TIFF", values, compression="tiff_adobe_deflate")


def _exr(side: int) -> bytes:

    with tempfile.TemporaryDirectory() as folder:
        return samples.exr_bytes(Path(folder), np.full((side, side), 2.0, dtype=np.float32))


def _step_references() -> bytes:
    """A chain of references that ends where it began."""
    step = samples.samples()["solid.step"]
    rows = "".join(f"#{90_000 + row}=PRODUCT('a','a','',(#{90_000 + (row + 1) % 1000}));\n" for row in range(1000))
    return step.replace(b"ENDSEC;\nEND-ISO", rows.encode() + b"ENDSEC;\nEND-ISO")


def _step_instances() -> bytes:
    """The shape's representation, repeated fifty thousand times."""
    step = samples.samples()["solid.step"]
    row = b"#%d=CARTESIAN_POINT('',(0.,0.,1.E300));\n"
    return step.replace(b"ENDSEC;\nEND-ISO", b"".join(row % (90_000 + i) for i in range(50_000)) + b"ENDSEC;\nEND-ISO")


def _step_external() -> bytes:
    """A reference to a file elsewhere."""
    step = samples.samples()["solid.step"]
    rows = b"#90000=DOCUMENT_FILE('../../../etc/hostname','','',#90001,'','');\n#90001=DOCUMENT_TYPE('geometry');\n"
    return step.replace(b"ENDSEC;\nEND-ISO", rows + b"ENDSEC;\nEND-ISO")


@cache
def _torch() -> dict[str, bytes]:

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "model.pt")
        samples.authors_network(path)
        return zip_members(path.read_bytes())


def _repickled(content: bytes) -> bytes:
    """Return a torch file with another pickle; stored, as a compressed one is refused before its pickle is read."""
    names = {name.rpartition("/")[2]: name for name in _torch()}
    return zip_bytes({**_torch(), names["data.pkl"]: content}, packed=False)


def _long_pickle() -> bytes:
    """A text that says that it has a gigabyte."""
    return _repickled(pickle.PROTO + b"\2" + pickle.LONG4 + struct.pack("<i", 2**30 - 1) + b"\1")


def _zip_bomb() -> bytes:
    """A buffer of 5 GB of zeros in 5 MB: of the archive's second tensor."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, member in _torch().items():
            info = zipfile.ZipInfo(name, (2000, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w", force_zip64=True) as out:
                for block in [b"\0" * 2**26] * 80 if name.endswith("/data/1") else [member]:
                    out.write(block)
    return file.getvalue()


def _deep_pickle() -> bytes:
    return _repickled(pickle.PROTO + b"\2" + pickle.EMPTY_LIST * 10**6 + pickle.APPEND * (10**6 - 1) + pickle.STOP)


def _many_puts() -> bytes:
    """A place of the memo beyond all bounds."""
    return _repickled(pickle.PROTO + b"\2" + pickle.NONE + pickle.LONG_BINPUT + struct.pack("<I", 2**30 - 1) + b".")


_STRIDES: tuple[Any, ...] = ((2**61, 2**61), (2**40, 1), (-1, 1), (0, 0))


def _strides(strides: tuple[int, int]) -> bytes:
    """A tensor whose strides are themselves a tensor of int64, that wraps where integers would not."""

    def text(value: str) -> bytes:
        return pickle.BINUNICODE + struct.pack("<I", len(value)) + value.encode()

    def storage(kind: str, key: str, count: int) -> bytes:
        inner = text("storage") + pickle.GLOBAL + f"torch\n{kind}\n".encode() + text(key) + text("cpu")
        return pickle.MARK + inner + pickle.BININT + struct.pack("<i", count) + pickle.TUPLE + pickle.BINPERSID

    def integer(value: int) -> bytes:
        return pickle.LONG1 + b"\x09" + value.to_bytes(9, "little", signed=True)

    rebuild = pickle.GLOBAL + b"torch._utils\n_rebuild_tensor_v2\n"
    none = pickle.NEWFALSE + pickle.NONE
    size = pickle.MARK + integer(2) + integer(3) + pickle.TUPLE
    one = pickle.MARK + integer(2) + pickle.TUPLE + pickle.MARK + integer(1) + pickle.TUPLE
    inner = rebuild + pickle.MARK + storage("LongStorage", "1", 2) + integer(0) + one + none + pickle.TUPLE
    outer = rebuild + pickle.MARK + storage("FloatStorage", "0", 9) + integer(0) + size + inner + pickle.REDUCE
    program = pickle.PROTO + b"\2" + pickle.EMPTY_DICT + text("conv1.0.weight") + outer + none + pickle.TUPLE
    members = {
        "archive/data.pkl": program + pickle.REDUCE + pickle.SETITEM + pickle.STOP,
        "archive/data/0": np.arange(9, dtype="<f4").tobytes(),
        "archive/data/1": np.array([value % 2**64 for value in strides], "<u8").tobytes(),
        "archive/version": b"3\n",
    }
    return zip_bytes(members, packed=False)


def _tensors(count: int) -> bytes:
    header = json.dumps({"points": {"dtype": "F32", "shape": [count, 3], "data_offsets": [0, 12 * count]}}).encode()
    return len(header).to_bytes(8, "little") + header


def _many_tensors() -> bytes:
    """Two hundred thousand tensors of nothing."""
    header = json.dumps({f"a{i}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for i in range(200_000)})
    return len(header).to_bytes(8, "little") + header.encode()
