"""Which cases are drawn: our best, median, worst and lost ones, and those that a rival solves and we do not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.evaluation.cases import Case, ObjectImages, draw_cases
from experiments.evaluation.configs import EvaluateConfig, noise_name
from experiments.evaluation.pictures import RivalPose, Shown
from experiments.evaluation.predictions import Export
from experiments.evaluation.scores import THRESHOLD, Cell

OURS = "ours"  # the method whose cases are drawn, if it ran
_BEATEN = 6  # cases, at most, that a rival solves and we do not
_OF_EACH = 2  # of these, of one rival, object and noise


@dataclass(frozen=True)
class _Pick:
    title: str
    place: int  # of the object
    noise: float
    row: int
    error: float
    rival: str | None = None  # its key
    rival_error: float = np.nan


def chosen_cases(
    config: EvaluateConfig,
    objects: Sequence[ObjectImages],
    exported: Export,
    cells: Sequence[Cell],
    titles: Mapping[str, str],
    rivals: Sequence[str],
) -> list[Shown]:
    """Return cases of our refined poses: the best, the median, the worst, lost ones, and those that rivals solve.

    `titles` are the names of the methods by their keys, `rivals` the keys of those that are not ours.
    """
    by_name = {(cell.method, cell.object, cell.noise): cell.errors for cell in cells}
    errors = {
        (key, place, noise): by_name[f"{titles[key]} + ICP", found.name, noise]
        for key in (OURS, *rivals)
        for place, found in enumerate(objects)
        for noise in config.noise
    }
    picks = [*_of_ours(config, len(objects), errors), *_of_rivals(errors, titles, rivals)]
    drawn = _drawn(config, objects, picks)
    return [
        _shown(pick, objects[pick.place], drawn[pick.place, pick.noise, pick.row], exported, titles) for pick in picks
    ]


_Errors = Mapping[tuple[str, int, float], np.ndarray]  # by method, object and noise: of each case


def _of_ours(config: EvaluateConfig, count: int, errors: _Errors) -> list[_Pick]:
    """Pick the best, the median and the worst case over all objects, at the least noise and at the most."""
    chosen = []
    for noise in dict.fromkeys((min(config.noise), max(config.noise))):
        ranked = sorted((e, place, row) for place in range(count) for row, e in enumerate(errors[OURS, place, noise]))
        if not ranked:
            continue
        near = [case for case in ranked if np.isfinite(case[0])] or ranked
        picks = {"best": ranked[0], "median": ranked[len(ranked) // 2], "worst": near[-1]}
        # Poses far from every copy, and none at all, are equally bad: one of each of three objects is shown.
        lost = list({place: (e, place, row) for e, place, row in reversed(ranked) if not np.isfinite(e)}.values())
        picks |= {f"lost {number + 1}": pick for number, pick in enumerate(lost[:3])}
        chosen += [_Pick(title, place, noise, row, float(error)) for title, (error, place, row) in picks.items()]
    return chosen


def _of_rivals(errors: _Errors, titles: Mapping[str, str], rivals: Sequence[str]) -> list[_Pick]:
    """Pick cases that a rival gets right and we do not, where it finds more than we do; the largest gap first."""
    found: list[tuple[float, list[_Pick]]] = []
    for (key, place, noise), theirs in errors.items():
        ours = errors[OURS, place, noise]
        gap = int((theirs < THRESHOLD).sum()) - int((ours < THRESHOLD).sum())
        if key not in rivals or gap <= 0:
            continue
        rows = np.flatnonzero((theirs < THRESHOLD) & ~(ours < THRESHOLD))
        rows = rows[np.argsort(theirs[rows], kind="stable")]
        title = f"{titles[key]} is right"
        own = [_Pick(title, place, noise, row, float(ours[row]), key, float(theirs[row])) for row in rows.tolist()]
        found.append((gap / len(ours), own))
    found.sort(key=lambda one: -one[0])
    chosen: list[_Pick] = []
    taken: set[tuple[int, float, int]] = set()
    for _ in range(_OF_EACH):
        for _, own in found:
            left = [pick for pick in own if (pick.place, pick.noise, pick.row) not in taken]
            if left and len(chosen) < _BEATEN:
                chosen.append(left[0])
                taken.add((left[0].place, left[0].noise, left[0].row))
    return chosen


def _drawn(
    config: EvaluateConfig, objects: Sequence[ObjectImages], picks: Sequence[_Pick]
) -> dict[tuple[int, float, int], Case]:
    """Draw the cases of each object and noise once, and keep the picked ones."""
    wanted = {(pick.place, pick.noise, pick.row) for pick in picks}
    return {
        (place, noise, row): case
        for place, noise in sorted({(place, noise) for place, noise, _ in wanted})
        for row, case in enumerate(draw_cases(objects[place], config.crops, noise, config.random_seed))
        if (place, noise, row) in wanted
    }


def _shown(pick: _Pick, found: ObjectImages, case: Case, exported: Export, titles: Mapping[str, str]) -> Shown:
    poses = exported.read(OURS, found.name, pick.noise)
    pose = poses.refined[pick.row] if poses.found[pick.row] else None
    rival = None
    if pick.rival is not None:
        theirs = exported.read(pick.rival, found.name, pick.noise).refined[pick.row]
        rival = RivalPose(titles[pick.rival], theirs, pick.rival_error)
    return Shown(f"{pick.title}, {noise_name(pick.noise)}", found.model, case, pose, pick.error, rival)
