"""Which command makes the folders that others read unless they are told of other ones."""

from __future__ import annotations

from pathlib import Path

from kmn_jax.errors import InputError

_MAKERS = {  # by folder: what is asked of experiments.build_data
    "outputs/test_sets": "test-sets",
    "outputs/validation_bins": "validation-bins",
    "outputs/worlds": "worlds",
    "outputs/packs/electronics": "electronics",
    "outputs/packs/electronics_120": "electronics --limit 120 --folder outputs/packs/electronics_120",
    "outputs/packs/surfels": "surfels",
    "outputs/packs/per_object": "per-object --cad FILE --folder outputs/packs/per_object",
}


def require_made(*folders: Path | str | None) -> None:
    """Raise InputError for a folder of ours that has not been made yet, with the command that makes it."""
    for folder in (Path(folder) for folder in folders if folder is not None):
        makers = [maker for place, maker in _MAKERS.items() if folder.is_relative_to(place)]
        if makers and not folder.exists():
            raise InputError(f"{folder} has not been made yet: python -m experiments.build_data {makers[0]}")
