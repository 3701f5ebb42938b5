"""Bins of datasets, whose objects are read from meshes or from cards that were made of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.bins import bin_images
from kmn_jax.errors import InputError
from kmn_jax.models import load_pretrained
from kmn_jax.objects import save_part
from tests.experiments.test_whole_bin import SMALL


def test_cards_stand_for_the_meshes_of_a_dataset(tmp_path: Path) -> None:
    model = load_pretrained()
    image = next(bin_images(SMALL, "test", model))
    save_part(image.part, tmp_path / f"{image.part.name}.kmn")
    with pytest.raises(InputError, match=r"obj_000002\.kmn"):
        next(bin_images(SMALL, "test", model, cards=tmp_path))
    for stranger in image.strangers:
        save_part(stranger, tmp_path / f"{stranger.name}.kmn")
    other = next(bin_images(SMALL, "test", model, cards=tmp_path))
    assert (image.key, image.part.name) == (other.key, other.part.name)
    np.testing.assert_array_equal(image.part.points, other.part.points)
    np.testing.assert_array_equal(image.truth, other.truth)
    assert [part.name for part in image.strangers] == [part.name for part in other.strangers] == ["obj_000002"]
