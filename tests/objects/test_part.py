"""Object cards: what they hold, that they come back bit for bit, and what is refused."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import jax
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from kmn_jax.errors import InputError
from kmn_jax.models import Model, create_model, load_model, save_model
from kmn_jax.objects import (
    ObjectConfig,
    ObjectModel,
    Part,
    arrays_of,
    load_object,
    load_part,
    make_part,
    model_digest,
    save_part,
)
from tests.reference.networks import TINY

STL = Path(__file__).parent.parent.parent / "experiments" / "assets" / "industrial" / "shaft.stl"
CONFIG = replace(TINY, num_object_points=128, num_keypoints=8)


@pytest.fixture(scope="module")
def model() -> Model:
    return create_model(CONFIG, jax.random.key(0))


@pytest.fixture(scope="module")
def shaft() -> ObjectModel:
    return load_object(STL, "mm", ObjectConfig(num_points=256))


@pytest.fixture(scope="module")
def part(shaft: ObjectModel, model: Model) -> Part:
    return make_part(shaft, model)


def test_a_card_remembers_that_its_unit_was_assumed_and_older_ones_do_not(part: Part, tmp_path: Path) -> None:
    save_part(part, tmp_path / "stated.kmn")
    assert "assumed" not in _facts(tmp_path / "stated.kmn")  # as cards were before
    assert not load_part(tmp_path / "stated.kmn").is_unit_assumed
    save_part(replace(part, is_unit_assumed=True), tmp_path / "assumed.kmn")
    found = load_part(tmp_path / "assumed.kmn")
    assert found.is_unit_assumed
    assert found.in_unit("m").is_unit_assumed


def test_a_card_comes_back_bit_for_bit(part: Part, model: Model, tmp_path: Path) -> None:
    path = tmp_path / "shaft.kmn"
    save_part(part, path)
    assert path.stat().st_size < 1_000_000
    found = load_part(path, model_digest(model))
    for field in fields(Part):
        one, other = getattr(found, field.name), getattr(part, field.name)
        if field.name == "symmetries":
            assert one.tolerance == other.tolerance
            for name in ("rotations", "axes", "center"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        elif isinstance(one, np.ndarray):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
        else:
            assert one == other
    assert part.features.shape == (8, 8)
    assert part.is_symmetric == (len(part.symmetries.rotations) > 1 or len(part.symmetries.axes) > 0)


def test_a_part_is_printed_in_a_line(part: Part) -> None:
    assert repr(part) == str(part) == "Part(shaft: diameter 80.38 mm, 256 points, 8 keypoints, no symmetry)"
    plain = part.symmetries
    turned = replace(plain, rotations=np.concatenate([plain.rotations, plain.rotations]))
    texts = [str(replace(plain, axes=np.eye(3)[:count])) for count in (1, 3)]
    assert texts == ["turns about an axis look the same", "looks the same from all sides"]
    assert "2 poses look the same" in repr(replace(part, symmetries=turned))


def test_the_digest_is_of_parameters_wherever_they_come_from(model: Model, tmp_path: Path) -> None:
    save_model(model, tmp_path / "model.safetensors")
    assert model_digest(load_model(tmp_path / "model.safetensors")) == model_digest(model)
    assert model_digest(create_model(CONFIG, jax.random.key(1))) != model_digest(model)
    other = create_model(replace(CONFIG, num_neighbors=5), jax.random.key(0))
    assert model_digest(other) != model_digest(model)


def test_a_network_of_one_object_refuses_others(shaft: ObjectModel) -> None:
    own = replace(CONFIG, object_branch="learned", object_digest=shaft.digest)
    assert make_part(shaft, create_model(own, jax.random.key(0))).num_keypoints == 8
    other = create_model(replace(own, object_digest="0" * 64), jax.random.key(0))
    with pytest.raises(InputError, match="this network was trained for one object, and shaft is of another CAD file"):
        make_part(shaft, other)


def test_a_card_of_other_weights_is_refused_with_what_renews_it(part: Part, tmp_path: Path) -> None:
    path = tmp_path / "shaft.kmn"
    save_part(part, path)
    with pytest.raises(InputError, match=r"by other weights than those in use: make it again with kmn prepare"):
        load_part(path, "0" * 64)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("points", np.zeros((5, 2), np.float32)),
        ("normals", np.zeros((3, 3), np.float32)),
        ("normals", np.zeros((256, 3), np.float32)),
        ("normals", np.full((256, 3), 3e38, np.float32)),
        ("features", np.full((8, 8), np.nan, np.float32)),
        ("symmetry_rotations", np.zeros((0, 3, 3))),
        ("minimum", None),
        ("minimum", np.full(3, 1e6)),
        ("minimum", np.full(3, -1e6)),
        ("features", np.full((8, 8), 1e300)),
        ("points", np.full((256, 3), 1e30, np.float32)),
        ("symmetry_rotations", np.zeros((1, 3, 3))),
        ("symmetry_axes", np.zeros((1, 3))),
        ("unit", None),
    ],
)
def test_a_damaged_card_is_refused(part: Part, tmp_path: Path, name: str, value: np.ndarray | None) -> None:
    path = tmp_path / "shaft.kmn"
    save_part(part, path)
    tensors = load_file(path)
    header = {"format": "kmn_jax object card 1", "facts": _facts(path)}
    if name == "unit":
        header["facts"] = header["facts"].replace('"mm"', '"lm"')
    elif value is None:
        del tensors[name]
    else:
        tensors[name] = value
    save_file(tensors, path, metadata=header)
    with pytest.raises(InputError, match="is a damaged object card"):
        load_part(path)


def test_features_that_are_not_the_networks_are_refused(part: Part, model: Model) -> None:
    assert arrays_of(model, part).features.shape == (8, 8)
    with pytest.raises(InputError, match="but this network needs 8 for each keypoint: make it again with kmn prepare"):
        arrays_of(model, replace(part, features=np.ones((8, 5), np.float32)))


def test_what_is_no_card_is_refused(part: Part, tmp_path: Path) -> None:
    path = tmp_path / "shaft.kmn"
    path.write_bytes(b"solid shaft")
    with pytest.raises(InputError, match="not a readable safetensors file"):
        load_part(path)
    header = json.dumps({"a" * 5000: "b" * 5000}).encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    with pytest.raises(InputError, match="not a readable safetensors file") as caught:
        load_part(path)
    assert len(str(caught.value)) < len(str(path)) + 200
    save_file({"points": part.points}, path)
    with pytest.raises(InputError, match="is no object card of this version"):
        load_part(path)


def test_too_few_points_are_refused(shaft: ObjectModel) -> None:
    with pytest.raises(InputError, match="has 256 points, but this network takes 2048"):
        make_part(shaft, create_model(replace(CONFIG, num_object_points=2048), jax.random.key(0)))


def _facts(path: Path) -> str:
    from safetensors import safe_open

    with safe_open(str(path), "np") as file:
        return str(file.metadata()["facts"])
