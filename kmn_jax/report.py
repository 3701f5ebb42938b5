"""What results are shown and stored as: tables in Markdown, and JSON with the device and versions they came from."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax

from kmn_jax.files import check_outputs, make_folder, write_whole


def environment() -> dict[str, Any]:
    """Return device, versions, commit, date and command."""
    packages = ("jax", "jaxlib", "flax", "numpy", "torch", "open3d")
    versions = {"python": platform.python_version()}
    for package in packages:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "device": str(jax.devices()[0].device_kind),
        "platform": jax.default_backend(),
        "processor": processor(),
        "cores": os.cpu_count(),
        "versions": versions,
        "commit": commit(),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "command": " ".join(["python -m", _module(), *sys.argv[1:]]),
    }


def print_table(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows as a Markdown table; the first one names the columns."""
    print(f"\n### {title}\n\n{markdown_table(rows) if rows else '(none)'}", flush=True)


def markdown_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as a Markdown table; the first one names the columns, and what a row lacks is a dash."""
    columns = list(rows[0])
    cells = [columns, *([_format(row.get(column)) for column in columns] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(columns))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in cells
    ]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def write_json(path: Path | None, results: Mapping[str, Any]) -> None:
    """Write results and environment to `path`, if there is one."""
    if path is None:
        return
    check_target(path)
    text = json.dumps({"environment": environment(), **results}, indent=1, default=_plain)
    write_whole(path, f"{text}\n".encode())
    print(f"\nwrote {path}")


def check_target(*paths: Path | None) -> None:
    """Make the folders of files that are to be written; call it before what takes time.

    Raises InputError if a file cannot be written, or is to hold two results.
    """
    for path in paths:
        if path is not None:
            make_folder(path.parent)
    check_outputs(paths)


def _plain(value: Any) -> Any:
    return asdict(value) if hasattr(value, "__dataclass_fields__") else float(value)


def _format(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"
    return str(value)


def processor() -> str:
    """Return the name of this machine's processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def commit() -> str | None:
    """Return the commit of the checkout that this code runs from, marked if files differ; None outside of one."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() if result.returncode == 0 else None


def _module() -> str:
    main = sys.modules.get("__main__")
    specification = getattr(main, "__spec__", None)
    return specification.name if specification is not None else Path(sys.argv[0]).stem
