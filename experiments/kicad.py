"""KiCad's component models: which ones the catalogue names, and where to get them."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import tempfile
from pathlib import Path

from kmn_jax.data import SPLITS, Source
from kmn_jax.errors import InputError
from kmn_jax.files import make_folder

CATALOGUE = Path(__file__).parent / "assets" / "electronics.json"
PACKAGE = "kicad-packages3d"
_IN_PACKAGE = "./usr/share/kicad/3dmodels/"


def catalogue_sources(models: Path | None, cache: Path, limit: int | None) -> tuple[list[Source], str]:
    """Return the catalogue's objects with their files, and their licence.

    They are in an order that mixes splits and families, the same for everybody, so that a first part stands for all.

    Without a folder of `models` the Debian package is fetched once and what the catalogue names extracted to `cache`.
    Raises InputError if the package cannot be had.
    """
    catalogue = json.loads(CATALOGUE.read_text(encoding="utf-8"))
    if limit is not None and limit < 1:
        raise InputError(f"limit = {limit} must be 1 or more")
    places = [(hashlib.sha256(name.encode()).digest(), name, split) for split in SPLITS for name in catalogue[split]]
    chosen = sorted(places)[:limit]
    if models is None:
        models = cache
        _extract_missing([name for _, name, _ in places], cache)
    elif not models.is_dir():
        raise InputError(f"{models} is not a folder: name the one that holds KiCad's *.3dshapes folders")
    return [Source(name, split, models / f"{name}.step") for _, name, split in chosen], catalogue["licence"]


def _extract_missing(names: list[str], cache: Path) -> None:
    missing = [name for name in names if not (cache / f"{name}.step").exists()]
    if not missing:
        return
    if not (shutil.which("apt-get") and shutil.which("dpkg-deb")):
        raise InputError(
            f"this is not a Debian system, so {PACKAGE} cannot be fetched: get KiCad's 3D models (packages3D) and name"
            " their folder with --models"
        )
    make_folder(cache)
    with tempfile.TemporaryDirectory(dir=cache.absolute()) as scratch:
        print(f"downloading {PACKAGE} (380 MB)", flush=True)
        _run(["apt-get", "download", "-qq", PACKAGE], scratch, f"{PACKAGE} could not be downloaded")
        package = next(Path(scratch).glob(f"{PACKAGE}_*.deb"))
        print(f"extracting {len(missing)} models", flush=True)
        listing = Path(scratch) / "names"
        listing.write_text("".join(f"{_IN_PACKAGE}{name}.step\n" for name in missing), encoding="utf-8")
        models = Path(scratch) / "models"
        models.mkdir()
        depth = str(_IN_PACKAGE.count("/"))
        # tar may stop after the last file that is wanted; cat takes the rest, or dpkg-deb would report a broken pipe.
        script = 'dpkg-deb --fsys-tarfile "$1" | { tar -x -C "$2" --strip-components="$3" -T "$4"; cat > /dev/null; }'
        arguments = [str(package), str(models), depth, str(listing)]
        _run(["sh", "-c", script, "sh", *arguments], scratch, f"{package.name} could not be unpacked", check=False)
        for name in missing:
            source, target = models / f"{name}.step", cache / f"{name}.step"
            if not source.exists():
                raise InputError(f"{package.name} does not hold {name}.step: it is of another version than 6.0.10-1")
            target.parent.mkdir(parents=True, exist_ok=True)
            source.replace(target)


def _run(command: list[str], folder: str, failure: str, check: bool = True) -> None:
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if check and result.returncode != 0:
        lines = result.stderr.strip().splitlines() or ["no reason given"]
        raise InputError(f"{failure} ({lines[-1]}): name a folder of KiCad's 3D models with --models")
