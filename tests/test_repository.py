"""The locks are in step with pyproject.toml and with each other; the order of tests names files that there are."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

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


def test_long_files_of_tests_begin_first() -> None:
    others = set(TESTS.rglob("test_*.py")) - {TESTS / name for name in LONGEST}
    assert [place(TESTS / name) for name in LONGEST] == list(range(len(LONGEST)))
    assert all((TESTS / name).is_file() for name in LONGEST), "rename it in tests/reference/order.py, too"
    assert {place(path) for path in others} == {len(LONGEST)}
