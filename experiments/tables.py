"""Write the tables on whole scans in README.md, docs/detect.md and RESULTS.md anew, from the committed results.

`python -m experiments.tables` after `detect_bins`, `detect_worlds` or `search_curve`; what is said around the tables,
dates and processors among it, is to be read again then.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro

from experiments.release import whole_rows
from experiments.search_curve import PLAIN
from kmn_jax.errors import InputError
from kmn_jax.files import write_whole

ROOT = Path(__file__).parents[1]
DOCS = ("README.md", "docs/detect.md", "experiments/RESULTS.md")
_RESULTS = ROOT / "experiments" / "results"
_OURS = "kmn_jax"
_OTHERS = "other scenes"
_OTHERS_IN_SHORT = (
    "[other scenes](docs/detect.md#outside-of-these-bins): tables, trays, full bins, mixed parts, other sensors"
)
_RELEASED = (
    "what is released: fitted to what searches refine and choose today, to full bins and to twelve more families of"
    " parts, by models of either error together; what is said of poses of one scan by the most probable one, up to log"
    " odds of 5; of known worlds to `verifier` alone ([results](results/worlds_test.json))"
)
_SEARCHES = {
    "fast: one draw": "fast",
    "it goes on for poses of 0.5, `DetectConfig(promising=0.5)`": "goes on from 0.5",
    "usual: up to two draws, and three such rounds": PLAIN,
    "the best pose of each place alone refined, `DetectConfig(next_best=0, sure=0.0)`": "best alone",
    "up to four draws": "four draws",
    "thorough": "thorough",
}

# The first lines of the tables.
_IN_SHORT = (
    "| bins | recall, accepted from 0.8 on | right, of the accepted | recall down to where 95% are right"
    " | seconds a bin |"
)
_BINS = (
    "| bins | method | images | copies with 30% visible | recall | accepted | of these right | recall at 95% right"
    " | median s |"
)
_EXACTNESS = "| bins | shifted, mm | shifted, % of the diameter | turned, degrees | MSSD recall | average precision |"
_WORLDS = (
    "| bins | images | copies with 30% visible | recall | accepted | of these right | recall at 95% right"
    " | at 90% right | calibration error | by chance | searched in vain | accepted there | median s |"
)
_CURVE = (
    "| search | recall from 0.8 on | difference, 95% interval | of these right | recall at 95% right | median s | 90% s"
    " | times as long |"
)
_FITTED = (
    "| fitted to | recall | accepted | of these right | recall at 95% right | in vain | calibration error"
    " | worst kinds of scenes |"
)

Row = dict[str, Any]


def tables() -> dict[str, list[list[str]]]:
    """Return the rows of tables, by the first line of each table. Raises InputError if a result lacks one."""
    worlds, bins, searches = (_result(name) for name in ("worlds_test", "detection", "search_curve"))
    own, (together,) = whole_rows(bins["detection"]), whole_rows(worlds["detection"])
    by_name = {row["search"]: row for row in searches["settings"]}
    missing = [name for name in _SEARCHES.values() if name not in by_name]
    if missing:
        raise InputError(f"the search curve was made without {missing[0]!r}: see docs/detect.md for its command")
    return {
        _IN_SHORT: [_in_short(name, row) for name, row in _named(own, together, _OTHERS_IN_SHORT)],
        _BINS: [_of_bins(row) for row in own],
        _EXACTNESS: [_exactness(name, row) for name, row in _named(own, together, _OTHERS)],
        _WORLDS: [_of_worlds(row) for row in worlds["detection"]],
        _CURVE: [_of_search(text, by_name[name]) for text, name in _SEARCHES.items()],
        _FITTED: [_of_fit(together, worlds["detection"])],
    }


def rewritten(text: str, rows_of: dict[str, list[list[str]]]) -> str:
    """Return a text with rows of its tables in place of those that have the same name, and, where it is ours, method.

    Other rows of a table, such as those of another method, stay. Raises InputError if a table has no such row.
    """
    lines = text.split("\n")
    for heading, rows in rows_of.items():
        if heading not in lines:
            continue
        first = lines.index(heading) + 2
        last = next(number for number in range(first, len(lines)) if not lines[number].startswith("|"))
        for row in rows:
            names = _written(row[: 2 if row[1] == _OURS else 1]).removesuffix(" |")
            places = [number for number in range(first, last) if lines[number].startswith(f"{names} |")]
            if len(places) != 1:
                raise InputError(f"{len(places)} rows of the table {heading!r} begin with {names!r}: it needs one")
            lines[places[0]] = _written(row)
    return "\n".join(lines)


def main() -> None:
    """Rewrite the tables of README.md, docs/detect.md and experiments/RESULTS.md from the committed results."""
    rows_of = tables()
    for name in DOCS:
        path = ROOT / name
        write_whole(path, rewritten(path.read_text(encoding="utf-8"), rows_of).encode())
        print(f"wrote {name}")


def _result(name: str) -> Row:
    result: Row = json.loads((_RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return result


def _written(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _named(own: list[Row], together: Row, name: str) -> list[tuple[str, Row]]:
    return [*((row["bins"], row) for row in own), (name, together)]


def _in_short(name: str, row: Row) -> list[str]:
    accepted = f"{_percent(row['precision'])} of {row['accepted']:,}"
    return [name, *_numbers(row, "recall"), accepted, *_numbers(row, "recall at precision 0.95"), _seconds(row)]


def _of_bins(row: Row) -> list[str]:
    found = [str(row[key]) for key in ("method", "images", "copies")]
    return [row["bins"], *found, *_right(row), _seconds(row)]


def _of_worlds(row: Row) -> list[str]:
    rest = _numbers(row, "recall at precision 0.9", "calibration error", "calibration error by chance")
    in_vain = [str(row[key]) for key in ("searched in vain", "accepted there")]
    return [row["bins"], str(row["images"]), str(row["copies"]), *_right(row), *rest, *in_vain, _seconds(row)]


def _of_fit(together: Row, rows: list[Row]) -> list[str]:
    families = [row for row in rows if not row["bins"].startswith(together["bins"])]
    families.sort(key=lambda row: row["calibration error"], reverse=True)
    worst = ", ".join(f"{row['bins']} {row['calibration error']:.2f}" for row in families[:2])
    in_vain = str(together["accepted there"])
    return [_RELEASED, *_right(together), in_vain, *_numbers(together, "calibration error"), worst]


def _right(row: Row) -> list[str]:
    right = _percent(row["precision"])
    return [*_numbers(row, "recall"), str(row["accepted"]), right, *_numbers(row, "recall at precision 0.95")]


def _exactness(name: str, row: Row) -> list[str]:
    def both(what: str, times: float = 1) -> str:
        return " / ".join(_significant(times * row[f"{what}, {which}"]) for which in ("median", "90%"))

    errors = both("shifted, mm"), both("shifted, diameters", 100), both("turned, degrees")
    return [name, *errors, *_numbers(row, "MSSD recall", "average precision")]


def _of_search(text: str, row: Row) -> list[str]:
    difference = "-" if row["search"] == PLAIN else row["difference of recall, 95%"]
    recall, reached = _numbers(row, "recall", "recall at precision 0.95")
    seconds = [f"{row[key]:.1f}" for key in ("median s", "90% s")]
    return [text, recall, difference, f"{row['precision']:.0%}", reached, *seconds, *_numbers(row, "times as long")]


def _numbers(row: Row, *names: str) -> list[str]:
    return [f"{row[name]:.2f}" for name in names]


def _seconds(row: Row) -> str:
    return f"{row['median s']:.1f}"


def _percent(share: float) -> str:
    return "100%" if share == 1 else f"{share:.1%}"


def _significant(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:#.2g}".removesuffix(".")


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except InputError as problem:
        sys.exit(f"error: {problem}")
