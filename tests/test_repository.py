"""The locks are in step with pyproject.toml and with each other, what sets things up, and the order of tests."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.reference.compiled import quick_flags
from tests.reference.order import LONGEST, TESTS, place

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LOCKED_EXTRAS = ("detect", "data", "train", "dev")


def read_lock(name: str) -> dict[str, tuple[str, int]]:
    """Return version and number of hashes by canonical name."""
    lines = (ROOT / name).read_text(encoding="utf-8").replace("\\\n", " ").splitlines()
    pinned: dict[str, tuple[str, int]] = {}
    for line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            requirement = Requirement(re.sub(r"\s--hash=\S+", "", line).strip())
            (pin,) = requirement.specifier
            assert pin.operator == "==", f"{name}: {requirement} is not exact"
            key = canonicalize_name(requirement.name)
            assert key not in pinned, f"{name}: {key} is pinned twice"
            pinned[key] = (pin.version, len(re.findall(r"--hash=sha256:[0-9a-f]{64}\b", line)))
    return pinned


@pytest.mark.parametrize("name", ["requirements.lock", "requirements-bench.lock"])
def test_every_pin_has_hashes(name: str) -> None:
    pinned = read_lock(name)
    assert pinned
    assert [package for package, (_, hashes) in pinned.items() if hashes == 0] == []


def test_lock_holds_every_direct_dependency_in_its_range() -> None:
    pinned = read_lock("requirements.lock")
    extras = PROJECT["optional-dependencies"]
    wanted = [*PROJECT["dependencies"], *(line for extra in LOCKED_EXTRAS for line in extras[extra])]
    for requirement in map(Requirement, wanted):
        key = canonicalize_name(requirement.name)
        if key != canonicalize_name(PROJECT["name"]):
            assert key in pinned, f"{key} is not locked: run `make lock`"
            assert pinned[key][0] in requirement.specifier, f"{key} {pinned[key][0]} is out of range: run `make lock`"


def test_locks_agree() -> None:
    main, bench = read_lock("requirements.lock"), read_lock("requirements-bench.lock")
    assert {name: main[name][0] for name in main.keys() & bench} == {
        name: bench[name][0] for name in main.keys() & bench
    }
    assert "torch" not in main | bench


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
@pytest.mark.parametrize(("verb", "seeks"), [("demo", False), ("test", True)])
def test_only_tests_seek_a_browser(verb: str, seeks: bool) -> None:
    says = subprocess.run(["make", "-nB", verb], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert (".ci/environment browser" in says) == seeks


@pytest.mark.parametrize("refused", ["", "aarch64-apple-darwin 3.12"])
def test_platforms_that_lack_a_wheel_are_named(refused: str, tmp_path: Path) -> None:
    stand_in = tmp_path / "uv"
    stand_in.write_text(
        '#!/bin/sh\nwhile [ $# -gt 0 ]; do case $1 in --python-platform) at=$2;; --python-version) at="$at $2";; esac;'
        f' shift; done\n[ "$at" != "{refused}" ] || {{ echo "no wheel of it"; exit 1; }}\n'
        'echo " + one"\necho " + two"\n'
    )
    stand_in.chmod(0o755)
    given = {**os.environ, "UV": str(stand_in)}
    done = subprocess.run([ROOT / ".ci" / "platforms"], cwd=ROOT, env=given, capture_output=True, text=True)
    lines = [line.split() for line in done.stdout.splitlines()]
    asked = {(platform, version) for platform, version, *_ in lines if version.startswith("3.")}
    versions = {line.rpartition(" ")[2] for line in PROJECT["classifiers"] if "Python :: 3." in line}
    assert {version for _, version in asked} == versions
    assert len(asked) == 4 * len(versions)
    assert done.returncode == bool(refused)
    assert ("no wheel of it" in done.stdout) == bool(refused)
    assert sum(line[2:] == ["2", "packages"] for line in lines) == len(asked) - bool(refused)


def test_long_files_of_tests_begin_first() -> None:
    others = set(TESTS.rglob("test_*.py")) - {TESTS / name for name in LONGEST}
    assert [place(TESTS / name) for name in LONGEST] == list(range(len(LONGEST)))
    assert all((TESTS / name).is_file() for name in LONGEST), "rename it in tests/reference/order.py, too"
    assert {place(path) for path in others} == {len(LONGEST)}


def test_flags_of_xla_that_are_given_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=3 --xla_dump_to=folder")
    flags = quick_flags().split()
    assert flags[:2] == ["--xla_backend_optimization_level=3", "--xla_dump_to=folder"]
    assert (
        len({flag.partition("=")[0] for flag in flags}) == len(flags) == (4 if version("jaxlib")[:5] == "0.10." else 2)
    )
    monkeypatch.setenv("XLA_FLAGS", quick_flags())
    assert quick_flags().split() == flags
