"""The report of an evaluation: Markdown, and a page of HTML that needs no other file."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.evaluation.cases import Method, ObjectImages
from experiments.evaluation.chosen import OURS, chosen_cases
from experiments.evaluation.configs import EvaluateConfig, noise_name
from experiments.evaluation.methods import Ours
from experiments.evaluation.pictures import Picture, case_grid
from experiments.evaluation.plots import recall_plot
from experiments.evaluation.predictions import Export
from experiments.evaluation.published import MILLISECONDS, RECALL, SOURCE
from experiments.evaluation.scores import (
    THRESHOLD,
    Cell,
    accuracy_rows,
    object_rows,
    paired_rows,
    pooled,
    recall_rows,
    seed_rows,
)
from experiments.evaluation.whole_bin import whole_bin
from kmn_jax.files import write_whole
from kmn_jax.report import markdown_table, print_table

_GATES = (
    "A pose is right if its ADI to the nearest copy is below a tenth of the object's diameter, in the second column of "
    "each noise below a tenth of its bounding box's diagonal. In brackets: Wilson's 95% interval. Times are of one "
    "crop after another, warm, with the object prepared beforehand; rows with ICP include it, the same for all."
)
_SEEDS = (
    "The share of crops in which the pose is right, within a tenth of the diameter, and of the very copy that the crop "
    "is around; above, a neighbour that is seen better counts as well, as a robot may pick it."
)
_ACCURACY = (
    "Of poses that are right by ADI: by how much they are off the nearest copy, the median and, after the stroke, the "
    "90th percentile; symmetries of the object are taken out, and the shift is that of its centre. Of all crops: the "
    "share whose MSSD, the largest distance of a point at the most favourable symmetry, is below a tenth of the "
    "diameter, and the mean of such shares at thresholds from 0.05 to 0.5, as BOP takes it."
)

_PAIRED = (
    "By how much the recall of {own} is higher on the same crops, all objects together; in brackets the 95% interval, "
    "for which scans are independent, crops of one scan are not. Below zero the other method finds more."
)

_SETTINGS = "Settings; lengths are shares of the diameter"
_ORIGIN = "Where, when and of what it was made"


@dataclass(frozen=True)
class Result:
    """All that is reported."""

    config: EvaluateConfig
    environment: Mapping[str, Any]
    weights: str  # digest of the network that our methods use unless they have their own
    recipe: Mapping[str, Any]
    cells: Sequence[Cell]
    skipped: Mapping[str, str]  # why methods could not run
    problems: Sequence[str]  # what of the data was left out
    methods: Mapping[str, Method]  # that ran, by their keys
    commits: Sequence[str]  # that poses were made at, before or now


def write_report(folder: Path, result: Result, pictures: Mapping[str, Picture]) -> Path:
    """Write report.md, report.html, scores.json and the pictures; return the page."""
    sections = list(_sections(result))
    for name, picture in pictures.items():
        write_whole(folder / f"{name}.png", picture.content)
    write_whole(folder / "report.md", _markdown(result, sections, pictures).encode())
    page = folder / "report.html"
    write_whole(page, _page(result, sections, pictures).encode())
    write_whole(folder / "scores.json", (json.dumps(_scores(result), indent=1) + "\n").encode())
    print_table(f"{result.config.name}: recall", recall_rows(result.cells, "all"))
    return page


def draw_pictures(result: Result, objects: Sequence[ObjectImages], exported: Export) -> dict[str, Picture]:
    """Return a whole bin, the plot and the grid of cases by the names of their files."""
    pictures: dict[str, Picture] = {}
    method = result.methods.get(OURS)
    searched = whole_bin(objects, result.config.weights) if isinstance(method, Ours) else None
    if searched is not None:
        pictures["whole_bin"] = searched
    pictures["recall"] = Picture(recall_plot(result.cells, result.config.noise))
    if isinstance(method, Ours):
        titles = {key: method.name for key, method in result.methods.items()}
        shown = chosen_cases(result.config, objects, exported, result.cells, titles, _rivals(result))
        if shown:
            pictures["cases"] = Picture(case_grid(method, shown))
    return pictures


def beaten_by(cells: Sequence[Cell], own: str, others: Collection[str]) -> list[str]:
    """Return a sentence for each object, noise and gate at which one of the others' recall is higher than our own."""
    ours = {(cell.object, cell.noise): cell for cell in cells if cell.method == own}
    found = []
    for gate, cell in ((gate, cell) for gate in ("diameter", "diagonal") for cell in cells if cell.method in others):
        beside = ours[cell.object, cell.noise]
        if not cell.recall(gate) > beside.recall(gate):
            continue
        apart = cell.interval(gate)[0] > beside.interval(gate)[1]
        found.append(
            f"{cell.object}, {noise_name(cell.noise)}, by {gate}: {cell.method} {cell.recall(gate):.2f},"
            f" {own} {beside.recall(gate):.2f} ({'beyond' if apart else 'within'} the intervals)"
        )
    return found


def headline(cells: Sequence[Cell], own: str, rivals: Collection[str]) -> str:
    """Return in a sentence how much the own method and the best rival find of all objects, at the least noise.

    Empty if there are no cells of the own method.
    """
    noise = min((cell.noise for cell in cells), default=0.0)
    recalls = {
        method: pooled(those, "all objects").recall()
        for method in dict.fromkeys(cell.method for cell in cells)
        if (those := [cell for cell in cells if (cell.method, cell.noise) == (method, noise)])
    }
    if own not in recalls:
        return ""
    count = len({cell.object for cell in cells})
    text = f"{own} finds the right pose in {_percent(recalls[own])} of the crops of {count} object"
    text += "s" if count > 1 else ""
    others = {method: recalls[method] for method in recalls if method in rivals}
    if others:
        best = max(others, key=lambda method: others[method])
        text += f", the best rival, {best}, in {_percent(others[best])}"
    return f"{text} ({noise_name(noise)})."


def _percent(share: float) -> str:
    """Return a share as the tables round it."""
    return f"{float(f'{share:.2f}'):.0%}"


def _rivals(result: Result) -> list[str]:
    """Return the keys of methods that are no form of our pipeline with the same network."""
    return [key for key, method in result.methods.items() if not isinstance(method, Ours)]


def _rival_methods(result: Result) -> set[str]:
    return {f"{result.methods[key].name}{refined}" for key in _rivals(result) for refined in ("", " + ICP")}


def _headline(result: Result) -> str:
    if OURS not in result.methods:
        return ""
    return headline(result.cells, f"{result.methods[OURS].name} + ICP", _rival_methods(result))


def _sections(result: Result) -> list[tuple[str, str, list[dict[str, Any]]]]:
    """Return headings, texts and tables."""
    config, cells = result.config, result.cells
    objects = list(dict.fromkeys(cell.object for cell in cells))
    rows = recall_rows(cells, "all")
    least, most = (function(len(cell.errors) for cell in cells) for function in (min, max))
    crops = f"{most} crops of each" if least == most else f"{least} to {most} crops of each"
    sections = [(f"Recall, objects: {len(objects)}, {crops}", _GATES, rows)]
    if config.name in RECALL:
        sections.append(("Published", f"{SOURCE}. {MILLISECONDS}.", RECALL[config.name]))
    if OURS in result.methods:
        own = f"{result.methods[OURS].name} + ICP"
        sections += _comparisons(result, own)
        sections.append(("Paired differences", _PAIRED.format(own=own), paired_rows(cells, own)))
    sections.append(("On the copy that the crop is around", _SEEDS, seed_rows(cells)))
    for noise in config.noise:
        sections.append((f"How exact right poses are, {noise_name(noise)}", _ACCURACY, accuracy_rows(cells, noise)))
    for noise in config.noise:
        sections.append((f"By object, {noise_name(noise)}", "", object_rows(cells, noise)))
    left_out = [f"{name}: {reason}" for name, reason in result.skipped.items()] + list(result.problems)
    if left_out:
        sections.append(("Left out", "\n".join(f"- {line}" for line in left_out), []))
    settings = [
        {"method": name, "settings": json.dumps(values)} for name, values in result.recipe["methods"].items()
    ] + [{"method": "ICP of all", "settings": json.dumps(result.recipe["refinement"])}]
    sections.append((_SETTINGS, "", settings))
    return sections


def _comparisons(result: Result, own: str) -> list[tuple[str, str, list[dict[str, Any]]]]:
    """Return where rivals find more than our own, and where other forms of it do, these for all objects together."""
    cells = result.cells
    rivals = _rival_methods(result)
    methods = dict.fromkeys(cell.method for cell in cells)
    whole = [
        pooled([c for c in cells if c.method == method and c.noise == noise], "all objects")
        for method in methods
        for noise in result.config.noise
    ]
    sections: list[tuple[str, str, list[dict[str, Any]]]] = []
    for who, compared, others in (
        ("another method", [*whole, *cells], rivals),
        ("another form of ours", whole, {*methods} - rivals - {own}),
    ):
        beaten = beaten_by(compared, own, others)
        if beaten:
            text = "\n".join(f"- {line}" for line in beaten)
            sections.append((f"Where {who} finds more than {own}", text, []))
    return sections


def _facts(result: Result) -> dict[str, str]:
    environment = result.environment
    versions = ", ".join(f"{key} {value}" for key, value in environment["versions"].items())
    return {
        "Command": environment["command"],
        "Commit": str(environment["commit"]),
        "Poses": f"made at {'commit' if len(result.commits) == 1 else 'commits'} {', '.join(result.commits)}",
        "Date": environment["date"],
        "Machine": f"{environment['processor']}, {environment['cores']} cores, {environment['platform']}",
        "Versions": versions,
        "Weights": f"{result.config.weights}, digest of its parameters {result.weights[:16]}",
        "Data": f"{result.config.name}, digest {str(result.recipe['data'])[:16]}, seed {result.config.random_seed}",
    }


def _markdown(
    result: Result, sections: Sequence[tuple[str, str, list[dict[str, Any]]]], pictures: Mapping[str, Picture]
) -> str:
    parts = [f"# Evaluation: {result.config.name}"]
    parts += filter(None, [_headline(result)])
    for name, picture in pictures.items():
        if picture.title:
            parts += [f"## {picture.title}", picture.text, f"![{name}]({name}.png)"]
    for title, text, rows in sections:
        parts += [f"## {title}", *([text] if text else []), *([markdown_table(rows)] if rows else [])]
    parts += [f"![{name}]({name}.png)" for name, picture in pictures.items() if not picture.title]
    parts += [f"## {_ORIGIN}", "\n".join(f"- {key}: {value}" for key, value in _facts(result).items())]
    return "\n\n".join(parts) + "\n"


def _page(
    result: Result, sections: Sequence[tuple[str, str, list[dict[str, Any]]]], pictures: Mapping[str, Picture]
) -> str:
    body = [f"<h1>Evaluation: {html.escape(result.config.name)}</h1>"]
    body.append(f'<p class="headline">{html.escape(_headline(result))}</p>')
    drawn = []
    for name, picture in pictures.items():
        source = base64.b64encode(picture.content).decode()
        image = f'<div class="wide"><img alt="{name}" src="data:image/png;base64,{source}"></div>'
        if picture.title:
            body += [f"<h2>{html.escape(picture.title)}</h2>", _paragraphs(picture.text), image]
        else:
            drawn.append(image)
    for number, (title, text, rows) in enumerate(sections):
        if title == _SETTINGS:
            body += [f"<details><summary>{html.escape(title)}</summary>", _table(rows), "</details>"]
        else:
            body += [f"<h2>{html.escape(title)}</h2>", _paragraphs(text), _table(rows)]
        if number == 0:  # what tells most comes first
            body += drawn
    facts = [f"<dt>{html.escape(key)}</dt><dd>{html.escape(value)}</dd>" for key, value in _facts(result).items()]
    body += [f"<details><summary>{_ORIGIN}</summary><dl>", *facts, "</dl></details>"]
    return _PAGE.replace("{title}", html.escape(result.config.name)).replace("{body}", "\n".join(body))


def _paragraphs(text: str) -> str:
    if not text:
        return ""
    lines = text.split("\n")
    if all(line.startswith("- ") for line in lines):
        return "<ul>" + "".join(f"<li>{html.escape(line[2:])}</li>" for line in lines) + "</ul>"
    return f"<p>{html.escape(text)}</p>"


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    if not rows:
        return ""
    columns = list(rows[0])
    head = "".join(f"<th>{html.escape(column)}</th>" for column in columns)
    lines = [
        "<tr>" + "".join(f"<td>{html.escape(_text(row.get(column)))}</td>" for column in columns) + "</tr>"
        for row in rows
    ]
    return f'<div class="wide"><table><tr>{head}</tr>{"".join(lines)}</table></div>'


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"
    return str(value)


def _scores(result: Result) -> dict[str, Any]:
    """Return all cells in numbers."""
    cells = [
        {
            "method": cell.method,
            "object": cell.object,
            "noise": cell.noise,
            "crops": len(cell.errors),
            "recall": {gate: cell.recall(gate) for gate in ("diameter", "diagonal")},
            "interval": {gate: cell.interval(gate) for gate in ("diameter", "diagonal")},
            **_offsets(cell),
            "mean s": float(cell.seconds.mean()) if len(cell.seconds) else None,
            "median s": float(np.median(cell.seconds)) if len(cell.seconds) else None,
        }
        for cell in result.cells
    ]
    facts = {
        "environment": dict(result.environment),
        "weights": result.weights,
        "recipe": dict(result.recipe),
        "poses": list(result.commits),
    }
    return {**facts, "skipped": dict(result.skipped), "left out": list(result.problems), "cells": cells}


def _offsets(cell: Cell) -> dict[str, Any]:
    """Return how exact a cell's right poses are, and its recall by MSSD."""
    if cell.offsets is None or not len(cell.errors):
        return {}
    right = cell.errors < THRESHOLD
    found = {name: getattr(cell.offsets, name)[right] for name in ("degrees", "millimetres", "shares")}
    return {
        "off": {name: np.percentile(values, (50, 90)).tolist() for name, values in found.items() if len(values)},
        "MSSD recall": float((cell.offsets.mssd < THRESHOLD).mean()),
    }


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>kmn_jax evaluation: {title}</title>
<style>
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1200px; padding: 0 1rem; color: #222; }
.headline { font-size: 1.15rem; } summary { margin-top: 2rem; cursor: pointer; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; font-size: .85rem; }
dt { color: #666; } dd { margin: 0; overflow-wrap: anywhere; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: .85rem; }
th, td { border-bottom: 1px solid #ddd; padding: .25rem .6rem; text-align: left; vertical-align: top; }
th { border-bottom: 2px solid #888; overflow-wrap: break-word; } th:not(:first-child) { min-width: 4rem; }
td:first-child { white-space: nowrap; }
img { max-width: 100%; }
@media (max-width: 800px) {
  img[alt=cases] { max-width: none; width: 1100px; }
  img[alt=whole_bin] { max-width: none; width: max(100%, 640px); }
}
</style>
</head>
<body>
{body}
</body>
</html>
"""
