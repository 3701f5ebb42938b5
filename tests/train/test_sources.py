"""Data of a run: networks of one object are saved with the digest of its file, and of more objects are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from configs import find_config
from kmn_jax.data import Pack
from kmn_jax.data._pack import write_manifest, write_object
from kmn_jax.errors import InputError
from kmn_jax.models import create_model, save_model, with_chiral_inputs
from kmn_jax.released import RELEASED
from kmn_jax.train._sources import trained_network, warm_parameters

DEBUG = find_config("debug")
SMALL_PACK = Path(__file__).parent.parent.parent / DEBUG.pack
LEARNED = replace(DEBUG, network=replace(DEBUG.network, object_branch="learned"))


def test_a_network_of_one_object_knows_its_file(tmp_path: Path) -> None:
    one = Pack(SMALL_PACK).load(Pack(SMALL_PACK).names()[0])
    items = [one, replace(one, name="again", split="validation")]
    write_manifest(tmp_path, [write_object(tmp_path, item) for item in items])
    network = trained_network(replace(LEARNED, pack=str(tmp_path)))
    assert network == replace(LEARNED.network, object_digest=one.digest)
    assert one.digest


def test_networks_of_any_object_know_none(tmp_path: Path) -> None:
    assert trained_network(replace(DEBUG, pack=str(tmp_path))) == DEBUG.network


def test_several_objects_are_refused() -> None:
    with pytest.raises(InputError, match=r"objects, but a network with learned features is of one"):
        trained_network(replace(LEARNED, pack=str(SMALL_PACK)))


def test_a_warm_start_begins_with_the_weights_of_a_file(tmp_path: Path) -> None:
    assert warm_parameters(DEBUG) is None
    model = create_model(DEBUG.network, jax.random.key(7))
    save_model(model, tmp_path / "some.safetensors")
    found = warm_parameters(replace(DEBUG, warm_start=str(tmp_path / "some.safetensors")))
    for leaf, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(model[1]), strict=True):
        np.testing.assert_array_equal(leaf, wanted)
    with pytest.raises(
        InputError, match=r"is a network with edge_width = 64, not 16, .*: choose the same, or leave it out"
    ):
        warm_parameters(replace(DEBUG, warm_start=RELEASED))
    dynamic = replace(DEBUG.network, graph="dynamic", num_neighbors=5, dropout=0.3)
    same = warm_parameters(replace(DEBUG, network=dynamic, warm_start=str(tmp_path / "some.safetensors")))
    assert jax.tree.all(jax.tree.map(np.array_equal, same, found))  # none of these has parameters
    chiral = replace(DEBUG, network=replace(DEBUG.network, inputs="chiral", num_keypoints=5))
    grown = warm_parameters(replace(chiral, warm_start=str(tmp_path / "some.safetensors")))
    for leaf, wanted in zip(jax.tree.leaves(grown), jax.tree.leaves(with_chiral_inputs(model)[1]), strict=True):
        np.testing.assert_array_equal(leaf, wanted)
