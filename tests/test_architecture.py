"""docs/architecture.md is true: its rooms import what it says, and its arrows are public functions of their rooms."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
ROOMS = [path.parent.name for path in (ROOT / "kmn_jax").glob("*/__init__.py")]


def table(header: str) -> list[list[str]]:
    """Return the cells of all tables with a header."""
    rows = []
    for block in re.findall(rf"^\| {header} .*\n\|[-|]+\n((?:\|.*\n)+)", PAGE, re.M):
        rows += [[cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines()]
    return rows


def imported_rooms(room: str) -> set[str]:
    found = set()
    for path in (ROOT / "kmn_jax" / room).glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("kmn_jax."):
                found.add((node.module or "").split(".")[1])
    return (found & set(ROOMS)) - {room}


def test_the_rooms_import_what_the_page_says() -> None:
    said = {cells[0].strip("`"): set(filter(None, re.split(r",\s*", cells[2]))) for cells in table("room")}
    assert said == {room: imported_rooms(room) for room in ROOMS}


@pytest.mark.parametrize("cells", table("function"), ids=lambda cells: cells[0])
def test_the_arrows_are_public_functions_that_return_what_the_page_says(cells: list[str]) -> None:
    names, rooms, _, returned = cells
    homes = [importlib.import_module(f"kmn_jax.{room}") for room in re.findall(r"[a-z]+", rooms) if room in ROOMS]
    for name in re.findall(r"`(\w+)`", names):
        (home,) = [home for home in homes if name in home.__all__][:1]
        function = getattr(home, name)
        types = re.findall(r"`([A-Z]\w+)`", returned)
        annotation = str(getattr(function, "__annotations__", {}).get("return", ""))
        assert all(kind in annotation for kind in types), f"{name} returns {annotation}"
        assert all(any(hasattr(importlib.import_module(f"kmn_jax.{room}"), kind) for room in ROOMS) for kind in types)


def test_the_files_that_the_page_names_are_there() -> None:
    named = re.findall(r"`((?:kmn_jax|experiments|tests|configs)/[\w/.]+)`", PAGE)
    assert named
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_no_room_reaches_into_the_modules_of_another() -> None:
    faults = []
    for room in ROOMS:
        for path in (ROOT / "kmn_jax" / room).glob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                parts = (node.module or "").split(".") if isinstance(node, ast.ImportFrom) else []
                if len(parts) > 2 and parts[0] == "kmn_jax" and parts[1] in ROOMS and parts[1] != room:
                    faults.append(f"{path.relative_to(ROOT)} imports {node.module}")  # type: ignore[attr-defined]
    assert faults == []
