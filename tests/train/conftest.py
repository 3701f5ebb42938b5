"""What the tests of training runs share: compiled steps and a run without a stop."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

from kmn_jax.train import train
from kmn_jax.train._loop import Outcome
from tests.train.loop_sample import COMPILED, tiny


@pytest.fixture(scope="module")
def compiled() -> Iterator[None]:
    """Compile once for the tests of a file, their processes, and the next run of the tests."""
    from jax.experimental.compilation_cache import compilation_cache

    before = {name: jax.config.values[name] for name in COMPILED}
    compilation_cache.reset_cache()
    for name, value in COMPILED.items():
        jax.config.update(name, value)
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture(scope="module")
def whole(compiled: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    """A run without a stop: copy it before changing it."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    return folder, train(tiny(), folder, progress=False, report=lambda message: None)
