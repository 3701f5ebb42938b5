"""Which candidates are refined, and which of them stand: the best of each place and, where that is asked for, others.

What is said of a pose as it was found is rough: of several in one place, another one may become the better pose once
all are refined. So `DetectConfig.next_best` refines more of them where none has become a sure one.
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
from kmn_jax.detection._evidence import EVIDENCE, gather_evidence
from kmn_jax.detection._mapping import call_rows
from kmn_jax.detection._polish import polish
from kmn_jax.detection._refinement import refine_many, refine_one
from kmn_jax.detection._scene import Scene
from kmn_jax.detection._search import Candidates, SearchConfig, seed_keys
from kmn_jax.detection._selection import Selection, select_poses
from kmn_jax.detection._timing import Clock
from kmn_jax.detection._verification import VERIFIED, verified

_CONSIDERED = 128  # most probable poses that are compared with each other: one number, so one compilation
_POINTS = 16  # on the surface, by which candidates are told apart
_OTHER = 0.05  # diameters: a candidate that is nowhere farther from one that was refined would become the same pose
_APART = 2 * _OTHER  # centres of mass of such candidates, as sampled, are no farther apart
_SURE = 2.0  # a score above all probabilities


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

    Refined are the most probable one of each place and a contender; then, up to `config.next_best` times, the next one
    of each place where no sure pose stands; and in the end those that stand and are not sure, once more from where they
    are. `search` is `config.search` of the network.
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
    for _ in range(config.next_best):
        with clock("selection"):
            sure = best.candidates.T_camera_object[best.selection.kept & (best.probability >= config.sure)]
            rows = best_left(found, np.concatenate(tried), sure, probabilities.found, on_device, config)
        if not len(rows):
            break
        best = judged(_together(best.candidates, refined(rows)))
        tried.append(rows)
    doubtful = np.flatnonzero(best.selection.kept & (best.probability < config.sure))
    if not len(doubtful):
        return best
    forms = len(best.candidates.usable) // sum(map(len, tried))
    rows = np.concatenate([np.tile(some, forms) for some in tried])[doubtful]  # that they were made of
    return judged(_together(best.candidates, refined(rows, best.candidates.T_camera_object[doubtful])))


def best_left(
    found: Candidates,
    tried: Int[np.ndarray, " k"],
    taken: Float32[np.ndarray, "t 4 4"],
    calibration: Calibration,
    part: DevicePart,
    config: DetectConfig,
) -> Int[np.ndarray, " b"]:
    """Return the rows of the most probable candidate of each place, but for places that poses have `taken`.

    Candidates that are like those in the rows that were `tried` are left out.
    """
    probability, possible = _possible(found, calibration, config)
    rows = np.flatnonzero(possible)
    rows = rows[~_alike(found.T_camera_object[rows], found.T_camera_object[tried], part)]
    if not len(rows):
        return rows
    poses = np.concatenate([taken, found.T_camera_object[rows]])
    score = np.concatenate([np.full(len(taken), _SURE), probability[rows]])
    return rows[_selected(poses, np.ones(len(poses), dtype=bool), score, score, part).kept[len(taken) :]]


def _alike(
    poses: Float32[np.ndarray, "s 4 4"], tried: Float32[np.ndarray, "k 4 4"], part: DevicePart
) -> Bool[np.ndarray, " s"]:
    """Return which poses are nowhere farther than `_OTHER` from one that was tried, up to symmetry."""
    points, symmetries = np.asarray(part.arrays.points), np.asarray(part.symmetries)
    diameter, surface = float(part.arrays.diameter), points[:_POINTS]
    centers, tried_centers = (_placed(some, points.mean(axis=0)[None]) for some in (poses, tried))
    apart = np.linalg.norm(centers - tried_centers[:, 0], axis=2)
    own, other = np.nonzero(apart <= _APART * diameter)  # most are ruled out by that
    places = _placed(poses, surface)[own, None]
    turned = _placed((tried[:, None] @ symmetries).reshape(-1, 4, 4), surface)
    turned = turned.reshape(len(tried), len(symmetries), *surface.shape)[other]
    near = ((places - turned) ** 2).sum(axis=3).max(axis=2) <= (_OTHER * diameter) ** 2
    result = np.zeros(len(poses), dtype=bool)
    result[own[near.any(axis=1)]] = True
    return result


def _placed(poses: Float32[np.ndarray, "s 4 4"], points: Float32[np.ndarray, "p 3"]) -> Float32[np.ndarray, "s p 3"]:
    """Return points of the part at each pose."""
    return points @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]


def _together(before: Candidates, more: Candidates) -> Candidates:
    """Return candidates of the same crops as one."""
    columns = ("T_camera_object", "usable", "evidence", "num_inliers", "crop")
    both: dict[str, Any] = {name: np.concatenate([getattr(before, name), getattr(more, name)]) for name in columns}
    return before._replace(**both)


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
    # The refined forms take the place of the poses of their crops.
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
    """Choose among the most probable candidates, by an `exact` model where there is one."""
    probability, possible = _possible(found, calibration, config)
    score = probability.copy()
    if exact is not None:
        score[possible] = exact.probability(found.evidence[possible])
    return _selected(found.T_camera_object, possible, probability, score, part)


def _possible(
    found: Candidates, calibration: Calibration, config: DetectConfig
) -> tuple[Float[np.ndarray, " s"], Bool[np.ndarray, " s"]]:
    """Return how probable candidates are, and which are probable enough to be reported."""
    probability = np.zeros(len(found.usable))
    probability[found.usable] = calibration.probability(found.evidence[found.usable])
    return probability, found.usable & (probability >= config.reported)


def _selected(
    poses: Float32[np.ndarray, "s 4 4"],
    possible: Bool[np.ndarray, " s"],
    rank: Float[np.ndarray, " s"],
    score: Float[np.ndarray, " s"],
    part: DevicePart,
) -> Selection:
    """Choose by score among those possible poses that rank highest."""
    ranked = np.argsort(-np.where(possible, rank, -1), kind="stable")[:_CONSIDERED]
    rows = np.pad(ranked, (0, _CONSIDERED - len(ranked)), mode="edge")
    usable = possible[rows] & (np.arange(_CONSIDERED) < len(ranked))
    given = jax.device_put((poses[rows], score[rows].astype(np.float32), usable))
    few: Selection = jax.device_get(select_poses(given[0], given[1], given[2], part))

    def of_all(values: Any) -> Any:
        result = np.zeros(len(possible), dtype=values.dtype)
        result[ranked] = values[: len(ranked)]
        return result

    return Selection(*map(of_all, few))


def reported(
    refined: Candidates, probabilities: Probabilities, part: DevicePart, config: DetectConfig, is_narrowed: bool
) -> tuple[Selection, Float[np.ndarray, " s"]]:
    """Choose among refined candidates, and return also how probable those that stand are, given each other."""
    choice = chosen(refined, probabilities.refined, part, config, probabilities.exact)
    probability = np.zeros(len(choice.kept))
    probability[choice.kept] = probabilities.of_scene(refined.evidence[choice.kept], is_narrowed)
    return choice, probability
