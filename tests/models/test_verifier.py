"""The pose verifier as data: its shapes, its file, and which weights ship."""

from __future__ import annotations

import hashlib
from pathlib import Path

import jax
import numpy as np
import pytest

from kmn_jax.detection import VERIFIED, VERIFIER_SIDE
from kmn_jax.errors import InputError
from kmn_jax.files import read_safetensors, safetensors_bytes
from kmn_jax.models import (
    VERIFIER,
    VERIFIER_CHANNELS,
    Verifier,
    create_verifier,
    load_verifier,
    save_verifier,
    verify,
)

CELLS = np.random.default_rng(1).normal(size=(VERIFIER_SIDE, VERIFIER_SIDE, VERIFIER_CHANNELS)).astype(np.float32)
says = jax.jit(verify, static_argnames="graphdef")


@pytest.fixture(scope="module")
def verifier() -> Verifier:
    return create_verifier(jax.random.key(0))


def test_log_odds_are_a_number_that_every_cell_may_change(verifier: Verifier) -> None:
    assert says(*verifier, CELLS).shape == ()
    change = np.asarray(jax.jit(jax.grad(lambda cells: verify(*verifier, cells)))(CELLS))
    assert np.isfinite(change).all()
    assert (np.abs(change).max(axis=(0, 1)) > 0).all()  # each channel
    assert (np.abs(change).max(axis=-1) > 0).mean() > 0.9


def test_dropout_is_by_a_key_alone(verifier: Verifier) -> None:
    plain, again, *others = (float(says(*verifier, CELLS, key)) for key in (None, None, *map(jax.random.key, (1, 2))))
    assert plain == again
    assert len({plain, *others}) == 3


def test_what_is_saved_is_loaded(verifier: Verifier, tmp_path: Path) -> None:
    path = tmp_path / "verifier.safetensors"
    save_verifier(verifier, path)
    loaded = load_verifier(path)
    assert loaded.graphdef == verifier.graphdef
    assert "0x" not in repr(loaded.graphdef)  # by which programs are kept
    jax.tree.map(np.testing.assert_array_equal, loaded.parameters, verifier.parameters)
    assert float(says(*loaded, CELLS)) == float(says(*verifier, CELLS))


def test_another_file_is_refused(verifier: Verifier, tmp_path: Path) -> None:
    path = tmp_path / "verifier.safetensors"
    with pytest.raises(InputError, match="not a readable safetensors file"):
        load_verifier(path)
    save_verifier(verifier, path)
    tensors, _ = read_safetensors(path)
    for wrong, problem in (
        ({name: value for name, value in tensors.items() if name != "out.bias"}, "out.bias is missing"),
        (tensors | {"out.bias": np.zeros(2, np.float32)}, r"out.bias has shape \(2,\), but the network needs \(1,\)"),
        (tensors | {"out.bias": np.full(1, np.nan, np.float32)}, "out.bias has values that are not finite"),
        (tensors | {"more": np.zeros(1, np.float32)}, "more is unknown"),
    ):
        path.write_bytes(safetensors_bytes(wrong))
        with pytest.raises(InputError, match=problem):
            load_verifier(path)


def test_the_name_of_its_evidence_belongs_to_the_weights_that_ship() -> None:
    """Calibrations name what they were fitted to: with other weights, raise the number of VERIFIED and change this."""
    digest = hashlib.sha256(VERIFIER.read_bytes()).hexdigest()
    assert (VERIFIED, digest[:16]) == ("verifier_2", "b6dff7c314ef88cd")
    card = VERIFIER.with_suffix(".md").read_text(encoding="utf-8")
    assert digest[:16] in card
    assert np.isfinite(says(*load_verifier(), CELLS))
