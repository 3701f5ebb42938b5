"""What docstrings say of arguments is what functions have: else the documentation does not build."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
FOLDERS = ("kmn_jax", "configs", "experiments", "benchmarks", "ros2")
SECTION = re.compile(r"^Args:\n(?P<lines>(?:(?: .*)?\n)*)", re.M)
ENTRY = re.compile(r"^ {4}(?P<name>\S.*?)(?::(?: |$)|$)", re.M)  # what goes on from the line before stands further in


def functions() -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """All functions, with where they stand."""
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    yield f"{path.relative_to(ROOT)}:{node.lineno}", node


def documented(docstring: str) -> list[str]:
    """Return the names in the section of arguments."""
    section = SECTION.search(docstring + "\n")
    return [] if section is None else ENTRY.findall(section["lines"])


def arguments(node: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    given = node.args
    several = [one for one in (given.vararg, given.kwarg) if one is not None]
    return {one.arg for one in (*given.posonlyargs, *given.args, *given.kwonlyargs, *several)}


def test_arguments_that_docstrings_name_are_in_the_signature_one_a_line() -> None:
    faults, count = [], 0
    for place, node in functions():
        names = documented(ast.get_docstring(node) or "")
        count += len(names)
        faults += [f"{place}: {name} is no argument" for name in names if name not in arguments(node)]
    assert count > 50
    assert faults == []


def test_names_are_read_one_a_line() -> None:
    text = "Do it.\n\nArgs:\n    one: this,\n        and: that.\n    two, three: these.\n    four\n\nReturns it."
    assert documented(text) == ["one", "two, three", "four"]
    assert documented("Do it.") == []
