"""Recall and time of our poses and of every rival's on the same crops: `python -m experiments.evaluate NAME`.

NAME is one of `experiments.evaluation.configs`; each of its fields can be given, too. Poses are exported once to
outputs/evaluation/NAME and scored from there: a stopped run goes on where it was, and a run of another recipe is
refused. The report, Markdown and a page of HTML that needs no other file, is written beside them.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro

from experiments.evaluation.cases import Method, ObjectImages, limited
from experiments.evaluation.configs import CONFIGS, CROPS_AGAIN, OWN_NETWORKS, EvaluateConfig, find_config
from experiments.evaluation.methods import ONE_RANSAC, Ours, OwnNetworks
from experiments.evaluation.predictions import Export, check_files, export
from experiments.evaluation.refinement import SETTINGS
from experiments.evaluation.report import Result, draw_pictures, write_report
from experiments.evaluation.rivals import OverMatches
from experiments.evaluation.scores import cells_of
from experiments.evaluation.sources import Report, bop_objects, cloud_objects
from experiments.evaluation.tuned import RIVALS, without_package
from experiments.evaluation.versions import shared_versions, versions_of
from experiments.made_data import require_made
from experiments.test_sets import SPLIT, build_test_set
from kmn_jax.bop import NAMES_FILE, dataset_digest
from kmn_jax.data import Source
from kmn_jax.errors import InputError
from kmn_jax.files import write_whole
from kmn_jax.io import MESH_SUFFIXES, read_file
from kmn_jax.models import Model, load_model, released_file
from kmn_jax.objects import model_digest
from kmn_jax.pose import RansacConfig
from kmn_jax.report import environment, processor

_CAD_RECORD = ".cad.json"  # of which files bins were made; hidden, so that digests pass over it
_TOGETHER = 8  # methods that are run on a crop before the next crop
# Fields that the rest of the recipe tells, or that decide nothing.
_ELSEWHERE = ("name", "methods", "weights", "cad", "cad_names")


@dataclass(frozen=True)
class Options:
    """How it is carried out; every field of the config can be given too."""

    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")]
    output: Path | None = None  # folder; one of outputs/ that is called by NAME unless given
    networks: Path | None = None  # of the method per_object: a folder with OBJECT.safetensors for each object
    overwrite: bool = False  # delete predictions of another recipe that are there


def evaluate(options: Options) -> Path:
    """Evaluate and return the path of the report's page."""
    model = released_or_own(options.config.weights)
    methods, skipped = _methods(options.config, model, options.networks)
    return compare(options, model, methods, skipped)


def released_or_own(weights: str) -> Model:
    """Load a released network by its name, or one's own by its file."""
    path = Path(weights)
    return load_model(path if path.suffix == ".safetensors" else released_file(weights))


def compare(options: Options, model: Model, methods: Mapping[str, Method], skipped: Mapping[str, str]) -> Path:
    """Run methods, score and report them; return the path of the report's page."""
    config = options.config
    folder = options.output or Path("outputs") / "evaluation" / config.name
    if config.folder is not None and folder.resolve().is_relative_to(config.folder.resolve()):
        raise InputError(f"{folder} is inside of {config.folder}, which is evaluated: choose another --output")
    problems: list[str] = []
    objects = _objects(config, partial(_note, problems))
    for method in methods.values():
        if isinstance(method, OwnNetworks):
            method.check([found.name for found in objects])
    exported = Export.open(folder, recipe_of(config, methods), options.overwrite)
    keys = list(methods)
    for first in range(0, len(keys), _TOGETHER):
        if first > 0:
            jax.clear_caches()  # what many compile takes all memory maps that Linux allows a process
        some = {key: methods[key] for key in keys[first : first + _TOGETHER]}
        export(objects, some, config.noise, config.crops, config.random_seed, exported)
    for found, noise in ((found, noise) for found in objects for noise in config.noise):
        for problem in exported.truth(found.name, noise).problems:
            _note(problems, problem)
    objects = [found for found in objects if any(exported.truth(found.name, noise).names for noise in config.noise)]
    if not objects:
        raise InputError(f"{config.folder} gave no crop that can be evaluated: {'; '.join(problems)}")
    titles = {key: method.name for key, method in methods.items()}
    cells = cells_of(exported, {found.name: found.model for found in objects}, titles, config.noise)
    used = {**exported.recipe, "methods": {key: exported.recipe["methods"][key] for key in methods}}
    units = [(key, found.name, noise) for key in methods for found in objects for noise in config.noise]
    commits = sorted({exported.made_at(*unit) for unit in units})
    result = Result(
        config, environment(), model_digest(model), used, cells, skipped, tuple(problems), methods, tuple(commits)
    )
    return write_report(folder, result, draw_pictures(result, objects, exported))


def recipe_of(config: EvaluateConfig, methods: Mapping[str, Method]) -> dict[str, Any]:
    """Return all that decides poses: what decides those of one method alone is under its key in "methods"."""
    return {
        "config": {key: value for key, value in asdict(config).items() if key not in _ELSEWHERE},
        "data": _data_digest(config),
        "versions": shared_versions(),
        "methods": {key: {**method.settings, "versions": versions_of(method)} for key, method in methods.items()},
        "refinement": {key: str(value) for key, value in SETTINGS.items()},
        "processor": processor(),
    }


def _methods(config: EvaluateConfig, model: Model, networks: Path | None) -> tuple[dict[str, Method], dict[str, str]]:
    """Return the methods that can run, and why others cannot."""
    unchecked = replace(ONE_RANSAC, ransac=RansacConfig(use_normals=False))
    makers: dict[str, Callable[[], Method]] = {
        "ours": lambda: Ours("kmn_jax", model),
        "ours_ransac": lambda: Ours("kmn_jax, one RANSAC", model, ONE_RANSAC),
        CROPS_AGAIN: lambda: Ours("kmn_jax, one RANSAC, crops again", model, ONE_RANSAC, crops_again=True),
        "ours_no_normals": lambda: Ours("kmn_jax, one RANSAC, no normal check", model, unchecked),
        "ours_open3d": lambda: Ours("kmn_jax, Open3D RANSAC", model, ONE_RANSAC, search=OverMatches()),
        OWN_NETWORKS: lambda: OwnNetworks("kmn_jax, trained for the object", _own_networks(networks)),
        **{name: make for name, (_, make) in RIVALS.items()},
    }
    skipped = without_package(config.methods)
    for name, reason in skipped.items():
        print(f"skipped {name}: {reason}", file=sys.stderr)
    methods = {name: makers[name]() for name in config.methods if name not in skipped}
    if not methods:
        raise InputError(f"none of the methods can run: {'; '.join(skipped.values())}")
    return methods, skipped


def _own_networks(folder: Path | None) -> dict[str, Model]:
    """Load networks of one object each by the names of their files."""
    if folder is None:
        raise InputError(f"the method {OWN_NETWORKS} needs networks: give a folder of them with --networks")
    paths = sorted(folder.glob("*.safetensors"))
    if not paths:
        raise InputError(f"{folder} holds no network (OBJECT.safetensors)")
    return {path.stem: load_model(path) for path in paths}


def _note(problems: list[str], problem: str) -> None:
    """Tell what is left out, once."""
    if problem not in problems:
        problems.append(problem)
        print(f"left out: {problem}", file=sys.stderr)


def _objects(config: EvaluateConfig, report: Report) -> list[ObjectImages]:
    if config.folder is None:
        raise InputError(f"{config.name} needs a folder: give it with --folder")
    if config.source == "clouds":
        place, images = config.sensor_place, config.images
        found = cloud_objects(config.folder, config.object, config.camera, config.units, place, images)
    else:
        if config.cad is not None:
            _make_bins(config.folder, config.cad, config.cad_names)
        elif config.cad_names and not (config.folder / "camera.json").exists():  # which is written last
            raise InputError(
                f"{config.folder} holds no bins, or not all: give the folder of their CAD files with --cad"
            )
        found = bop_objects(config.folder, config.split, report, config.images)
    found = limited(found, config.objects)
    check_files([one.name for one in found], NAMES_FILE)
    return found


def _make_bins(folder: Path, cad: Path, names: tuple[str, ...]) -> None:
    """Make bins of the CAD files of a folder, as those of the test sets, but for those that are there already.

    Raises InputError if those that are there are not known to be of the same files.
    """
    paths = sorted(path for path in cad.glob("*") if path.suffix.lower() in MESH_SUFFIXES)
    chosen = [path for path in paths if not names or any(name in path.stem for name in names)]
    absent = [name for name in names if not any(name in path.stem for path in paths)]
    if absent or not chosen:
        raise InputError(f"{cad} holds no CAD file{f' named like {absent[0]}' if absent else ''}")
    check_files([path.stem for path in chosen], str(cad))
    digests = [[path.stem, hashlib.sha256(read_file(path)).hexdigest()] for path in chosen]
    record = folder / _CAD_RECORD
    try:
        folder.mkdir(parents=True, exist_ok=True)
        known = json.loads(record.read_text(encoding="utf-8")) if record.exists() else None
    except (OSError, ValueError) as error:
        raise InputError(f"{record} cannot be used ({error}): choose another --folder, or delete it") from None
    if known != digests and (folder / SPLIT).exists():
        raise InputError(
            f"{folder} holds bins of other CAD files than those in {cad}, or does not say of which:"
            " choose another --folder, or delete it"
        )
    write_whole(record, (json.dumps(digests, indent=1) + "\n").encode())
    build_test_set(folder, [Source(path.stem, "test", path) for path in chosen])


def _data_digest(config: EvaluateConfig) -> str:
    """Return a digest of all that is read: a BOP dataset, or the files beside the clouds."""
    assert config.folder is not None
    files = ((config.object, "a CAD file"), (config.camera, "a camera file"))
    extra = b"".join(read_file(path, what) for path, what in files if path is not None)
    return hashlib.sha256(dataset_digest(config.folder).encode() + extra).hexdigest()


def main(arguments: list[str] | None = None) -> int:
    """Evaluate: 0 is success, 2 bad input, in one sentence on stderr."""
    return run("evaluate", __doc__ or "", evaluate, arguments)


def run(command: str, text: str, function: Callable[[Options], Path], arguments: list[str] | None) -> int:
    """Run what reports on a named config: 0 is success, 2 bad input, in one sentence on stderr."""
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    try:
        if name.startswith("-"):
            print(f"{text}\nNames: {', '.join(CONFIGS)}. Fields: python -m experiments.{command} NAME --help")
            return 0 if name in ("-h", "--help") else 2
        default = Options(find_config(name))
        options = tyro.cli(Options, default=default, args=rest, prog=f"experiments.{command} {name}")
        if options.config.cad is None:  # else the bins are made of it now
            require_made(options.config.folder)
        page = function(options)
    except InputError as error:
        print(f"{command}: {error}", file=sys.stderr)
        return 2
    print(f"\nreport: {page}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
