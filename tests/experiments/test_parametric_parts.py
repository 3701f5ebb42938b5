"""Parts made by parameters: closed solids of the right size, each draw another one, the same bytes each time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.parametric_parts import FAMILIES, TEST_FAMILIES, VALIDATION_FAMILIES, write_parts
from experiments.solids import Solid, torus
from experiments.training_parts import COMPOUNDS, TRAINING_FAMILIES, larger_piece
from experiments.various_parts import VARIOUS_FAMILIES
from kmn_jax.objects import load_object
from kmn_jax.simulate import collision_shape


@pytest.mark.parametrize("family", FAMILIES)
def test_solids_are_closed_and_wound_outwards(family: str) -> None:
    extents = []
    for number in range(5):
        vertices, triangles = FAMILIES[family](np.random.default_rng(number))
        assert np.isfinite(vertices).all()
        edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        forward = set(map(tuple, edges.tolist()))
        assert len(forward) == len(edges)
        assert {(b, a) for a, b in forward} == forward
        corners = vertices[triangles]
        assert np.linalg.det(corners).sum() > 0  # six times the volume
        extents.append(np.ptp(vertices, axis=0))
        assert 20 <= extents[-1].max() <= 120
    assert len(np.unique(np.round(extents, 3), axis=0)) == len(extents)


@pytest.mark.parametrize("family", ["washer", "hex_nut", "flanged_tube", "elbow"])
def test_bores_go_through(family: str) -> None:
    assert _is_ring(FAMILIES[family](np.random.default_rng(0)))


def test_a_torus_is_a_ring_of_its_radius() -> None:
    vertices, triangles = torus(10.0, 2.0)
    assert _is_ring((vertices, triangles))
    from_axis = np.hypot(vertices[:, 0], vertices[:, 1])
    np.testing.assert_allclose([from_axis.min(), from_axis.max()], [8, 12])
    np.testing.assert_allclose(np.ptp(vertices[:, 2]), 4)


def _is_ring(solid: Solid) -> bool:
    """Tell whether a solid of one piece has one hole through it."""
    _, triangles = solid
    edges = {tuple(sorted(pair)) for t in triangles.tolist() for pair in zip(t, [*t[1:], t[0]], strict=True)}
    return len(np.unique(triangles)) - len(edges) + len(triangles) == 0


def test_no_family_is_in_two_sets() -> None:
    names = [*VALIDATION_FAMILIES, *VARIOUS_FAMILIES, *TEST_FAMILIES, *TRAINING_FAMILIES, *COMPOUNDS]
    assert len(set(names)) == len(names)
    assert set(names) == set(FAMILIES)


def test_families_keep_their_places_by_which_their_parts_are_drawn() -> None:
    in_order = [*VALIDATION_FAMILIES, *TEST_FAMILIES, *TRAINING_FAMILIES, *COMPOUNDS, *VARIOUS_FAMILIES]
    assert list(FAMILIES)[: len(in_order)] == in_order


def test_compounds_share_one_piece_and_differ_in_the_other() -> None:
    name = next(iter(COMPOUNDS))
    first = larger_piece(name)
    assert sum(larger_piece(other) == first for other in COMPOUNDS) == 4
    assert {larger_piece(other) for other in COMPOUNDS} == set(TRAINING_FAMILIES)
    shapes = [COMPOUNDS[name](np.random.default_rng(number))[0] for number in range(2)]
    base = len(TRAINING_FAMILIES[first](np.random.default_rng(0))[0])  # of a channel, which always has as many corners
    own, other = (np.linalg.norm(np.diff(shape[:base], axis=0), axis=1) for shape in shapes)
    np.testing.assert_allclose(own / own.sum(), other / other.sum())  # the same, but for the size of the whole
    assert not np.allclose(*(np.ptp(shape, axis=0) / np.ptp(shape[:base], axis=0) for shape in shapes))


def test_files_repeat_and_become_objects(tmp_path: Path) -> None:
    first = write_parts(tmp_path, ["mug", "washer"], 1, 3)
    contents = [path.read_bytes() for path in first]
    assert [path.read_bytes() for path in write_parts(tmp_path, ["mug", "washer"], 1, 3)] == contents
    for path in first:
        model = load_object(path, unit="mm")
        assert collision_shape(model.vertices, model.triangles).volume > 0
