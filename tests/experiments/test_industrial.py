"""The committed test objects: seven industrial parts as STL files, and the catalogue of electronic components."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from experiments.write_industrial import PARTS, stl_bytes, triangle_mesh

ASSETS = Path(__file__).parents[2] / "experiments" / "assets"
FOLDER = ASSETS / "industrial"
# Holes that lead through each part: bores, windows, slots, and set-screw holes, which open into a bore.
THROUGH_HOLES = {
    "gear_motor": 2,  # in the two terminals: mounting holes and vents are blind
    "timing_pulley": 1 + 2,
    "belt_pulley": 1 + 5 + 1,
    "idler": 1,
    "bearing_housing": 1 + 2 + 2,
    "shaft": 0,
    "screw": 0,
}
TETRAHEDRON = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]


class FakeSolid:
    """A tetrahedron as build123d would return it: every face with vertices of its own."""

    diagonal = 1.0

    def __init__(self, faces: list[tuple[int, int, int]]) -> None:
        self.faces = faces

    def bounding_box(self) -> FakeSolid:
        return self

    def solids(self) -> list[FakeSolid]:
        return [self]

    def tessellate(self, tolerance: float, angle: float) -> tuple[list[np.ndarray], list[tuple[int, int, int]]]:
        corners = np.vstack([np.zeros(3), np.eye(3)])
        points = [corners[i] for face in self.faces for i in face]
        return points, [(3 * i, 3 * i + 1, 3 * i + 2) for i in range(len(self.faces))]


def load(name: str) -> trimesh.Trimesh:
    return trimesh.load_mesh(FOLDER / f"{name}.stl")


def chamfer(first: np.ndarray, second: np.ndarray) -> float:
    there, back = cKDTree(first).query(second)[0], cKDTree(second).query(first)[0]
    return float((there.mean() + back.mean()) / 2)


def axis_rotations() -> list[np.ndarray]:
    """Return the 24 rotations that map the axes onto each other."""
    matrices = [
        np.eye(3)[list(order)] * signs
        for order in itertools.permutations(range(3))
        for signs in itertools.product((-1, 1), repeat=3)
    ]
    return [matrix for matrix in matrices if np.linalg.det(matrix) > 0]


def normalised_samples(name: str, seed: int) -> np.ndarray:
    """Return surface points of a part, centred on its bounding box whose diagonal becomes 1."""
    mesh = load(name)
    points, _ = trimesh.sample.sample_surface(mesh, 800, seed=seed)
    return (points - mesh.bounds.mean(axis=0)) / mesh.scale


def test_folder_holds_the_parts_of_the_script() -> None:
    assert {path.stem for path in FOLDER.glob("*.stl")} == set(PARTS) == set(THROUGH_HOLES)


@pytest.mark.parametrize("name", PARTS)
def test_part_is_one_closed_solid_of_sensible_size(name: str) -> None:
    mesh = load(name)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.body_count == 1
    assert mesh.euler_number == 2 - 2 * THROUGH_HOLES[name]
    assert mesh.area_faces.min() > 0
    assert 5 < mesh.scale < 150
    assert 1000 < len(mesh.faces) < 6000
    assert (FOLDER / f"{name}.stl").stat().st_size < 300_000


@pytest.mark.parametrize("name", PARTS)
def test_readme_gives_size_and_triangles(name: str) -> None:
    mesh = load(name)
    (row,) = [line for line in (FOLDER / "README.md").read_text().splitlines() if line.startswith(f"| `{name}.stl`")]
    size, diagonal, triangles = (cell.strip() for cell in row.strip("|").split("|")[2:])
    np.testing.assert_allclose([float(x) for x in size.split(" x ")], mesh.extents, atol=0.051)
    assert float(diagonal) == pytest.approx(mesh.scale, abs=0.051)
    assert int(triangles) == len(mesh.faces)


def test_parts_differ_in_shape_whatever_their_size() -> None:
    samples = {name: normalised_samples(name, seed=0) for name in PARTS}
    distances = {
        (a, b): min(chamfer(samples[a] @ rotation, samples[b]) for rotation in axis_rotations())
        for a, b in itertools.combinations(PARTS, 2)
    }
    # The distance between two samplings of one part is what sampling alone accounts for.
    noise = max(chamfer(samples[name], normalised_samples(name, seed=1)) for name in PARTS)
    assert min(distances.values()) > noise + 0.01, distances


def test_mesh_and_file_of_a_solid(tmp_path: Path) -> None:
    vertices, triangles = triangle_mesh(FakeSolid(TETRAHEDRON))
    assert vertices.shape == (4, 3)
    path = tmp_path / "part.stl"
    path.write_bytes(stl_bytes("part", vertices, triangles))
    mesh = trimesh.load_mesh(path)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(1 / 6)
    assert path.read_bytes().startswith(b"kmn_jax industrial set, part, millimetres")


def test_mesh_does_not_depend_on_the_order_of_faces() -> None:
    turned = [(b, c, a) for a, b, c in reversed(TETRAHEDRON)]
    for one, other in zip(triangle_mesh(FakeSolid(TETRAHEDRON)), triangle_mesh(FakeSolid(turned)), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("faces", [TETRAHEDRON[:3], [*TETRAHEDRON[:3], TETRAHEDRON[3][::-1]]], ids=["open", "flipped"])
def test_faulty_surface_is_refused(faces: list[tuple[int, int, int]]) -> None:
    with pytest.raises(ValueError, match="not one closed surface"):
        triangle_mesh(FakeSolid(faces))


def test_catalogue_splits() -> None:
    catalogue = json.loads((ASSETS / "electronics.json").read_text(encoding="utf-8"))
    splits = {split: catalogue[split] for split in ("train", "validation", "test")}
    assert {split: len(names) for split, names in splits.items()} == {"train": 1450, "validation": 50, "test": 7}
    names = list(itertools.chain.from_iterable(splits.values()))
    assert len({name.casefold() for name in names}) == len(names)
    form = re.compile(r"[\w.-]+\.3dshapes/[\w.,-]+", re.ASCII)
    assert [name for name in names if not form.fullmatch(name) or name.endswith((".step", ".wrl"))] == []
