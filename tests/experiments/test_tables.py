"""Tables of the guides are those of the committed results."""

from __future__ import annotations

import pytest

from experiments.tables import DOCS, ROOT, rewritten, tables
from kmn_jax.errors import InputError

TABLE = "| bins | recall |\n|---|---|\n| a | 1 |\n| b | kmn_jax | 2 |\n| b | another | 3 |\n\n| a | 4 |"


@pytest.mark.parametrize("name", DOCS)
def test_the_guides_tell_what_was_measured(name: str) -> None:
    text, rows_of = (ROOT / name).read_text(encoding="utf-8"), tables()
    assert any(heading in text.splitlines() for heading in rows_of)
    assert rewritten(text, rows_of) == text  # else: python -m experiments.tables


def test_every_table_is_in_a_guide() -> None:
    lines = [line for name in DOCS for line in (ROOT / name).read_text(encoding="utf-8").splitlines()]
    assert all(heading in lines for heading in tables())


def test_rows_take_the_place_of_those_that_begin_as_they_do() -> None:
    rows = {"| bins | recall |": [["a", "0.5"], ["b", "kmn_jax", "0.6"]], "| not there |": [["c", "1"]]}
    assert rewritten(TABLE, rows) == TABLE.replace("| a | 1 |", "| a | 0.5 |").replace("| 2 |", "| 0.6 |")


def test_a_row_that_is_missing_is_one_sentence() -> None:
    with pytest.raises(InputError, match=r"0 rows of the table '\| bins \| recall \|' begin with '\| c'"):
        rewritten(TABLE, {"| bins | recall |": [["c", "1"]]})
