"""Which files of tests begin first: the long ones, so that no worker is left alone with one at the end."""

from __future__ import annotations

from pathlib import Path

TESTS = Path(__file__).parents[1]
# The longest first, and of them those that search bins. Training comes second, so that with two workers one compiles
# the search and the other reads it. Files that compile in another way stand together: before and after them all that
# was compiled is forgotten.
LONGEST = (
    "detection/test_estimator.py",
    "train/test_loop.py",
    "experiments/test_evaluate.py",
    "test_docs.py",
    "test_docs_commands.py",
    "test_cli_detect.py",
    "experiments/test_versions.py",
    "ros/test_results.py",
    "detection/test_bin_program.py",
    "train/test_sharding.py",
    # In the other way:
    "detection/test_crop_search.py",
    "models/test_keymatchnet.py",
    "experiments/test_evaluate_network.py",
    "train/test_examples.py",
    "models/test_pair_head.py",
    "models/test_chirality.py",
    "detection/test_search.py",
    "simulate/test_worlds.py",
    "geometry/test_accelerator_forms.py",
    "geometry/test_groups.py",
    "geometry/test_normals.py",
    "pose/test_accelerator_forms.py",
    "benchmarks/test_gate.py",
    # In the usual way:
    "pose/test_ransac.py",
    "train/test_checkpoint.py",
    "experiments/test_build_data.py",
    "data/test_build.py",
    "experiments/test_worlds.py",
    "viz/test_viewer.py",
    "viz/test_viewer_panel.py",
    "train/test_rendered.py",
    "data/test_crops.py",
    "pose/test_icp.py",
    "simulate/test_physics.py",
    "simulate/test_splat.py",
)
_PLACES = {TESTS / name: place for place, name in enumerate(LONGEST)}


def place(path: Path) -> int:
    """Return where a file comes among those that are not of the same place."""
    return _PLACES.get(path, len(_PLACES))
