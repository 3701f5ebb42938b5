"""Every reader takes damaged files: it returns finite data or raises InputError, soon, silently, in little memory."""

from __future__ import annotations

import io
import json
import shutil
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from PIL import Image

from kmn_jax.bop import bop_scan
from kmn_jax.errors import InputError
from kmn_jax.io import read_mesh, read_scan
from kmn_jax.io._meshes import CLOUD_SUFFIXES
from kmn_jax.io._scans import read_camera
from kmn_jax.objects import ObjectConfig, Part, Symmetries, load_object, load_part, save_part
from tests.bop.bop_sample import write_sample
from tests.io.mesh_sample import STEP, whole_files

RNG = np.random.default_rng(0)
SECONDS = 60  # for an example; the slowest takes one or two, but many tests may run beside it
MOST_BYTES = 200_000_000  # of arrays at a time; the files have a few thousand
NUMBERS = (0, 1, -1, 3, 255, 65_535, 10**6, 2**31 - 1, 2**31, 2**32 - 1, 10**12, 2**63 - 1, 10**20, 10**400)
CAMERA = json.dumps({"fx": 80.0, "fy": 82.0, "cx": 7.5, "cy": 5.5, "depth_scale": 0.1, "width": 16, "height": 12})
MATRIX = json.dumps({"cam_K": [80.0, 0.0, 7.5, 0.0, 82.0, 5.5, 0.0, 0.0, 1.0], "depth_scale": 1})
Mutation = Callable[[bytes], bytes]


@pytest.fixture(autouse=True)
def silent(capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    yield
    assert tuple(capfd.readouterr()) == ("", "")
    assert caplog.records == []


@st.composite
def mutation(draw: st.DrawFn) -> Mutation:
    """Return a function that damages bytes, once or a few times."""
    steps = draw(st.lists(single_mutation(), min_size=1, max_size=3))

    def apply(content: bytes) -> bytes:
        for step in steps:
            content = step(content)
        return content

    return apply


@st.composite
def single_mutation(draw: st.DrawFn) -> Mutation:
    kind = draw(st.sampled_from(["cut", "flip", "double", "delete", "insert", "swap", "word", "digits", "empty"]))
    place, other = draw(st.floats(0, 1, exclude_max=True)), draw(st.floats(0, 1, exclude_max=True))
    length, number = draw(st.integers(1, 200)), draw(st.sampled_from(NUMBERS))
    early = draw(st.booleans())  # headers break more than the rest does

    def apply(content: bytes) -> bytes:
        if not content or kind == "empty":
            return b""
        reach = min(len(content), 200) if early else len(content)
        start, far = int(place * reach), int(other * len(content))
        block = content[start : start + length]
        rest = content[start + length :]
        if kind == "cut":
            return content[:start]
        if kind == "flip":
            return content[:start] + bytes([content[start] ^ (1 << length % 8)]) + content[start + 1 :]
        if kind == "double":
            return content[: start + length] + block + rest
        if kind == "insert":
            return content[:start] + str(number).encode() + content[start:]
        if kind == "delete":
            return content[:start] + rest
        if kind == "swap":
            return content[:far] + block + content[far + length :]
        if kind == "word":
            size = (1, 2, 4, 8)[length % 4]
            packed = (number % 256**size).to_bytes(size, "little" if length % 8 < 4 else "big")
            return content[:start] + packed + content[start + size :]
        while start < len(content) and content[start : start + 1] not in b"0123456789":
            start += 1
        end = start
        while end < len(content) and content[end : end + 1] in b"0123456789.":
            end += 1
        return content[:start] + str(number).encode() + content[end:]

    return apply


def check_finite(value: Any) -> None:
    """Fail for an array or a number in `value`, at any depth, that is NaN or infinite."""
    if is_dataclass(value):
        for field in fields(value):
            check_finite(getattr(value, field.name))
    elif isinstance(value, tuple | list):
        for item in value:
            check_finite(item)
    elif isinstance(value, np.ndarray | float):
        assert np.isfinite(value).all()


def check_reader(
    read: Callable[[Path], Any], path: Path, content: bytes, num_examples: int, names: tuple[str, ...] = ()
) -> None:
    """Feed mutations of a file that can be read; some of them are renamed to one of `names`."""
    path.write_bytes(content)
    check_finite(read(path))

    @settings(
        max_examples=num_examples,
        deadline=1000 * SECONDS,
        derandomize=True,
        database=None,
        phases=[Phase.generate],  # making a failure small could take many minutes
        suppress_health_check=list(HealthCheck),
    )
    @given(mutation(), st.sampled_from((path.name, path.name, *names)))
    def check(mutate: Mutation, name: str) -> None:
        damaged = path.with_name(name)
        damaged.write_bytes(mutate(content))
        message = None
        tracemalloc.start()  # it slows all else down, too
        try:
            check_finite(read(damaged))
        except InputError as error:
            message = str(error)
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert message is None or (message and "\n" not in message)
        assert peak < MOST_BYTES

    check()


DIRECTIONS = RNG.normal(size=(100, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
DENSE = DIRECTIONS * (3 + DIRECTIONS[:, :1]) * (3, 2, 1)  # without symmetries, whose search takes long
POINTS = RNG.uniform(1, 2, (80, 3)).astype(np.float32)
DEPTH = RNG.integers(1000, 2000, (12, 16)).astype(np.uint16)


def image(kind: str, **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(DEPTH).save(buffer, kind, **options)
    return buffer.getvalue()


def arrays(**named: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    if "" in named:
        np.save(buffer, named[""])
    else:
        np.savez_compressed(buffer, **named)
    return buffer.getvalue()


def exr(folder: Path) -> bytes:
    import OpenEXR

    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, {"Z": DEPTH.astype(np.float32)}).write(str(folder / "depth.exr"))
    return (folder / "depth.exr").read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return the contents of whole files of every kind by name."""
    folder = tmp_path_factory.mktemp("whole")
    matrix = np.array([[80, 0, 7.5], [0, 82, 5.5], [0, 0, 1]])
    return {
        **whole_files(folder),
        "points.npy": arrays(**{"": POINTS}),
        "depth.npy": arrays(**{"": DEPTH.astype(np.float32)}),
        "points.npz": arrays(points=POINTS.astype(np.float64), normals=POINTS),
        "depth.npz": arrays(depth=DEPTH, K=matrix),
        "depth.png": image("PNG"),
        "depth.tiff": image("TIFF"),
        "lzw.tif": image("TIFF", compression="tiff_lzw"),
        "deflate.tif": image("TIFF", compression="tiff_adobe_deflate"),
        "depth.exr": exr(folder),
        "dense.xyz": "\n".join(" ".join(map(str, row)) for row in DENSE).encode(),
    }


CLOUDS = ["binary_cloud.ply", "text_cloud.ply", "binary.pcd", "text.pcd", "compressed.pcd", "cloud.xyz", "cloud.xyzn"]
ARRAYS = ["points.npy", "depth.npy", "points.npz", "depth.npz"]
IMAGES = ["depth.png", "depth.tiff", "lzw.tif", "deflate.tif"]
RENAMED = tuple(f"renamed{suffix}" for suffix in (".png", ".tif", ".npy", ".npz", ".xyz", ".ply", ".pcd", ".dat", ""))


@pytest.mark.parametrize("name", CLOUDS + ARRAYS + IMAGES)
def test_scans(name: str, whole: dict[str, bytes], tmp_path: Path) -> None:
    (tmp_path / "camera.json").write_text(CAMERA)

    def read(path: Path) -> Any:
        scan = read_scan(path, "mm", tmp_path / "camera.json")
        assert len(scan.points) > 0
        assert (scan.points != 0).any(axis=1).all()
        return scan

    check_reader(read, tmp_path / name, whole[name], 50, RENAMED)


def test_exr_scans(whole: dict[str, bytes], tmp_path: Path) -> None:
    (tmp_path / "camera.json").write_text(CAMERA)
    check_reader(
        lambda path: read_scan(path, "m", tmp_path / "camera.json"), tmp_path / "depth.exr", whole["depth.exr"], 8
    )


@pytest.mark.parametrize("content", [CAMERA, MATRIX])
def test_cameras(content: str, tmp_path: Path) -> None:
    check_reader(read_camera, tmp_path / "camera.json", content.encode(), 50)


@pytest.mark.parametrize("file", ["scene_camera.json", "scene_gt.json", "depth/000001.png"])
def test_bop_scans(file: str, tmp_path: Path) -> None:
    scene = write_sample(tmp_path, num_frames=2) / "test" / "000000"
    shutil.rmtree(scene / "mask")
    content = (scene / file).read_bytes()
    check_reader(lambda _: bop_scan(scene / "depth" / "000001.png"), scene / file, content, 15)


MESHES = ["binary.stl", "text.stl", "mesh.obj", "binary.ply", "text.ply", "mesh.glb"]


@pytest.mark.parametrize("name", [*MESHES, "solid.step", *CLOUDS])
def test_meshes(name: str, whole: dict[str, bytes], tmp_path: Path) -> None:
    def read(path: Path) -> Any:
        mesh = read_mesh(path)
        assert len(mesh.vertices) > 0
        if len(mesh.triangles):
            assert 0 <= mesh.triangles.min() <= mesh.triangles.max() < len(mesh.vertices)
        else:
            assert path.suffix in CLOUD_SUFFIXES
        return mesh

    if name == "solid.step":  # a conversion takes long
        check_reader(read, tmp_path / name, whole[name], 8)
        return
    names = (*RENAMED, *(f"renamed{suffix}" for suffix in (".stl", ".obj", ".glb", ".step")))
    check_reader(read, tmp_path / name, whole[name], 80, names)


@pytest.mark.parametrize("name", [*MESHES, "dense.xyz"])
def test_objects(name: str, whole: dict[str, bytes], tmp_path: Path) -> None:
    def read(path: Path) -> Any:
        found = load_object(path, config=ObjectConfig(num_points=64))
        assert 0 < found.diameter < np.inf
        np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1, atol=1e-4)
        return found

    check_reader(read, tmp_path / name, whole[name], 3 if name == "dense.xyz" else 6)


def test_step_objects(tmp_path: Path) -> None:
    check_reader(lambda path: load_object(path, config=ObjectConfig(num_points=64)), tmp_path / "part.step", STEP, 3)


def test_object_cards(tmp_path: Path) -> None:
    directions = DIRECTIONS.astype(np.float32)
    symmetries = Symmetries(np.eye(3)[None], np.array([[0.0, 0, 1]]), np.zeros(3), 0.02)
    part = Part(
        name="ball",
        unit="mm",
        points=10 * directions,
        normals=directions,
        features=RNG.normal(size=(8, 4)).astype(np.float32),
        diameter=20.0,
        minimum=np.full(3, -10.0),
        maximum=np.full(3, 10.0),
        area=1256.0,
        symmetries=symmetries,
        source_digest="0" * 64,
        model_digest="1" * 64,
    )
    save_part(part, tmp_path / "ball.kmn")
    check_reader(load_part, tmp_path / "ball.kmn", (tmp_path / "ball.kmn").read_bytes(), 60)


SIGNALLING = b"\x01\x00\xa0\x7f"  # a NaN whose conversion warns


def glb(change: Callable[[dict[str, Any]], None], whole: dict[str, bytes]) -> bytes:
    """Return a GLB file with another header."""
    content = whole["mesh.glb"]
    end = 20 + int.from_bytes(content[12:16], "little")
    tree = json.loads(content[20:end])
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = len(text).to_bytes(4, "little") + b"JSON" + text + content[end:]
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks


@pytest.mark.parametrize(
    ("name", "before"), [("binary.stl", None), ("binary.ply", b"end_header\n"), ("binary.pcd", b"DATA binary\n")]
)
def test_signalling_nan(name: str, before: bytes | None, whole: dict[str, bytes], tmp_path: Path) -> None:
    content = whole[name]
    start = 96 if before is None else content.index(before) + len(before)  # of the first coordinate
    (tmp_path / name).write_bytes(content[:start] + SIGNALLING + content[start + 4 :])
    with pytest.raises(InputError, match=r"1 of .* vertices are NaN, infinite .* number 0"):
        read_mesh(tmp_path / name)


def test_a_face_of_a_number_that_is_no_index(whole: dict[str, bytes], tmp_path: Path) -> None:
    text = whole["text.ply"].decode()
    (tmp_path / "a.ply").write_text(text.rstrip().rpartition(" ")[0] + " 1e20\n")
    with pytest.raises(InputError, match="by something that is not a whole number"):
        read_mesh(tmp_path / "a.ply")


def test_glb_of_made_up_values(whole: dict[str, bytes], tmp_path: Path) -> None:
    def many(tree: dict[str, Any]) -> None:
        for accessor in tree["accessors"]:
            accessor.pop("bufferView")
            accessor["count"] = 10**9

    def flat(tree: dict[str, Any]) -> None:
        tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = 0

    for change, message in ((many, "announces 1000000000 values, but has"), (flat, "are not three numbers each")):
        (tmp_path / "a.glb").write_bytes(glb(change, whole))
        with pytest.raises(InputError, match=message):
            read_mesh(tmp_path / "a.glb")


def test_normals_that_are_not_finite_are_none(tmp_path: Path) -> None:
    (tmp_path / "a.xyzn").write_text("0 0 1 0 0 1\n0 1 1 0 inf 1\n")
    assert read_mesh(tmp_path / "a.xyzn").normals is None
