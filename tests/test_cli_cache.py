"""The folder of compiled programs: where it cannot be, commands work without it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

from kmn_jax.cli import main
from kmn_jax.models import create_model, save_model
from tests.reference.networks import TINY


@pytest.fixture(autouse=True)
def own_settings(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Have the command choose the folder, and forget what it chose."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: jax.config.values[name] for name in names}
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.fixture
def convert(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> list[str]:
    save_model(create_model(TINY, jax.random.key(0)), tmp_path / "a.safetensors")
    capfd.readouterr()
    return ["convert", str(tmp_path / "a.safetensors"), str(tmp_path / "b.safetensors")]


@pytest.mark.parametrize("place", ["file", "no home"])
def test_a_cache_that_cannot_be_written_to_is_done_without(
    place: str, convert: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    if place == "file":
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    else:

        def homeless() -> Path:
            raise RuntimeError("Could not determine home directory.")

        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        monkeypatch.setattr(Path, "home", homeless)
    assert main(convert) == 0
    assert capfd.readouterr().err == ""
    assert (tmp_path / "b.safetensors").exists()
    assert jax.config.values["jax_compilation_cache_dir"] is None


def test_a_cache_that_is_named_and_cannot_be_written_to_is_done_without(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    program = (
        "import jax; from kmn_jax.programs import keep_compiled; keep_compiled(); print(jax.jit(lambda x: 3 * x)(2.0))"
    )
    named = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "file" / "cache")}
    ended = subprocess.run([sys.executable, "-c", program], env=named, capture_output=True, text=True, check=True)
    assert (ended.stdout, ended.stderr) == ("6.0\n", "")


def test_a_cache_that_can_be_written_to_is_used(
    convert: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert main(convert) == 0
    assert jax.config.values["jax_compilation_cache_dir"] == str(tmp_path / "cache" / "kmn_jax")
