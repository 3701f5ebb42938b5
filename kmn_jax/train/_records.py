"""What a run writes about itself: its config, its sessions, and its metrics in two forms that survive a restart."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from kmn_jax.errors import InputError
from kmn_jax.files import write_whole
from kmn_jax.limits import parse_json
from kmn_jax.report import commit, processor

COLUMNS = (
    "step",
    "samples",
    "split",
    "loss",
    "segmentation_loss",
    "keypoint_loss",
    "segmentation_accuracy",
    "keypoint_accuracy",
    "learning_rate",
    "gradient_norm",
    "samples_per_second",
    "seconds",
)
_LINES, _TABLE = "metrics.jsonl", "metrics.csv"
_PACKAGES = ("kmn_jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "grain", "numpy")

Row = Mapping[str, float | int | str]


def begin_metrics(folder: Path, step: int, validated: int) -> None:
    """Keep the rows up to a step, those of a run that goes on from there, and drop later ones and broken lines.

    Rows of validations are kept up to step `validated`.
    """
    last = {"validation": validated}
    kept = [row for row in read_metrics(folder) if row["step"] <= last.get(str(row.get("split")), step)]
    write_whole(folder / _LINES, "".join(json.dumps(row) + "\n" for row in kept).encode())
    write_whole(folder / _TABLE, (",".join(COLUMNS) + "\n" + _csv(kept)).encode())


def add_metrics(folder: Path, row: Row) -> None:
    """Append a row of some of the COLUMNS, `step` and `split` always, to `metrics.jsonl` and `metrics.csv`."""
    for name, text in ((_LINES, json.dumps(dict(row)) + "\n"), (_TABLE, _csv([row]))):
        _append(folder / name, text)


def read_metrics(folder: str | Path) -> list[dict[str, Any]]:
    """Return the rows of a run's `metrics.jsonl`, without lines that are damaged; none if there is no file."""
    path = Path(folder) / _LINES
    if not path.exists():
        return []
    rows = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row = parse_json(line)
        except ValueError:
            continue
        if isinstance(row, dict) and isinstance(row.get("step"), int) and all(map(_is_metric, row.values())):
            rows.append(row)
    return rows


def _is_metric(value: Any) -> bool:
    return value is None or isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value))


def write_config(folder: Path, config: Mapping[str, Any]) -> None:
    """Write `config.json`."""
    write_whole(folder / "config.json", json.dumps(config, indent=1).encode() + b"\n")


def check_same(folder: Path, old: Mapping[str, Any], new: Mapping[str, Any], free: tuple[str, ...]) -> None:
    """Raise InputError if the config of a run differs from a new one in more than the `free` names.

    Dots join the names of nested values. Names that the old one lacks, because an earlier version knew none of them,
    are passed over.
    """
    what = what_differs(old, new, free)
    if what:
        raise InputError(f"{folder} holds a run with {what}: resume with the same values, or choose another folder")


def what_differs(old: Mapping[str, Any], new: Mapping[str, Any], free: tuple[str, ...] = ()) -> str:
    """Return in words up to four values, of those that the old config has, which differ from a new one's, if any."""
    old, new = _flat(dict(old)), _flat(parse_json(json.dumps(new)))
    changed = [name for name in sorted(old) if old[name] != new.get(name) and name not in free]
    return ", ".join(f"{name} = {old[name]}, not {new.get(name)}" for name in changed[:4])


def write_session(folder: Path, step: int, facts: Mapping[str, Any]) -> None:
    """Append to `sessions.jsonl` where a session begins, and with which code, versions and devices."""
    session = {
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "step": step,
        **facts,
        "command": sys.argv,
        "commit": commit(),
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in _PACKAGES}},
        "devices": [device.device_kind for device in jax.devices()],
        "processor": processor(),
        "cores": os.cpu_count(),
        "processes": jax.process_count(),
    }
    _append(folder / "sessions.jsonl", json.dumps(session) + "\n")


def _append(path: Path, text: str) -> None:
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _csv(rows: Sequence[Row]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writerows({name: _short(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _short(value: Any) -> Any:
    return f"{value:.7g}" if isinstance(value, float) and math.isfinite(value) else value


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name, value in values.items():
        result |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return result
