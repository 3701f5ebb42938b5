"""Data of a run: networks of one object are saved with the digest of its file, and of more objects are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from configs import find_config
from kmn_jax.data import Pack
from kmn_jax.data._pack import write_manifest, write_object
from kmn_jax.errors import InputError
from kmn_jax.train._sources import trained_network

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
