"""What poses depend on beside settings: code, of which each method's own makes its own poses stale alone; libraries."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_ROOT = Path(__file__).parents[2]
# Of all methods: cases and refinement.
_SHARED = (
    *(f"kmn_jax/{room}" for room in ("geometry", "io", "objects", "simulate", "bop", "data")),
    *(f"kmn_jax/detection/_{name}.py" for name in ("scan_crop", "view", "background", "foreground", "planes", "walls")),
    *(f"kmn_jax/pose/_{name}.py" for name in ("icp", "kabsch", "result")),
    *(f"experiments/evaluation/{name}.py" for name in ("cases", "clouds", "predictions", "refinement", "sources")),
)
_OURS = (
    "kmn_jax/models",
    *(f"kmn_jax/pose/_{name}.py" for name in ("matches", "ransac", "surface")),
    "kmn_jax/detection/_crop_pose.py",
    "experiments/evaluation/methods.py",
)
_RIVALS = ("experiments/evaluation/rivals.py",)
_LIBRARIES = ("jax", "jaxlib", "numpy", "open3d")  # of all methods: open3d reads scans


def shared_code() -> str:
    """Return the SHA-256 of the code that decides the poses of all methods."""
    return _digest(_SHARED)


def our_code() -> str:
    """Return the SHA-256 of the code of our methods, beside what is shared."""
    return _digest(_OURS)


def rivals_code() -> str:
    """Return the SHA-256 of the code of rivals, beside what is shared."""
    return _digest(_RIVALS)


def library_versions(names: Iterable[str] = _LIBRARIES) -> dict[str, str | None]:
    """Return versions of libraries, unless others are named of those that decide all poses; None if not there."""

    def found(name: str) -> str | None:
        try:
            return version(name)
        except PackageNotFoundError:
            return None

    return {name: found(name) for name in names}


def sources(names: tuple[str, ...] = (*_SHARED, *_OURS, *_RIVALS)) -> list[Path]:
    """Return the files of all code that decides poses, or of some of it, by files and folders."""
    found: list[Path] = []
    for place in (_ROOT / name for name in names):
        files = [place] if place.is_file() else sorted(place.rglob("*.py"))
        if not files:
            raise FileNotFoundError(f"{place} decides poses, but is not there")
        found += files
    return found


def _digest(names: tuple[str, ...]) -> str:
    digest = hashlib.sha256()
    for path in sources(names):
        digest.update(path.relative_to(_ROOT).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()
