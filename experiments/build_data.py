"""Build training packs: `python -m experiments.build_data electronics`.

electronics  1,507 components of KiCad's public library, as `experiments/assets/electronics.json` lists them, each in 20
             bins of 1 to 20 copies. The models come from `--models`, a folder that holds them as KiCad lays them out,
             or on Debian and its like from the package kicad-packages3d, which is downloaded (380 MB), not installed.

A build goes on where it stopped, however it stopped; objects that cannot be used are listed with the reason.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from experiments.kicad import catalogue_sources
from kmn_jax.checks import InputError
from kmn_jax.data.build import Record, build_pack
from kmn_jax.data.recipe import PackConfig

OUTPUTS = Path("outputs")


@dataclass(frozen=True)
class Electronics:
    """Build the pack of electronic components."""

    folder: Path = OUTPUTS / "packs" / "electronics"  # where the pack is written
    models: Path | None = None  # folder with KiCad's 3D models; without it, the Debian package is fetched
    limit: int | None = None  # build only so many, spread over the splits
    workers: int | None = None  # processes; all cores unless given
    pack: PackConfig = field(default_factory=PackConfig)

    def run(self) -> None:
        sources, licence = catalogue_sources(self.models, OUTPUTS / "kicad", self.limit)
        records = build_pack(self.folder, sources, self.pack, workers=self.workers, licence=licence)
        print_summary(self.folder, records)


def print_summary(folder: Path, records: list[Record]) -> None:
    """Print what was built and rejected, and what the drops are like."""
    built = [record for record in records if record.entry and record.facts]
    size = sum(record.entry.objects.size for record in built if record.entry)
    bits = sum(record.entry.visibility.size for record in built if record.entry and record.entry.visibility)
    splits = ", ".join(f"{count} {split}" for split, count in Counter(record.split for record in built).items())
    print(f"{folder}: {len(built)} objects ({splits}), {size / 1e6:.1f} MB and {bits / 1e6:.1f} MB of visibility bits")
    if built:
        facts = [record.facts for record in built if record.facts]
        seconds = np.array([record.seconds for record in built])
        stages = {stage: np.median([fact["seconds"][stage] for fact in facts]) for stage in facts[0]["seconds"]}
        print(
            f"seconds an object: median {np.median(seconds):.1f}, 95% below {np.percentile(seconds, 95):.1f}, most"
            f" {seconds.max():.1f}; " + ", ".join(f"{stage} {value:.2f}" for stage, value in stages.items())
        )
        deepest, capped, attempts, floors = (
            np.concatenate([fact[key] for fact in facts])
            for key in ("penetrations", "capped", "attempts", "floor_shares")
        )
        print(
            f"{len(deepest)} scenes: deepest penetration {deepest.max():.3%} of the diagonal, {capped.mean():.2%} at"
            f" the time cap, {attempts.sum() - len(attempts)} drops repeated, {floors.mean():.0%} of parts on the floor"
        )
    rejected = [record for record in records if record.reason]
    print(f"{len(rejected)} rejected" + (":" if rejected else ""))
    for record in rejected:
        print(f"  {record.name} ({record.split}): {record.reason}")


def main() -> None:
    """Run one of the builds."""
    try:
        tyro.extras.subcommand_cli_from_dict({"electronics": Electronics}).run()
    except InputError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
