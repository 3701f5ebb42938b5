"""Which files of tests begin first: the long ones, so that no worker is left alone with one at the end."""

from __future__ import annotations

from pathlib import Path

TESTS = Path(__file__).parents[1]
# The longest first; those that search bins with the same programs are apart, so that one compiles and the others read.
LONGEST = (
    "detection/test_estimator.py",
    "train/test_loop.py",
    "experiments/test_evaluate.py",
    "detection/test_crop_search.py",
    "detection/test_bin_program.py",
    "train/test_sharding.py",
    "train/test_checkpoint.py",
    "test_cli_detect.py",
    "experiments/test_build_data.py",
    "experiments/test_versions.py",
    "data/test_build.py",
    "test_docs.py",
    "experiments/test_evaluate_network.py",
    "test_docs_commands.py",
    "viz/test_viewer.py",
    "viz/test_viewer_panel.py",
    "train/test_examples.py",
    "simulate/test_physics.py",
    "simulate/test_splat.py",
    "ros/test_results.py",
    "data/test_crops.py",
    "models/test_keymatchnet.py",
    "pose/test_ransac.py",
)
_PLACES = {TESTS / name: place for place, name in enumerate(LONGEST)}


def place(path: Path) -> int:
    """Return where a file comes among those that are not of the same place."""
    return _PLACES.get(path, len(_PLACES))
