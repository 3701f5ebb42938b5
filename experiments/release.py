"""Make a run's best weights the released ones: `python -m experiments.release RUN EVALUATION`.

Writes to `kmn_jax/pretrained/`: the weights, the learning curve as CSV and as a picture, and a model card with all that
is known of the run. Give the JSON of `experiments.evaluate_network` of the same weights for the card's tables, and by
`--detection` what `experiments.detect_bins` and `experiments.detect_worlds` wrote, for how exact poses are.
"""

from __future__ import annotations

import hashlib
import json
import shlex
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import tyro

from configs import CONFIGS
from experiments.evaluation.plots import as_png, new_figure
from kmn_jax.errors import InputError
from kmn_jax.files import write_whole
from kmn_jax.models import PRETRAINED, load_model
from kmn_jax.report import check_target, markdown_table
from kmn_jax.train import read_metrics

LIMIT = 10_000_000  # bytes of a released file
_COLUMNS = ("step", "samples", "seconds", "split", "loss", "segmentation_accuracy", "keypoint_accuracy")
_ALL = "all"  # what detect_worlds calls the row of all families
_POSES = (
    "Of accepted poses that are right by ADI: by how much they are off, the median and, after the stroke, the 90th "
    "percentile, with the object's symmetries taken out; the shift is that of its centre. ADI forgives a part that is "
    "nearly round any turn about its axis, and a nearly square one a quarter. MSSD, the largest distance of a point, "
    "does not: its recall is by accepted poses, at a tenth of the diameter. BOP's average precision is of all poses, "
    "over thresholds of MSSD from 0.05 to 0.5 diameters. Copies are those of which at least 30% is visible."
)
_PUBLISHED_SAMPLES = 27_840_000  # arXiv 2303.16102: 120 epochs of 232,000


@dataclass(frozen=True)
class Options:
    """What is released."""

    run: tyro.conf.Positional[Path]  # folder of the run
    evaluation: tyro.conf.Positional[Path]  # what `python -m experiments.evaluate_network RUN --json` wrote
    name: str | None = None  # of the released model; the run's unless given
    folder: Path = PRETRAINED
    detection: tuple[Path, ...] = ()  # what detect_bins and detect_worlds wrote by --json, of the same weights


def release(options: Options) -> list[Path]:
    """Write weights, curve, picture and card, and return their paths."""
    source = options.run / "model.safetensors"
    _check_made(options, source)
    model = load_model(source)
    rows = read_metrics(options.run)
    config = _json(options.run / "config.json", ("name", "network", "pack", "optimizer", "pipeline"))
    evaluation = _json(options.evaluation, ("sha256", "splits", "published", "objects"))
    sessions = _sessions(options.run / "sessions.jsonl")
    poses = poses_section([_json(path, ("environment", "detection")) for path in options.detection])
    weights = source.read_bytes()
    digest = hashlib.sha256(weights).hexdigest()
    if evaluation.get("sha256") != digest:
        raise InputError(
            f"{options.evaluation} is of other weights than {source}: run python -m experiments.evaluate_network"
            f" {options.run} --json {options.evaluation} again"
        )
    if len(weights) > LIMIT:
        raise InputError(f"{source} has {len(weights)} bytes, but a released file at most {LIMIT}")
    validated = [row for row in rows if row["split"] == "validation"]
    if not validated:
        raise InputError(f"{options.run} has no validation yet: nothing says which weights are the best")
    name = options.name or str(config["name"])
    paths = {kind: options.folder / f"{name}{kind}" for kind in (".safetensors", ".csv", ".png", ".md")}
    check_target(paths[".md"])
    write_whole(paths[".safetensors"], weights)
    write_whole(paths[".csv"], _curve(rows).encode())
    _picture(rows, paths[".png"])
    size = sum(int(leaf.size) for leaf in jax.tree.leaves(model.parameters))
    card = _card(name, config, sessions, validated, evaluation, size, digest, poses)
    write_whole(paths[".md"], card.encode())
    return list(paths.values())


def _check_made(options: Options, source: Path) -> None:
    """Raise InputError for weights or an evaluation that have not been made yet, with the command that makes them."""
    if not source.exists():
        name = options.run.name if options.run.name in CONFIGS else "NAME"
        folder = "" if options.run == Path("runs", name) else f" --folder {shlex.quote(str(options.run))}"
        made_by = f"python -m experiments.train {name}{folder} --resume, which writes them at its first validation"
        raise InputError(f"{options.run} holds no weights yet: {made_by}")
    if not options.evaluation.exists():
        command = shlex.join(["experiments.evaluate_network", str(options.run), "--json", str(options.evaluation)])
        raise InputError(f"{options.evaluation} has not been made yet: python -m {command}")


def _json(path: Path, wanted: tuple[str, ...]) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path} ({error})") from None
    missing = [name for name in wanted if not isinstance(found, dict) or name not in found]
    if missing:
        raise InputError(f"{path} has no {', '.join(missing)}: it is another file than the one that is needed")
    return dict(found)


def _sessions(path: Path) -> list[dict[str, Any]]:
    """Return what a run wrote about its sessions, without a line that was half written."""
    sessions = []
    try:
        for line in path.read_text(encoding="utf-8").splitlines():
            with suppress(ValueError):
                sessions.append(json.loads(line))
    except OSError as error:
        raise InputError(f"cannot read {path} ({error.strerror})") from None
    whole = [
        found for found in sessions if isinstance(found, dict) and {"devices", "command", "versions"} <= found.keys()
    ]
    if not whole:
        raise InputError(f"{path} tells of no session: what the weights were made by is not known")
    return whole


def _curve(rows: list[dict[str, Any]]) -> str:
    lines = [",".join(_COLUMNS)]
    for row in rows:
        cells = (row[column] for column in _COLUMNS)
        lines.append(",".join(f"{cell:.6g}" if isinstance(cell, float) else str(cell) for cell in cells))
    return "\n".join(lines) + "\n"


def _picture(rows: list[dict[str, Any]], path: Path) -> None:
    figure, canvas = new_figure((13, 4))
    axes = figure.subplots(1, 3)
    names = {"loss": "loss", "segmentation_accuracy": "segmentation accuracy", "keypoint_accuracy": "keypoint accuracy"}
    for axis, (key, label) in zip(axes, names.items(), strict=True):
        for split, style in (("train", {"lw": 0.7, "alpha": 0.6}), ("validation", {"marker": "o", "ms": 3})):
            chosen = [row for row in rows if row["split"] == split]
            axis.plot([row["samples"] for row in chosen], [row[key] for row in chosen], label=split, **style)
        axis.set(xscale="log", xlabel="samples", title=label)
        axis.grid(alpha=0.3)
    axes[0].legend()
    write_whole(path, as_png(canvas))


def _beside_published(samples: int, warm_start: str | None) -> str:
    """Return how many samples the published network saw, as a ratio unless a run began with weights of another."""
    published = f"The published network saw {_PUBLISHED_SAMPLES:,}"
    if warm_start is None:
        return f"{published}: {_PUBLISHED_SAMPLES / samples:.0f} times as many"
    return f"They went on from the weights `{warm_start}`, whose samples are not among these. {published}"


def _card(
    name: str,
    config: dict[str, Any],
    sessions: list[dict[str, Any]],
    validated: list[dict[str, Any]],
    evaluation: dict[str, Any],
    parameters: int,
    digest: str,
    poses: str,
) -> str:
    best = min(validated, key=lambda row: float(row["loss"]))
    last, network = validated[-1], config["network"]
    devices = sorted({f"{len(each['devices'])} x {each['devices'][0]} ({_processor(each)})" for each in sessions})
    beside = _beside_published(best["samples"], config.get("warm_start"))
    commits = dict.fromkeys(str(each.get("commit") or "not recorded") for each in sessions)
    here = f"{Path.cwd()}/"  # paths of this machine are of use to nobody
    commands = dict.fromkeys(
        " ".join([Path(each["command"][0]).stem, *each["command"][1:]]).replace(here, "") for each in sessions
    )
    facts = {
        "Weights": f"`{name}.safetensors`, {parameters:,} parameters, SHA-256 `{digest[:16]}…`",
        "Network": f"N = {network['num_scene_points']} scene points, M = {network['num_object_points']} object points,"
        f" K = {network['num_keypoints']} keypoints, k = {network['num_neighbors']} neighbours, {network['inputs']}"
        f" inputs, {network['graph']} graph, {network['compute']}",
        "Data": f"pack `{Path(config['pack']).name}`: {sessions[-1]['training_objects']} training and"
        f" {sessions[-1]['validation_objects']} validation objects, scenes of docs/data.md, made during training",
        "Samples": f"{best['samples']:,} seen by these weights (step {best['step']:,}; the run has validated up to step"
        f" {last['step']:,} of {config['num_steps']:,}). {beside}",
        "Optimizer": f"{config['optimizer']['method']}, rate {config['optimizer']['learning_rate']},"
        f" {config['optimizer']['schedule']} schedule, batch {config['pipeline']['batch_size']}, mean of parameters"
        f" with decay {config['average_decay']}",
        "Time": f"{best['seconds'] / 3600:.1f} hours until then, on {', '.join(devices)}",
        "Commands": "; ".join(f"`python -m experiments.{command}`" for command in commands),
        "Commits": ", ".join(commits) + ", of the sessions in turn",
        "Versions": ", ".join(f"{key} {value}" for key, value in sessions[-1]["versions"].items()),
        "Validation": f"loss {best['loss']:.3f}, segmentation accuracy {best['segmentation_accuracy']:.3f}, keypoint"
        f" accuracy {best['keypoint_accuracy']:.3f}; selected by the loss",
    }
    parts = [f"# {name}", "Made by `experiments/release.py`; change that, not this file.", f"![Curve]({name}.png)"]
    parts.append("\n".join(f"- **{key}**: {value}." for key, value in facts.items()))
    parts.append("## Loss and accuracies\n\nPublished rows are of the authors' data, not of ours.")
    parts.append(markdown_table([*evaluation["splits"], *evaluation["published"]]))
    for folder, rows in evaluation["objects"].items():
        parts.append(f"## Test objects: {folder}\n\n{markdown_table(rows) if rows else 'None.'}")
    parts += filter(None, [poses])
    parts.append(
        "## What it leaves on the table\n\n"
        f"Keypoint accuracy on validation objects went from {validated[0]['keypoint_accuracy']:.3f} after"
        f" {validated[0]['samples']:,} samples to {last['keypoint_accuracy']:.3f} after {last['samples']:,}; see the"
        " curve for whether it still rises. The published accuracy took many more samples."
    )
    return "\n\n".join(parts) + "\n"


def poses_section(detections: list[dict[str, Any]]) -> str:
    """Return how many copies of whole bins are found and how exactly, of what detection wrote; empty without any."""
    rows = [row for found in detections for row in whole_rows(found["detection"])]
    if not rows:
        return ""
    table = [
        {
            "bins": "world bins" if row["bins"] == _ALL else row["bins"],
            "copies": row["copies"],
            "recall": f"{row['recall']:.2f}",
            "right, of the accepted": _share(row["precision"]),
            "shifted, mm": _both(row, "shifted, mm"),
            "shifted, % of the diameter": _both(row, "shifted, diameters", 100),
            "turned, degrees": _both(row, "turned, degrees"),
            "MSSD recall": f"{row['MSSD recall']:.2f}",
            "average precision": _share(row["average precision"]),
        }
        for row in rows
    ]
    commands = dict.fromkeys(f"`{found['environment']['command']}`" for found in detections)
    return f"## Poses in whole bins\n\n{_POSES}\n\n{markdown_table(table)}\n\nBy {' and '.join(commands)}."


def whole_rows(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of detection's results that are neither of one object nor of one family."""
    return [row for row in rows if row["bins"] == _ALL] or [row for row in rows if ":" not in row["bins"]]


def _both(row: dict[str, Any], name: str, times: float = 1) -> str:
    """Return the median and the 90th percentile as text."""
    values = [row[f"{name}, {which}"] for which in ("median", "90%")]
    return "-" if None in values else " / ".join(f"{times * value:.3g}" for value in values)


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _processor(session: dict[str, Any]) -> str:
    return f"{session['processor']}, {session['cores']} cores" if "processor" in session else "processor not recorded"


def main(arguments: list[str] | None = None) -> int:
    """Release a run's weights: 0 is success, 2 bad input, in one sentence on stderr."""
    try:
        for path in release(tyro.cli(Options, args=arguments, prog="experiments.release", description=__doc__)):
            print(f"wrote {path}")
    except InputError as error:
        print(f"release: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
