"""Poses to fit probabilities to: what is found of parts in images whose truth is known, and what speaks for each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from threading import Lock
from typing import Any, cast
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Int

from experiments.fits import FitOptions, model_of, models_of_others, told
from experiments.fpfh import fpfh_poses
from experiments.reported_poses import CONFIG, with_reported
from experiments.searches import SEARCHED, Columns, Search, Sources, searches
from experiments.two_at_once import AT_ONCE, side_by_side
from kmn_jax.detection import (
    EVIDENCE,
    PICTURE_EVIDENCE,
    TREE_SETTINGS,
    VERIFIED,
    Calibration,
    Candidates,
    Clock,
    DevicePart,
    SearchConfig,
    chosen,
    explore,
    next_best_rows,
    picture_evidence,
    refined_candidates,
    search_at,
    seeds_over,
    verified,
)
from kmn_jax.errors import InputError, shown
from kmn_jax.files import make_folder, write_whole
from kmn_jax.models import Model
from kmn_jax.objects import model_digest

_LOOSE = replace(CONFIG, reported=0.03)  # refines more than that does, so that the fit sees what is just refused
_COLUMNS = (  # of what is stored
    "evidence",
    "error",
    "largest_error",
    "object",
    "search",
    "known",  # whether the network, or the verifier, was trained with such parts
    "narrowed",
    "T_camera_object",
    "refined",
    "turn",  # in which detection refines them; -1 as they are found, and if they are just not probable enough
    "due",  # whether detection, which is not always for later turns, comes to them, and chooses among them
    "reported",
)
_HOW = 10  # version of how is collected: it goes up with what is kept of a search, what is right, and how it is judged
_CHOSEN = 1  # version of how what is reported is chosen (`experiments.reported_poses`): stored searches stay
_IN_MEMORY = 600  # searches, of each of which what was found first, crops and all, takes 10 MB
_READING = Lock()  # NumPy parses the headers of arrays, which CPython 3.11 sometimes refuses two threads at once


def poses_to_fit(sources: Sources, fits: FitOptions, network: Model, stored: Path | None = None) -> Columns:
    """Return evidence, outcome, object and search of all poses, and whether they are refined, and what is judged.

    What is `stored` is not searched again; what is searched is written there, and before that search by search into a
    folder beside it, from which goes on what was ended, or wants more images. Where what depth images show is wanted
    anew, or other kinds of it, stored poses are judged anew, and stored with that: those that are refined stay the ones
    that were chosen by the evidence of before, and evidence that is not used any more is kept. Raises InputError if
    what is stored is of other bins, weights or settings, or lacks evidence that comes of crops.
    """
    names: tuple[str, ...] = EVIDENCE
    if stored is None or not stored.exists():
        poses = collect(sources, fits, network, stored and stored.with_name(f"{stored.name}.searches"))
    else:
        poses, names, used = read_poses(stored, sources, fits, network)
        lacking = sorted(set(EVIDENCE) - {*names, *PICTURE_EVIDENCE, VERIFIED})
        if lacking:
            raise InputError(
                f"{stored} lacks {', '.join(lacking)}, which comes of crops: remove it and {stored.name}.searches, to"
                " search again"
            )
        if used == EVIDENCE and not sources.judge_anew:
            return told(poses | {"evidence": poses["evidence"][:, [names.index(name) for name in EVIDENCE]]})
        unused = [column for column, name in enumerate(names) if name not in EVIDENCE]
        kept = poses["evidence"][:, unused]
        poses = judged_anew(poses, names, sources, fits, network)
        poses["evidence"] = np.concatenate([poses["evidence"], kept], axis=1)
        names = (*EVIDENCE, *(names[column] for column in unused))
    if stored is not None:
        made_of = _made_of(sources, fits, network)
        of = {"made_of": made_of, "names": names, "used": EVIDENCE}  # used: for what is reported
        write_columns(stored, poses | {key: np.array(value) for key, value in of.items()})
    return told(poses | {"evidence": poses["evidence"][:, : len(EVIDENCE)]})


def read_poses(
    stored: Path, sources: Sources, fits: FitOptions, network: Model
) -> tuple[Columns, tuple[str, ...], tuple[str, ...]]:
    """Return what is stored: poses, the names of their evidence, and those by which it was told what is reported.

    Raises InputError if it is of other bins, weights or settings.
    """
    if not stored.is_file():
        raise InputError(f"{stored} does not exist: python -m experiments.calibrate --candidates makes it")
    poses = read_columns(stored)
    if str(poses.pop("made_of", "")) != _made_of(sources, fits, network) or set(poses) != {*_COLUMNS, "names", "used"}:
        raise InputError(f"{stored} holds poses of other bins, weights or settings: remove it")
    names, used = (tuple(poses.pop(key).tolist()) for key in ("names", "used"))
    return poses, names, used


def read_columns(path: Path) -> Columns:
    """Read what `write_columns` wrote. Raises InputError if that is damaged."""
    try:
        with _READING, np.load(path) as file:
            return dict(file)
    except (OSError, EOFError, ValueError, TypeError, BadZipFile) as error:
        raise InputError(f"{path} holds no poses ({shown(error)}): remove it") from None


def write_columns(path: Path, columns: Columns) -> None:
    """Write columns of poses to a file that appears whole."""
    written = BytesIO()
    np.savez(written, **cast(dict[str, Any], columns))
    write_whole(path, written.getvalue())


def collect(sources: Sources, fits: FitOptions, network: Model, folder: Path | None = None) -> Columns:
    """Search and refine, and keep what each search found in a folder, if one is given.

    First around the seeds that detection begins with, which the model of poses as they are found is fitted to. Then,
    by such models that do not know the image's object, as detection does, round after round: where little is found most
    is wrong. Of parts that the network knows what is found first is all: the verifier learns from it, so that what it
    says there would tell nothing. Images are read twice, as they do not all fit into memory. What is in the folder
    stays as it is, chosen by the models of when it was refined: of images that were built anew make another one. Raises
    InputError if the folder is of other weights or settings.
    """
    config = CONFIG.search_of(network.config)
    first: dict[int, Candidates] = {}
    kept = _Kept(folder, repr((_HOW, SEARCHED, sources.method, *_settings(fits, network), EVIDENCE)))
    at_once = 1 if sources.method == "FPFH" else AT_ONCE  # whose random numbers are those of the whole process

    def propose(search: Search) -> Callable[[Int[np.ndarray, " c"]], Candidates]:
        return _propose(search, network, config, sources.method)

    def found_first(search: Search) -> Columns:
        found = propose(search)(_first_seeds(search))
        if not search.is_known and len(first) < _IN_MEMORY:
            first[search.row] = found
        return search.columns(found)

    found_parts = side_by_side(partial(kept.made, "found", found_first), searches(sources, network), at_once)
    poses = _joined(found_parts)
    none = np.zeros(len(poses["error"]), dtype=bool)
    poses |= {"refined": none, "turn": np.full(len(none), -1), "reported": none}
    others, of_all = models_of_others(poses, fits), model_of(poses, fits)
    searched: dict[int, DevicePart] = {}

    def refined(search: Search) -> Columns:
        found = first.pop(search.row, None) or propose(search)(_first_seeds(search))
        chooser = others.get(search.number, of_all)  # of an object without poses no model knows anything
        found = _explored(search, _going_on(found, propose(search)), chooser)
        rows, turns = _turns(found, chooser, search.on_device)
        if not len(rows):
            return search.columns(found._replace(usable=np.zeros_like(found.usable))) | {"turn": turns}
        fine = refined_candidates(search.on_device, search.scene, found, rows, 0, config)
        return search.columns(fine) | {"turn": np.tile(turns, len(fine.usable) // len(rows))[fine.usable]}

    def refined_part(search: Search) -> Columns:
        found = kept.made("refined", refined, search)
        if found and (found["turn"] >= 0).any():
            searched[search.row] = search.on_device
        return found

    unknown = replace(sources, known_worlds=())  # whose searches come last: the others stay in their rows
    more = _joined(side_by_side(refined_part, searches(unknown, network), at_once))
    none = np.zeros(len(more["error"]), dtype=bool)
    return with_reported(_joined([poses, more | {"refined": ~none, "reported": none}]), searched, fits)


class _Kept:
    """What searches found, in a folder or nowhere."""

    def __init__(self, folder: Path | None, made_of: str) -> None:
        self._folder = folder
        if folder is None:
            return
        told = folder / "made_of.txt"
        if not folder.exists():
            make_folder(folder)
            write_whole(told, made_of.encode())
        if not told.is_file() or told.read_text(encoding="utf-8") != made_of:
            raise InputError(f"{folder} holds searches by other weights or settings, or other evidence: remove it")

    def made(self, stage: str, make: Callable[[Search], Columns], search: Search) -> Columns:
        """Return what a stage makes of a search, or made of it before; nothing of one that is empty."""
        path = self._folder and self._folder / f"{search.name}-{stage}.npz"
        if path and path.exists():
            columns = read_columns(path)
        elif search.is_empty:
            return {}
        else:
            columns = make(search)
            if path:
                write_columns(path, columns)
        # Row and number may be others today.
        of_search = {"search": search.row, "object": search.number, "known": search.is_known}
        return columns | {name: np.full(len(columns["error"]), value) for name, value in of_search.items()}


def _turns(
    found: Candidates, chooser: Calibration, on_device: DevicePart
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Return the rows of candidates to refine, and the turn in which detection would, if no place had a sure pose.

    Those that are just not probable enough for detection, of which there is one turn, are -1.
    """
    loose, first = (chosen(found, chooser, on_device, config) for config in (_LOOSE, CONFIG))
    rows = [np.flatnonzero(first.kept | first.contenders)]
    all_unsure = found.T_camera_object[rows[0]], found.T_camera_object[:0]
    while len(rows[-1]) > 0 and len(rows) <= CONFIG.next_best:
        rows.append(next_best_rows(found, np.concatenate(rows), *all_unsure, chooser, on_device, CONFIG))
    others = loose.kept | loose.contenders
    others[np.concatenate(rows)] = False
    rows.append(np.flatnonzero(others))
    turns = [*range(len(rows) - 1), -1]
    return np.concatenate(rows), np.repeat(turns, [len(some) for some in rows])


def judged_anew(poses: Columns, names: tuple[str, ...], sources: Sources, fits: FitOptions, network: Model) -> Columns:
    """Return poses with the evidence of today: what they have, by `names`, and what they lack of depth images computed.

    All of that is computed where it is wanted anew. Raises InputError if the images are not those that the poses were
    found in.
    """
    evidence = np.zeros((len(poses["evidence"]), len(EVIDENCE)), dtype=np.float32)
    of_images = {*PICTURE_EVIDENCE, VERIFIED}
    made = of_images if sources.judge_anew else of_images - set(names)
    for column, name in enumerate(EVIDENCE):
        if name not in made:
            evidence[:, column] = poses["evidence"][:, names.index(name)]
    config = CONFIG.search_of(network.config)
    searched: dict[int, DevicePart] = {}
    all_of_picture = not made.isdisjoint(PICTURE_EVIDENCE)
    of_picture = np.array([EVIDENCE.index(name) for name in PICTURE_EVIDENCE])

    def judge(item: tuple[Search, Int[np.ndarray, " k"]]) -> None:
        search, rows = item
        rows, given = judged[rows], (search.on_device, search.scene)
        searched[search.row] = search.on_device
        if all_of_picture:
            seen = picture_evidence(poses["T_camera_object"][rows], *given, config.agreement)
            evidence[np.ix_(rows, of_picture)] = seen
        refined = rows[poses["refined"][rows]]
        if VERIFIED in made:
            evidence[refined, EVIDENCE.index(VERIFIED)] = verified(poses["T_camera_object"][refined], *given)

    # Verifiers say something of refined poses alone, of which there are none of known parts.
    judged = np.flatnonzero(all_of_picture | poses["refined"])
    sources = sources if all_of_picture else replace(sources, known_worlds=())
    side_by_side(judge, searches_of({name: values[judged] for name, values in poses.items()}, sources, network))
    return with_reported(poses | {"evidence": evidence}, searched, fits)


def searches_of(poses: Columns, sources: Sources, network: Model) -> Iterator[tuple[Search, Int[np.ndarray, " k"]]]:
    """Yield the searches that stored poses were found in, with the rows of these.

    Raises InputError if the images are not those that the poses were found in.
    """
    left = set(poses["search"].tolist())
    for search in searches(sources, network):
        rows = np.flatnonzero(poses["search"] == search.row)
        if len(rows):
            left.remove(search.row)
            _check(bool((poses["object"][rows] == search.number).all()))
            error = search.errors(poses["T_camera_object"][rows[:1]], search.image.errors)
            _check(np.allclose(error, poses["error"][rows[:1]], atol=1e-4, equal_nan=True))
            yield search, rows
    _check(not left)


def _check(is_same: bool) -> None:
    if not is_same:
        raise InputError("the bins are not those that the stored poses were found in: remove the file")


def _joined(columns: list[Columns]) -> Columns:
    columns = [part for part in columns if part]
    if not columns:
        raise InputError("nothing of the bins can be searched: make them anew by python -m experiments.build_data")
    return {name: np.concatenate([part[name] for part in columns]) for name in columns[0]}


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
    return explore(search.scene, search.part, propose, chooser, CONFIG, Clock())[0]


def _made_of(sources: Sources, fits: FitOptions, network: Model) -> str:
    """Say what candidates are made of."""
    folders = str(sources.bins), *(tuple(map(str, worlds)) for worlds in (sources.worlds, sources.known_worlds))
    chosen_by = _CHOSEN, fits.in_vain
    return repr((_HOW, *chosen_by, SEARCHED, sources.method, folders, sources.every, *_settings(fits, network)))


def _settings(fits: FitOptions, network: Model) -> tuple[Any, ...]:
    decisive = fits.folds, fits.members, fits.absent_weight, TREE_SETTINGS  # for what is refined and reported
    return decisive, model_digest(network), CONFIG, CONFIG.search_of(network.config), _LOOSE
