"""Build the data: `python -m experiments.build_data electronics`, then `test-sets`.

electronics  the training pack: 1,507 components of KiCad's public library, as `assets/electronics.json` lists them, in
             20 bins each, of 1 to 20 copies. The models come from `--models`, a folder that holds them as KiCad lays
             them out, or on Debian and its like from the package kicad-packages3d, which is downloaded (380 MB) but
             not installed.
surfels      the surfels of these components and of parts made by parameters (`experiments/training_parts.py`), without
             bins: the training pack of worlds that are made inside of the step.
test-sets    7 electronic and 7 industrial objects in 20 bins each, rendered by ray casting, as BOP datasets; their
             digests are compared with those in `assets/test_sets.json`.
validation-bins  the 50 validation components in 6 bins each, rendered by ray casting, one half as a perfect sensor sees
             them, the other as a structured-light scanner: what the probabilities of detections are fitted on.
worlds       bins, trays and tables of many kinds (`experiments/worlds.py`), of parts made by parameters: three
             to train the pose verifier with, one of them and two others to fit probabilities on, and one to test on.
cad-folder   the pack of all CAD files in and below a folder, of which every tenth is for validation; with
             `--pack.drops 0` without bins, which is enough for configs with worlds.
per-object   the pack of one part, for a network of its own: 160 training and 160 validation scenes.
check        what a pack holds: every file against its checksum, every copy against the walls of its bin.
small        the few objects and images that the repository carries: `assets/small_pack`, `assets/small_test_set`.

A build goes on where it stopped, however it stopped; objects that cannot be used are listed with the reason.
"""

from __future__ import annotations

import random
import sys
from collections import Counter
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
import tyro
from jaxtyping import Float

from experiments.kicad import catalogue_sources
from experiments.parametric_parts import write_parts
from experiments.test_sets import (
    ASSETS,
    CONFIG,
    VALIDATION_CONFIG,
    build_test_set,
    claim,
    electronics_sources,
    industrial_sources,
    is_unexplained,
    record_digests,
    validation_sources,
    verdict,
)
from experiments.training_parts import PARTS_SEED, TRAINING_FAMILIES
from experiments.worlds import COMPOUND, TEST, TRAINING, VALIDATION, VARIOUS, VERIFIER, Recipe, build_worlds
from kmn_jax.data import Pack, PackConfig, PackedObject, Record, Source, build_pack
from kmn_jax.errors import InputError, check_whole
from kmn_jax.files import make_folder
from kmn_jax.io import MESH_SUFFIXES
from kmn_jax.simulate import PERFECT, BinScene, SensorConfig

OUTPUTS = Path("outputs")
SMALL_PACK = (
    "Capacitor_THT.3dshapes/CP_Axial_L21.0mm_D8.0mm_P28.00mm_Horizontal",
    "Connector_PinHeader_2.54mm.3dshapes/PinHeader_1x07_P2.54mm_Vertical_SMD_Pin1Right",
    "Battery.3dshapes/BatteryHolder_Keystone_2466_1xAAA",
    "Button_Switch_SMD.3dshapes/SW_DIP_SPSTx04_Slide_9.78x12.34mm_W8.61mm_P2.54mm",
    "Diode_THT.3dshapes/D_DO-15_P5.08mm_Vertical_KathodeUp",
    "Package_TO_SOT_SMD.3dshapes/TSOT-23",
)
SMALL_TEST_SET = ("Connector_USB.3dshapes/USB_A_TE_292303-7_Horizontal", "gear_motor")
WorldSet = Literal["training", "verifier", "compound", "validation", "various", "test"]
WORLDS: dict[WorldSet, Recipe] = {
    "training": TRAINING,
    "verifier": VERIFIER,
    "compound": COMPOUND,
    "validation": VALIDATION,
    "various": VARIOUS,
    "test": TEST,
}


@dataclass(frozen=True)
class Electronics:
    """Build the pack of electronic components."""

    folder: Path = OUTPUTS / "packs" / "electronics"  # where the pack is written
    models: Path | None = None  # folder with KiCad's 3D models; without it, the Debian package is fetched
    limit: int | None = None  # build only so many, spread over the splits
    workers: int | None = None  # processes; all cores unless given
    retry_rejected: bool = False  # try again what an earlier run rejected
    pack: PackConfig = field(default_factory=PackConfig)

    def run(self) -> None:
        sources, licence = catalogue_sources(self.models, OUTPUTS / "kicad", self.limit)
        records = build_pack(
            self.folder,
            sources,
            self.pack,
            workers=self.workers,
            retry_rejected=self.retry_rejected,
            licence=licence,
        )
        print_summary(self.folder, records)


@dataclass(frozen=True)
class AllSurfels:
    """Build the pack of surfels of electronic components and of parts made by parameters."""

    folder: Path = OUTPUTS / "packs" / "surfels"
    models: Path | None = None  # as for electronics
    limit: int | None = None  # of the components, build only so many
    parts: int = 40  # of each family
    workers: int | None = None

    def run(self) -> None:
        sources, licence = catalogue_sources(self.models, OUTPUTS / "kicad", self.limit)
        make_folder(self.folder)
        with TemporaryDirectory(dir=self.folder) as made:
            paths = write_parts(Path(made), tuple(TRAINING_FAMILIES), self.parts, PARTS_SEED)
            sources += [Source(path.stem, "train", path) for path in paths]
            random.Random(PARTS_SEED).shuffle(sources)
            config = PackConfig(drops=0)
            records = build_pack(self.folder, sources, config, workers=self.workers, licence=licence)
        print_summary(self.folder, records)


@dataclass(frozen=True)
class TestSets:
    """Build the test sets and compare their digests with the recorded ones."""

    folder: Path = OUTPUTS / "test_sets"
    models: Path | None = None  # as for electronics
    workers: int | None = None
    sensor: SensorConfig = field(default_factory=SensorConfig)  # a perfect one unless told otherwise
    record: bool = False  # write the digests into the repository instead

    def run(self) -> None:
        exact = self.sensor == PERFECT
        if self.record and not exact:
            raise InputError("the recorded digests are those of a perfect sensor: leave out either record or sensor")
        sources = {
            "electronics": electronics_sources(self.models, OUTPUTS / "kicad"),
            "industrial": industrial_sources(),
        }
        digests = {
            name: build_test_set(self.folder / name, own, CONFIG, self.sensor, self.workers)
            for name, own in sources.items()
        }
        if exact:
            report_digests(digests, self.record)
        else:
            print("\n".join(f"{self.folder / name}: {digest}" for name, digest in digests.items()))


@dataclass(frozen=True)
class ValidationBins:
    """Build the bins that the probabilities of detections are fitted on."""

    folder: Path = OUTPUTS / "validation_bins"
    models: Path | None = None  # as for electronics
    workers: int | None = None

    def run(self) -> None:
        sources = validation_sources(self.models, OUTPUTS / "kicad")
        sensors = {"perfect": PERFECT, "structured_light": SensorConfig.structured_light()}
        for row, (name, sensor) in enumerate(sensors.items()):
            build_test_set(self.folder / name, sources[row::2], VALIDATION_CONFIG, sensor, self.workers)


@dataclass(frozen=True)
class Worlds:
    """Build the world bins and compare their digests with the recorded ones."""

    sets: tuple[WorldSet, ...] = tuple(WORLDS)
    folder: Path = OUTPUTS / "worlds"
    workers: int | None = None
    record: bool = False  # write the digests into the repository instead

    def run(self) -> None:
        digests = {f"worlds_{name}": build_worlds(self.folder / name, WORLDS[name], self.workers) for name in self.sets}
        report_digests(digests, self.record)


@dataclass(frozen=True)
class CadFolder:
    """Build the pack of one's own CAD files, called as they are called in their folder."""

    cad: Path  # their folder
    folder: Path = OUTPUTS / "packs" / "own"
    every: int = 10  # so many files one is for validation, the first included
    workers: int | None = None
    retry_rejected: bool = False  # try again what an earlier run rejected
    pack: PackConfig = field(default_factory=PackConfig)

    def run(self) -> None:
        check_whole(self.every, "every", 2)
        if not self.cad.is_dir():
            raise InputError(f"{self.cad} is not a folder: name the one that holds the CAD files")
        found = (path for path in self.cad.rglob("*") if path.suffix.lower() in MESH_SUFFIXES)
        files = sorted(path for path in found if path.is_file())
        if len(files) < 2:
            raise InputError(
                f"{self.cad} holds {len(files)} CAD files ({', '.join(MESH_SUFFIXES)}), but a pack needs one for"
                " training and one for validation"
            )
        sources = [
            Source(path.relative_to(self.cad).as_posix(), "train" if row % self.every else "validation", path)
            for row, path in enumerate(files)
        ]
        claim(self.folder, _contents(sources), "journal.jsonl", "a pack of other files than these")
        records = build_pack(self.folder, sources, self.pack, workers=self.workers, retry_rejected=self.retry_rejected)
        print_summary(self.folder, records)
        for split in ("train", "validation"):
            if not any(record.entry and record.split == split for record in records):
                raise InputError(f"{self.folder} has no object for {split}: none of their files could be used")


def _contents(sources: list[Source]) -> dict[str, list[str]]:
    """Return split and digest of each file by its name. Raises InputError if one cannot be read."""
    try:
        return {source.name: [source.split, sha256(source.path.read_bytes()).hexdigest()] for source in sources}
    except OSError as error:
        raise InputError(f"{error.filename} cannot be read: {error.strerror}") from None


@dataclass(frozen=True)
class PerObject:
    """Build the pack of one part, for a network of its own: training and validation scenes are different ones."""

    cad: Path
    folder: Path = OUTPUTS / "packs" / "per_object"
    workers: int | None = None
    pack: PackConfig = field(default_factory=lambda: PackConfig(drops=160))

    def run(self) -> None:
        name = self.cad.stem
        sources = [Source(name, "train", self.cad), Source(f"{name}.validation", "validation", self.cad, scenes=1)]
        print_summary(self.folder, build_pack(self.folder, sources, self.pack, workers=self.workers))


@dataclass(frozen=True)
class Check:
    """Check the files of a pack, and that all copies are inside of their bins."""

    folder: Path = OUTPUTS / "packs" / "electronics"
    tolerance: float = 0.003  # share of the object's diagonal by which a copy may reach into wall or floor

    def run(self) -> None:
        from tqdm import tqdm

        pack = Pack(self.folder)
        problems = pack.problems()
        for problem in problems:
            print(problem)
        damaged = scenes = copies = outside = 0
        worst = 0.0
        for name in tqdm(pack.names(), unit="object"):
            try:
                item = pack.load(name, visibility=False)
            except InputError:
                damaged += 1  # listed above
                continue
            diagonal = float(np.linalg.norm(np.ptp(item.points, axis=0)))
            for drop in item.drops:
                reach = reach_beyond_bin(item, drop.scene) / diagonal
                scenes, copies = scenes + 1, copies + len(reach)
                outside, worst = outside + int((reach > self.tolerance).sum()), max(worst, float(reach.max()))
        print(
            f"{len(pack.names())} objects, {damaged} of them damaged; {scenes} scenes, {copies} copies, {outside} of"
            f" them more than {self.tolerance:.1%} of the diagonal into a wall or the floor, the most {worst:.2%}"
        )
        if problems or outside or not scenes:
            sys.exit(1)


def report_digests(digests: dict[str, str], record: bool) -> None:
    """Print digests with what the repository says of them, or write them into it; exit if one is unexplained."""
    if record:
        record_digests(digests)
    for name, digest in digests.items():
        print(f"{name}: {digest}: {verdict(name, digest)}")
    if any(is_unexplained(name, digest) for name, digest in digests.items()):
        sys.exit(1)


def reach_beyond_bin(item: PackedObject, scene: BinScene) -> Float[np.ndarray, " n"]:
    """Return how far each copy's surfels reach beyond the planes of walls and floor, in metres; below zero: inside."""
    points = np.einsum("nij,mj->nmi", scene.T_bin_object[:, :3, :3], item.points) + scene.T_bin_object[:, None, :3, 3]
    sides = np.abs(points[..., :2]) - np.array([scene.bin.length, scene.bin.width]) / 2
    return np.maximum(sides.max(axis=(1, 2)), -points[..., 2].min(axis=1))


@dataclass(frozen=True)
class Small:
    """Build the small pack and test set that the repository carries."""

    folder: Path = ASSETS
    models: Path | None = None
    workers: int | None = None

    def run(self) -> None:
        sources, licence = catalogue_sources(self.models, OUTPUTS / "kicad", None)
        chosen = [source for source in sources if source.name in SMALL_PACK]
        config = PackConfig(drops=10, copies=(2, 20))
        records = build_pack(self.folder / "small_pack", chosen, config, workers=self.workers, licence=licence)
        print_summary(self.folder / "small_pack", records)
        tests = [source for source in [*sources, *industrial_sources()] if source.name in SMALL_TEST_SET]
        folder = self.folder / "small_test_set"
        print(folder, build_test_set(folder, tests, replace(CONFIG, drops=4, copies=(3, 18)), workers=self.workers))


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
        if not len(deepest):
            return
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
        tyro.extras.subcommand_cli_from_dict(
            {
                "electronics": Electronics,
                "surfels": AllSurfels,
                "test-sets": TestSets,
                "validation-bins": ValidationBins,
                "worlds": Worlds,
                "cad-folder": CadFolder,
                "per-object": PerObject,
                "check": Check,
                "small": Small,
            }
        ).run()
    except InputError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
