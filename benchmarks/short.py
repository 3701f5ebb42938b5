"""A short set of all benchmarks, a few minutes on two cores: what `make bench` runs.

python -m benchmarks.short [--folder outputs/bench]
"""

from __future__ import annotations

from pathlib import Path

import tyro

from benchmarks import knn, network, pose


def main(folder: Path = Path("outputs/bench")) -> None:
    """Run every subject at small batch sizes and write one JSON file for each.

    Args:
        folder: where the results go.
    """
    network.main(batches=(1, 4), repeats=9, json=folder / "network.json")
    knn.main(sizes=(2048,), repeats=9, json=folder / "knn.json")
    pose.main(draws=20, inlier_shares=(0.2, 0.1), batches=(1, 4), repeats=9, json=folder / "pose.json")


if __name__ == "__main__":
    tyro.cli(main)
