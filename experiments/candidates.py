"""Poses to fit probabilities to: what is found of parts in images whose truth is known, and what speaks for each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast
from zipfile import BadZipFile

import jax
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from tqdm import tqdm

from experiments.bins import TrueImage, WorldImage, bin_images, world_images
from experiments.fits import FitOptions, by_largest_error, held_out_models, model_of, told
from experiments.fpfh import fpfh_poses
from experiments.test_sets import SPLIT
from kmn_jax.detection import (
    EVIDENCE,
    PICTURE_EVIDENCE,
    TREE_SETTINGS,
    Calibration,
    Candidates,
    Clock,
    DetectConfig,
    DevicePart,
    Scene,
    SearchConfig,
    chosen,
    device_part,
    explore,
    make_scene,
    picture_evidence,
    refined_candidates,
    search_at,
    seeds_over,
)
from kmn_jax.errors import InputError, shown
from kmn_jax.files import write_whole
from kmn_jax.io import Scan
from kmn_jax.models import Model
from kmn_jax.objects import Part, model_digest

_LOOSE = DetectConfig(reported=0.03)  # refines more than detection does, so that the fit sees what is just refused
_COLUMNS = (  # of what is stored
    "evidence",
    "error",
    "largest_error",
    "object",
    "search",
    "narrowed",
    "T_camera_object",
    "refined",
    "due",  # whether they are of what detection chooses among, which refines less; of parts that are not known
    "reported",
)
_MARGINS = (0.1, 0.4)  # diameters: so much of what is around copies is left in scans that are cut out
_HOW = 4  # version of how is collected: it goes up with what is searched, of what and from where, and what is right
_KINDS = 100  # more than the families of parts in a folder of world bins


@dataclass(frozen=True)
class Sources:
    """How and in which images is searched."""

    method: Literal["kmn_jax", "FPFH"] = "kmn_jax"
    bins: Path = Path("outputs/validation_bins")  # folder with datasets in BOP format
    worlds: Path | None = None  # folder of world bins to fit on, too: outputs/worlds/validation
    known_worlds: Path | None = None  # the same, of parts that the network was trained with: no scale is fitted to it
    every: int = 1  # use every so many images of `bins`
    judge_anew: bool = False  # compute what depth images show of stored poses again, as after a change of that code


class Search(NamedTuple):
    """One image and the part that is searched in it."""

    image: TrueImage
    part: Part  # the image's own, or a stranger
    on_device: DevicePart
    scene: Scene
    row: int  # of all searches
    number: int  # that searches of one object, or of one family of parts, share
    is_known: bool  # whether the network was trained with such parts

    def columns(self, found: Candidates) -> dict[str, np.ndarray]:
        """Return evidence, errors and object of poses."""
        poses = found.T_camera_object[found.usable]
        error = self.errors(poses, self.image.errors)
        is_own = self.part is self.image.part
        return {
            "evidence": found.evidence[found.usable],
            "error": error,
            "largest_error": self.errors(poses, self.image.largest_errors) if is_own else error,
            "object": np.full(len(poses), self.number),
            "search": np.full(len(poses), self.row),
            "narrowed": np.full(len(poses), self.scene.is_narrowed),
            "T_camera_object": poses,  # to judge it by other evidence
        }

    def errors(
        self, T_camera_object: Float32[np.ndarray, "s 4 4"], measure: Callable[[np.ndarray], np.ndarray]
    ) -> Float[np.ndarray, " s"]:
        """Return by how much poses are off the nearest copy: of a part that is not there infinitely.

        It is NaN where such a part hardly differs from the copy that it is found at: neither right nor wrong.
        """
        poses = self.scene.T_scene_camera @ T_camera_object
        if self.part is not self.image.part:
            return np.where(self.image.looks_like(self.part, poses), np.nan, np.inf)
        return measure(poses).min(axis=1, initial=np.inf)


def poses_to_fit(
    sources: Sources, fits: FitOptions, network: Model, stored: Path | None = None
) -> dict[str, np.ndarray]:
    """Return evidence, outcome, object and search of all poses, and whether they are refined, and what is judged.

    What is `stored` is not searched again; what is searched is written there. Where what depth images show is wanted
    anew, or other kinds of it, stored poses are judged anew, and stored with that: those that are refined stay the ones
    that were chosen by the evidence of before, and evidence that is not used any more is kept. Raises InputError if
    what is stored is of other bins, weights or settings, or lacks evidence that comes of crops.
    """
    made_of = _made_of(sources, fits, network)
    names: tuple[str, ...] = EVIDENCE
    if stored is None or not stored.exists():
        poses = collect(sources, fits, network)
    else:
        poses = _read(stored, made_of)
        names, used = (tuple(poses.pop(key).tolist()) for key in ("names", "used"))
        lacking = sorted(set(EVIDENCE) - {*names, *PICTURE_EVIDENCE})
        if lacking:
            raise InputError(f"{stored} lacks {', '.join(lacking)}, which comes of crops: remove it, to search again")
        if used == EVIDENCE and not sources.judge_anew:
            return told(poses | {"evidence": poses["evidence"][:, [names.index(name) for name in EVIDENCE]]})
        unused = [column for column, name in enumerate(names) if name not in EVIDENCE]
        kept = poses["evidence"][:, unused]
        poses = judged_anew(poses, names, sources, fits, network)
        poses["evidence"] = np.concatenate([poses["evidence"], kept], axis=1)
        names = (*EVIDENCE, *(names[column] for column in unused))
    if stored is not None:
        written, of = BytesIO(), {"made_of": made_of, "names": names, "used": EVIDENCE}  # used: for what is reported
        np.savez(written, **cast(dict[str, Any], poses | {key: np.array(value) for key, value in of.items()}))
        write_whole(stored, written.getvalue())
    return told(poses | {"evidence": poses["evidence"][:, : len(EVIDENCE)]})


def _read(stored: Path, made_of: str) -> dict[str, np.ndarray]:
    """Return what is stored. Raises InputError if it is something else."""
    try:
        with np.load(stored) as file:
            poses = dict(file)
    except (OSError, EOFError, ValueError, TypeError, BadZipFile) as error:
        raise InputError(f"{stored} holds no poses ({shown(error)}): remove it") from None
    if str(poses.pop("made_of", "")) != made_of or set(poses) != {*_COLUMNS, "names", "used"}:
        raise InputError(f"{stored} holds poses of other bins, weights or settings: remove it")
    return poses


def collect(sources: Sources, fits: FitOptions, network: Model) -> dict[str, np.ndarray]:
    """Search and refine.

    First around the seeds that detection begins with, which the model of poses as they are found is fitted to. Then,
    by such models that do not know the image's object, as detection does, round after round: where little is found most
    is wrong. Of parts that the network knows, no scale is fitted to which, only what was found first is refined. Images
    are read twice, as they do not all fit into memory; what was found first does.
    """
    config = DetectConfig().search_of(network.config)
    first: dict[int, Candidates] = {}
    parts = []
    for search in _searches(sources, network):
        found = _propose(search, network, config, sources.method)(_first_seeds(search))
        parts.append(search.columns(found))
        first[search.row] = _with_poses(found) if search.is_known else found  # which is gone on from, crops and all
    poses = _joined(parts)
    none = np.zeros(len(poses["error"]), dtype=bool)
    poses |= {"refined": none, "due": none, "reported": none}
    others, of_all = _models(poses, fits), model_of(poses, fits)
    parts, searched = [], {}
    for search in _searches(sources, network):
        found, chooser = first.pop(search.row), of_all
        if not search.is_known:
            chooser = others.get(search.number, of_all)  # of an object without poses no model knows anything
            found = _explored(search, _going_on(found, _propose(search, network, config, sources.method)), chooser)
        choice = chosen(found, chooser, search.on_device, _LOOSE)
        rows = np.flatnonzero(choice.kept | choice.contenders)
        if len(rows):
            searched[search.row] = search.on_device
            fine = refined_candidates(search.on_device, search.scene, found, rows, 0, config)
            none = np.zeros(np.count_nonzero(fine.usable), dtype=bool)
            due = none if search.is_known else _due(found, chooser, search.on_device, rows, fine)
            parts.append(search.columns(fine) | {"due": due})
    more = _joined(parts)
    none = np.zeros(len(more["error"]), dtype=bool)
    return _with_reported(_joined([poses, more | {"refined": ~none, "reported": none}]), searched, fits)


def _due(
    found: Candidates, chooser: Calibration, on_device: DevicePart, rows: Int[np.ndarray, " k"], fine: Candidates
) -> Bool[np.ndarray, " s"]:
    """Return of the poses that some candidates, in `rows`, became whether detection refines these candidates."""
    choice = chosen(found, chooser, on_device, DetectConfig())
    due = (choice.kept | choice.contenders)[rows]
    return np.tile(due, len(fine.usable) // len(rows))[fine.usable]


def judged_anew(
    poses: dict[str, np.ndarray], names: tuple[str, ...], sources: Sources, fits: FitOptions, network: Model
) -> dict[str, np.ndarray]:
    """Return poses with the evidence of today: what comes of crops is what they have, by `names`, the rest computed.

    Raises InputError if the images are not those that the poses were found in.
    """
    evidence = np.zeros((len(poses["evidence"]), len(EVIDENCE)), dtype=np.float32)
    for column, name in enumerate(EVIDENCE):
        if name not in PICTURE_EVIDENCE:
            evidence[:, column] = poses["evidence"][:, names.index(name)]
    of_picture = np.array([EVIDENCE.index(name) for name in PICTURE_EVIDENCE])
    config, searched = DetectConfig().search_of(network.config), {}
    for search in _searches(sources, network):
        rows = np.flatnonzero(poses["search"] == search.row)
        if len(rows):
            searched[search.row] = search.on_device
            found = poses["T_camera_object"][rows]
            _check(bool((poses["object"][rows] == search.number).all()))
            error = search.errors(found[:1], search.image.errors)
            _check(np.allclose(error, poses["error"][rows[:1]], atol=1e-4, equal_nan=True))
            seen = picture_evidence(found, search.on_device, search.scene, config.agreement)
            evidence[np.ix_(rows, of_picture)] = seen
    _check(set(poses["search"].tolist()) == set(searched))
    return _with_reported(poses | {"evidence": evidence}, searched, fits)


def _check(is_same: bool) -> None:
    if not is_same:
        raise InputError("the bins are not those that the stored poses were found in: remove the file")


def _with_reported(
    poses: dict[str, np.ndarray], searched: dict[int, DevicePart], fits: FitOptions
) -> dict[str, np.ndarray]:
    """Return poses with what detection reports of each search, by models that do not know the image's object."""
    fine = {name: values[poses["refined"]] for name, values in poses.items()}
    others, exact = (_models(rows, fits) for rows in (fine, by_largest_error(fine)))
    reported = np.zeros(len(poses["error"]), dtype=bool)
    for row, on_device in searched.items():
        rows = np.flatnonzero((poses["search"] == row) & poses["due"])
        if len(rows):
            number = int(poses["object"][rows[0]])
            found = _choosable(poses["T_camera_object"][rows], poses["evidence"][rows])
            reported[rows] = chosen(found, others[number], on_device, DetectConfig(), exact[number]).kept
    return poses | {"reported": reported}


def _models(poses: dict[str, np.ndarray], fits: FitOptions) -> dict[int, Calibration]:
    """Return for each object the model that is fitted to the poses of others."""
    return {int(name): fitted for names, fitted in held_out_models(poses, fits) for name in names}


def _choosable(poses: Float32[np.ndarray, "s 4 4"], evidence: Float32[np.ndarray, "s f"]) -> Candidates:
    """Return candidates that can be chosen among, and nothing else."""
    none = np.zeros(len(poses), dtype=np.int32)
    return Candidates(poses, np.ones(len(poses), dtype=bool), evidence, none, none, cast(Any, None), none)


def _joined(columns: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([part[name] for part in columns]) for name in columns[0]}


def _searches(sources: Sources, network: Model) -> Iterator[Search]:
    """Yield all images with their parts, and with one that is known not to be there, if any is.

    What is searched in vain is the part that is nearest in size, and the next one, by turns.
    """
    searches = count()
    for row, (number, image, scene, is_known) in enumerate(_images(sources, network)):
        for part in (image.part, *image.strangers[row % 2 :][:1]):
            yield Search(image, part, device_part(network, part), scene, next(searches), number, is_known)


def _images(sources: Sources, network: Model) -> Iterator[tuple[int, TrueImage, Scene, bool]]:
    """Yield all images with their scenes.

    Also yield a number that those of one object share, or of one family of parts, and whether the network knows it.
    """
    folders = sorted(path for path in sources.bins.glob("*") if (path / SPLIT).is_dir())
    if not folders:
        raise InputError(f"{sources.bins} holds no datasets: python -m experiments.build_data validation-bins")
    for number, folder in enumerate(folders, start=1):
        for image in tqdm(bin_images(folder, SPLIT, network, sources.every), unit="image", desc=folder.name):
            yield 1000 * number + image.key.scene_id, image, image.scene, False
    for number, world in enumerate((sources.worlds, sources.known_worlds)):
        if world is None:
            continue
        is_known = number == 1
        for row, found in enumerate(tqdm(world_images(world, network), unit="image", desc=f"worlds {world.name}")):
            with suppress(InputError):  # a scan without foreground, as of an empty table
                scene = make_scene(as_given(found, row) if is_known else found.scan, found.part.diameter)
                yield _KINDS * number + found.kind, found, scene, is_known


def as_given(image: WorldImage, row: int) -> Scan:
    """Return a scan as users may have it: as a depth image, as a cloud, or, if there are any, cut out around copies."""
    if row % 3 == 0:
        return image.scan
    cut = None
    if row % 3 == 2:
        cut = image.cloud(np.random.default_rng(row).uniform(*_MARGINS))
    return cut if cut is not None and len(cut.points) else image.cloud()


def _first_seeds(search: Search) -> Int[np.ndarray, " c"]:
    return seeds_over(search.scene, search.scene.foreground, search.part)


def _propose(
    search: Search, network: Model, config: SearchConfig, method: str
) -> Callable[[Int[np.ndarray, " c"]], Candidates]:
    """Return what finds the poses in crops around seeds."""
    if method == "FPFH":
        return partial(fpfh_poses, search.part, search.on_device, search.scene)
    return lambda rows: search_at(network, search.on_device, search.scene, rows, 0, config)


def _going_on(
    first: Candidates, propose: Callable[[Int[np.ndarray, " c"]], Candidates]
) -> Callable[[Int[np.ndarray, " c"]], Candidates]:
    """Return what finds the poses in crops around seeds, but for those around which they were found before."""
    return lambda rows: first if np.array_equal(rows, first.seed_rows) else propose(rows)


def _explored(
    search: Search, propose: Callable[[Int[np.ndarray, " c"]], Candidates], chooser: Calibration
) -> Candidates:
    """Return the poses that detection finds in all of its rounds."""
    return explore(search.scene, search.part, propose, chooser, DetectConfig(), Clock())[0]


def _with_poses(found: Candidates) -> Candidates:
    """Return the candidates of those crops that have any, or of the first: what the network says of crops is large."""
    crops = np.unique(found.crop[found.usable]) if found.usable.any() else np.arange(1)
    rows = np.isin(found.crop, crops)
    return Candidates(
        found.T_camera_object[rows],
        found.usable[rows],
        found.evidence[rows],
        found.num_inliers[rows],
        np.searchsorted(crops, found.crop[rows]),
        jax.tree.map(lambda leaf: np.asarray(leaf)[crops], found.found),
        found.seed_rows[crops],
    )


def _made_of(sources: Sources, fits: FitOptions, network: Model) -> str:
    """Say what candidates are made of."""
    folders = [str(folder) for folder in (sources.bins, sources.worlds, sources.known_worlds)]
    settings = DetectConfig(), DetectConfig().search_of(network.config), _LOOSE, _MARGINS
    decisive = fits.folds, fits.members, fits.absent_weight, TREE_SETTINGS  # for what is reported
    return repr((_HOW, sources.method, folders, sources.every, decisive, model_digest(network), settings))
