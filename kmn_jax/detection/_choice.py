"""Which candidates are refined, and which of them stand: the best of each place and, where that is not sure, others.

What is said of a pose as it was found is rough: of several in one place, another one may become the better pose once
all are refined. So, once some pose of the scene is sure, up to `DetectConfig.next_best` more of them are refined in
each place where one stands that is not.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from kmn_jax.detection._calibration import Calibration, Probabilities
from kmn_jax.detection._config import DetectConfig
from kmn_jax.detection._crop_search import CropPoses
from kmn_jax.detection._device_part import DevicePart
from kmn_jax.detection._disambiguation import disambiguate
from kmn_jax.detection._evidence import EVIDENCE, gather_evidence
from kmn_jax.detection._mapping import call_rows
from kmn_jax.detection._polish import polish
from kmn_jax.detection._refinement import refine_many, refine_one
from kmn_jax.detection._scene import Scene
from kmn_jax.detection._search import Candidates, SearchConfig, seed_keys
from kmn_jax.detection._selection import Selection, select_poses
from kmn_jax.detection._timing import Clock
from kmn_jax.detection._verification import VERIFIED, verified
from kmn_jax.programs import compiled_size

_FEWEST, _MOST = 128, 2048  # poses that are compared with each other: powers of two, each of which is compiled for
_POINTS = 16  # on the surface, by which candidates are told apart
_OTHER = 0.05  # diameters: a candidate that is nowhere farther from one that was refined would become the same pose
_APART = 2 * _OTHER  # centres of mass of such candidates, as sampled, are no farther apart
_NUMBERS = 1 << 22  # that are compared at once: balls have thousands of symmetries


class Choice(NamedTuple):
    """Candidates, which of them stand, and how probable those are."""

    candidates: Candidates
    selection: Selection
    probability: Float[np.ndarray, " s"]


def choose_and_refine(
    found: Candidates,
    probabilities: Probabilities,
    on_device: DevicePart,
    scene: Scene,
    random_seed: int,
    config: DetectConfig,
    search: SearchConfig,
    clock: Clock,
) -> Choice:
    """Return refined candidates, and the choice among them; what was found as it is where nothing of it is chosen.

    Refined are the most probable one of each place and a contender; then, once one of the scene is sure, up to
    `config.next_best` times the next one of each place in which an unsure one stands, and in the end those that stand
    and are unsure once more, from where they are. Without a sure one, a part that is not there would only have more
    chances to be mistaken; and of the many places where nothing stands few have one. What stands is at last compared
    with all that the part is mistaken for (`disambiguate`). `search` is `config.search` of the network.
    """
    with clock("selection"):
        first = chosen(found, probabilities.found, on_device, config)
    if not first.kept.any():
        return Choice(found, first, probabilities.found.probability(found.evidence))

    def refined(rows: Int[np.ndarray, " k"], starts: Float32[np.ndarray, "k 4 4"] | None = None) -> Candidates:
        with clock("refinement"):
            return refined_candidates(on_device, scene, found, rows, random_seed, search, starts)

    def judged(fine: Candidates) -> Choice:
        with clock("selection"):
            return Choice(fine, *reported(fine, probabilities, on_device, config, scene.is_narrowed))

    rows = np.flatnonzero(first.kept | first.contenders)
    best, tried = judged(refined(rows)), [rows]
    unsure, sure = _standing(best, config)
    while len(unsure) and len(sure) and len(tried) <= config.next_best:
        with clock("selection"):
            poses, before = best.candidates.T_camera_object, np.concatenate(tried)
            rows = next_best_rows(found, before, poses[unsure], poses[sure], probabilities.found, on_device, config)
        if not len(rows):
            break
        best = judged(_together(best.candidates, refined(rows)))
        tried.append(rows)
        unsure, sure = _standing(best, config)
    forms = len(best.candidates.usable) // sum(map(len, tried))

    def made_of(rows: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
        return np.concatenate([np.tile(some, forms) for some in tried])[rows]

    if len(unsure) and len(sure):
        rows = made_of(unsure)
        best = judged(_together(best.candidates, refined(rows, best.candidates.T_camera_object[unsure])))
        tried.append(rows)
    with clock("refinement"):
        stand = np.flatnonzero(best.selection.kept)
        poses, is_other = disambiguate(best.candidates.T_camera_object[stand], on_device, scene.cloud, scene.image)
        rows = stand[is_other]
        if not len(rows):
            return best
        # In as many forms as before, of which there is the first: for those the evidence is compiled.
        other = np.repeat(poses[is_other][:, None], forms, axis=1)
        there = np.tile(np.arange(forms) == 0, (len(rows), 1))
        others = _with_evidence(found, made_of(rows), other, there, on_device, scene, search)
        fine = _replaced(best.candidates, rows, others)
    with clock("selection"):
        return Choice(fine, *_probable(best.selection, fine, probabilities, config, scene.is_narrowed))


def _standing(choice: Choice, config: DetectConfig) -> tuple[Int[np.ndarray, " u"], Int[np.ndarray, " t"]]:
    """Return the rows of poses that stand and are not sure, and of those that are."""
    is_sure = choice.probability >= config.sure
    unsure, sure = (np.flatnonzero(choice.selection.kept & which) for which in (~is_sure, is_sure))
    return unsure, sure


def next_best_rows(
    found: Candidates,
    tried: Int[np.ndarray, " k"],
    unsure: Float32[np.ndarray, "u 4 4"],
    sure: Float32[np.ndarray, "t 4 4"],
    calibration: Calibration,
    part: DevicePart,
    config: DetectConfig,
) -> Int[np.ndarray, " b"]:
    """Return the rows of the most probable candidate of each place that an `unsure` pose is in, and no `sure` one.

    Candidates that are like those in the rows that were `tried` are left out.
    """
    rows = np.flatnonzero(found.usable)
    rows = rows[in_unsure_places(found.T_camera_object[rows], unsure, sure, part)]
    rows = rows[~_alike(found.T_camera_object[rows], found.T_camera_object[tried], part)]
    usable = np.zeros_like(found.usable)
    usable[rows] = True
    return np.flatnonzero(chosen(found._replace(usable=usable), calibration, part, config).kept)


def in_unsure_places(
    poses: Float32[np.ndarray, "s 4 4"],
    unsure: Float32[np.ndarray, "u 4 4"],
    sure: Float32[np.ndarray, "t 4 4"],
    part: DevicePart,
) -> Bool[np.ndarray, " s"]:
    """Return which poses have their middle as near to an unsure one's as poses of one copy, and to no sure one's."""
    near_unsure, near_sure = (
        _apart(poses, others, part).min(axis=1, initial=np.inf) <= float(part.reach) for others in (unsure, sure)
    )
    return near_unsure & ~near_sure


def _apart(
    poses: Float32[np.ndarray, "s 4 4"], others: Float32[np.ndarray, "t 4 4"], part: DevicePart
) -> Float[np.ndarray, "s t"]:
    """Return how far the part's middle at each pose is from that at each other one."""
    middle = np.asarray(part.arrays.points).mean(axis=0)[None]
    return np.linalg.norm(_placed(poses, middle) - _placed(others, middle)[:, 0], axis=2)


def _alike(
    poses: Float32[np.ndarray, "s 4 4"], tried: Float32[np.ndarray, "k 4 4"], part: DevicePart
) -> Bool[np.ndarray, " s"]:
    """Return which poses are nowhere farther than `_OTHER` from one that was tried, up to symmetry.

    Of continuous symmetries there are steps: what is turned by half of one may count as another pose.
    """
    symmetries = np.unique(np.asarray(part.symmetries), axis=0)
    diameter, surface = float(part.arrays.diameter), np.asarray(part.arrays.points)[:_POINTS]
    places, result = _placed(poses, surface), np.zeros(len(poses), dtype=bool)
    at_once = max(1, _NUMBERS // (len(symmetries) * surface.size))
    for pose, is_near in zip(tried, (_apart(poses, tried, part) <= _APART * diameter).T, strict=True):
        near = np.flatnonzero(is_near & ~result)
        if not len(near):
            continue
        turned = _placed(pose @ symmetries, surface)
        for rows in np.array_split(near, -(-len(near) // at_once)):
            farthest = ((places[rows, None] - turned) ** 2).sum(axis=3).max(axis=2)
            result[rows] = (farthest <= (_OTHER * diameter) ** 2).any(axis=1)
    return result


def _placed(poses: Float32[np.ndarray, "s 4 4"], points: Float32[np.ndarray, "p 3"]) -> Float32[np.ndarray, "s p 3"]:
    """Return points of the part at each pose."""
    return points @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]


def _together(before: Candidates, more: Candidates) -> Candidates:
    """Return candidates of the same crops as one."""
    columns = ("T_camera_object", "usable", "evidence", "num_inliers", "crop")
    both: dict[str, Any] = {name: np.concatenate([getattr(before, name), getattr(more, name)]) for name in columns}
    return before._replace(**both)


def _replaced(candidates: Candidates, rows: Int[np.ndarray, " k"], other: Candidates) -> Candidates:
    """Return candidates with others, the first ones, of the same crops in some rows."""
    columns = {name: getattr(candidates, name).copy() for name in ("T_camera_object", "evidence", "num_inliers")}
    for name, column in columns.items():
        column[rows] = getattr(other, name)[: len(rows)]
    return candidates._replace(**columns)


def refined_candidates(
    on_device: DevicePart,
    scene: Scene,
    found: Candidates,
    rows: Int[np.ndarray, " k"],
    random_seed: int,
    config: SearchConfig,
    starts: Float32[np.ndarray, "k 4 4"] | None = None,
) -> Candidates:
    """Return some of the candidates refined on all points around them, and turned forms of them that fit as well.

    It begins where they are, or at other poses, `starts`, around the same seeds. The first k are the candidates
    themselves. All are polished, so that what is compared are the best poses of each form, and have evidence of their
    own.
    """
    given = (on_device, scene.cloud, scene.image, config.crops.smooth, config.agreement)
    seeds = found.seed_rows[found.crop[rows]]
    poses, there = call_rows(
        lambda pose, row, key: refine_one(pose, row, jax.random.wrap_key_data(key), *given),
        lambda poses, rows, keys: refine_many(poses, rows, keys, *given),
        found.T_camera_object[rows] if starts is None else starts,
        seeds.astype(np.int32),
        seed_keys(seeds, random_seed),
    )
    poses = np.array(poses)
    poses[there] = polish(poses[there], on_device, scene.image)
    return _with_evidence(found, rows, poses, there, on_device, scene, config)


def _with_evidence(
    found: Candidates,
    rows: Int[np.ndarray, " k"],
    poses: Float32[np.ndarray, "k a 4 4"],
    there: Bool[np.ndarray, "k a"],
    on_device: DevicePart,
    scene: Scene,
    config: SearchConfig,
) -> Candidates:
    """Return forms of some of the candidates, with evidence of their own, which take the place of what is in crops."""
    forms = there.shape[1]
    own = jax.tree.map(
        lambda leaf: np.repeat(leaf.reshape(-1, *leaf.shape[2:])[rows, None], forms, axis=1),
        (found.found.poses, found.found.scores),
    )
    wide = own[0]._replace(T_scene_object=poses, converged=there)
    crops: CropPoses = jax.tree.map(lambda leaf: leaf[found.crop[rows]], found.found)
    crops = crops._replace(poses=wide, scores=own[1])
    agreement = config.agreement

    def proof(crops: CropPoses) -> Float[jax.Array, "a f"]:
        return gather_evidence(crops, on_device.arrays, on_device.surfels, scene.image, agreement)

    evidence = np.array(call_rows(proof, jax.vmap(proof), crops))
    evidence[there, EVIDENCE.index(VERIFIED)] = verified(poses[there], on_device, scene)
    return Candidates(
        _forms_first(poses),
        _forms_first(there),
        _forms_first(evidence),
        _forms_first(wide.num_inliers),
        np.tile(found.crop[rows], forms),
        found.found,
        found.seed_rows,
    )


def _forms_first(leaf: Any) -> np.ndarray:
    """Return rows of forms (k, a, ...) one form after the other, (a * k, ...)."""
    return np.swapaxes(leaf, 0, 1).reshape(-1, *leaf.shape[2:])


def chosen(
    found: Candidates,
    calibration: Calibration,
    part: DevicePart,
    config: DetectConfig,
    exact: Calibration | None = None,
) -> Selection:
    """Choose among candidates that are probable enough, by an `exact` model where there is one."""
    probability = np.zeros(len(found.usable))
    probability[found.usable] = calibration.probability(found.evidence[found.usable])
    possible = found.usable & (probability >= config.reported)
    size = min(max(_FEWEST, compiled_size(possible.sum().item())), _MOST)
    ranked = np.argsort(-np.where(possible, probability, -1), kind="stable")[:size]
    rows = np.pad(ranked, (0, size - len(ranked)), mode="edge")
    usable = possible[rows] & (np.arange(size) < len(ranked))
    poses = found.T_camera_object[rows]
    score = probability.copy()
    if exact is not None:
        score[possible] = exact.probability(found.evidence[possible])
    given = jax.device_put((poses, score[rows].astype(np.float32), usable))
    few: Selection = jax.device_get(select_poses(given[0], given[1], given[2], part))

    def of_all(values: Any) -> Any:
        result = np.zeros(len(possible), dtype=values.dtype)
        result[ranked] = values[: len(ranked)]
        return result

    return Selection(*map(of_all, few))


def reported(
    refined: Candidates, probabilities: Probabilities, part: DevicePart, config: DetectConfig, is_narrowed: bool
) -> tuple[Selection, Float[np.ndarray, " s"]]:
    """Choose among refined candidates those that are probable enough, also given each other, and say how probable.

    What is then too improbable leaves its place empty: a rival there would be no surer.
    """
    choice = chosen(refined, probabilities.refined, part, config, probabilities.exact)
    return _probable(choice, refined, probabilities, config, is_narrowed)


def _probable(
    choice: Selection, of: Candidates, probabilities: Probabilities, config: DetectConfig, is_narrowed: bool
) -> tuple[Selection, Float[np.ndarray, " s"]]:
    """Return which of the chosen candidates are probable enough, given each other, and how probable all are."""
    probability = np.zeros(len(choice.kept))
    probability[choice.kept] = probabilities.of_scene(of.evidence[choice.kept], is_narrowed)
    return choice._replace(kept=choice.kept & (probability >= config.reported)), probability
