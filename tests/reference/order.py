"""Which files of tests begin first, and how each compiles.

The long ones begin, so that no worker is left alone with one at the end.
"""

from __future__ import annotations

from pathlib import Path

TESTS = Path(__file__).parents[1]
# Whose programs run for long: they are optimised. Those of all others run for moments, and are compiled in half of the
# time. Between files of both kinds all that was compiled is forgotten.
OPTIMISED = (
    "detection/test_estimator.py",
    "experiments/test_evaluate.py",
    "test_docs.py",
    "test_docs_commands.py",
    "test_cli_detect.py",
    "detection/test_bin_program.py",
    "models/test_released.py",
    "ros/test_results.py",
    "experiments/test_train_verifier.py",
)
# The longest first. Training comes second, so that with two workers one compiles the search and the other reads it.
LONGEST = (
    OPTIMISED[0],
    "train/test_loop.py",
    *OPTIMISED[1:],
    "train/test_sharding.py",
    "detection/test_crop_search.py",
    "pose/test_ransac.py",
    "models/test_keymatchnet.py",
    "train/test_checkpoint.py",
    "experiments/test_evaluate_network.py",
    "data/test_build.py",
    "viz/test_viewer.py",
    "viz/test_viewer_panel.py",
    "experiments/test_build_data.py",
    "detection/test_double_precision.py",
    "experiments/test_versions.py",
    "experiments/test_worlds.py",
    "objects/test_symmetry.py",
    "train/test_rendered.py",
    "detection/test_refinement.py",
    "train/test_examples.py",
    "io/test_mutated_files.py",
    "detection/test_search.py",
    "simulate/test_worlds.py",
    "models/test_pair_head.py",
    "pose/test_icp.py",
    "benchmarks/test_gate.py",
)
_PLACES = {TESTS / name: place for place, name in enumerate(LONGEST)}
_OPTIMISED = {TESTS / name for name in OPTIMISED}


def place(path: Path) -> int:
    """Return where a file comes among those that are not of the same place."""
    return _PLACES.get(path, len(_PLACES))


def is_optimised(path: Path) -> bool:
    """Tell whether a file's programs run for long."""
    return path in _OPTIMISED
