"""The names at the top of the package: imported when they are first used, and none of them missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

import kmn_jax


@pytest.mark.parametrize("name", kmn_jax.__all__)
def test_every_name_is_there_and_documented(name: str) -> None:
    value = getattr(kmn_jax, name)
    assert value.__doc__
    assert value.__module__.startswith("kmn_jax.")
    assert name in dir(kmn_jax)


def test_names_that_are_not_there_are_refused() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'Estimator'"):
        kmn_jax.Estimator  # noqa: B018
    with pytest.raises(ImportError):
        exec("from kmn_jax import nothing")


def test_importing_loads_jax_only_when_a_name_needs_it() -> None:
    program = (
        "import sys, kmn_jax; assert 'jax' not in sys.modules; kmn_jax.kabsch; assert 'jax' in sys.modules;"
        "assert 'kmn_jax.detection' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_bad_input_is_one_class_of_error() -> None:
    assert issubclass(kmn_jax.InputError, ValueError)
    with pytest.raises(kmn_jax.InputError):
        kmn_jax.kabsch([[0.0, 0, 0]], [[0.0, 0, 0]])
