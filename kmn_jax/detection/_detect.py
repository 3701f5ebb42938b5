"""The copies of a part in a scene: rounds of candidates, the choice among them, and the order to pick them in."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from kmn_jax.detection._calibrate import Calibration, Probabilities
from kmn_jax.detection._candidates import (
    NUM_SEEDS,
    CandidateConfig,
    Candidates,
    Solver,
    crop_prediction,
    find_candidates,
    improved,
    join,
    seeds_at,
    seeds_over,
)
from kmn_jax.detection._coverage import CoverageConfig, cover, nothing_covered, to_search
from kmn_jax.detection._evidence import EVIDENCE
from kmn_jax.detection._frames import placed
from kmn_jax.detection._result import Detection, Detections
from kmn_jax.detection._scene import Scene
from kmn_jax.detection._select import SelectConfig, Selection, same_place, select
from kmn_jax.detection._timing import Clock
from kmn_jax.errors import InputError
from kmn_jax.models import Model
from kmn_jax.objects import Part, Symmetries

_SHARES = ("explained", "violated", "occluded", "unknown")
_CLOSE_GAP = 0.05  # of probabilities
_SYMMETRIC = "the part is symmetric: of the poses that look the same, this is the canonical one"
_RIVALLED = "another pose in this place is nearly as probable: the part may lie the other way round"


@dataclass(frozen=True)
class DetectConfig:
    """How a scene is searched; lengths are shares of the object's diameter."""

    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    coverage: CoverageConfig = field(default_factory=CoverageConfig)
    select: SelectConfig = field(default_factory=SelectConfig)
    later_seeds: int = 16  # at most in a round after the first; rounds go on until the foreground is covered
    most_seeds: int = 512  # at least so many are searched before it is given up to cover the foreground
    accepted: float = 0.5  # the probability from which on a pose explains points, and counts as found
    reported: float = 0.1  # less probable poses are left out
    considered: int = 128  # most probable poses that are compared with each other

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        if min(self.later_seeds, self.most_seeds) < 1 or not 0 <= self.reported <= self.accepted <= 1:
            raise InputError(
                f"later_seeds = {self.later_seeds} and most_seeds = {self.most_seeds} must be at least 1, and reported"
                f" = {self.reported} and accepted = {self.accepted} probabilities in this order"
            )


THOROUGH = DetectConfig(coverage=CoverageConfig(patience=None))


def detect(
    model: Model,
    probabilities: Probabilities,
    part: Part,
    scene: Scene,
    seed: int,
    config: DetectConfig,
    at: Float[np.ndarray, "k 3"] | None = None,
    solver: Solver | None = None,
    clock: Clock | None = None,
) -> Detections:
    """Return the copies of a part, whose lengths are in the scene's unit, in pick order.

    With places `at`, in the view's frame, only these are searched. The same inputs and `seed` give the same bits on
    one device.
    """
    clock = clock or Clock()
    rounds: list[Candidates] = []
    warnings, free, state = scene.warnings, scene.foreground, nothing_covered(scene)
    while True:
        with clock("search"):
            most = config.later_seeds if rounds else NUM_SEEDS
            seeds = seeds_over(scene, free, part, config.candidates, most) if at is None else seeds_at(scene, at)
            rounds.append(find_candidates(model, part, scene, seeds, seed + len(rounds), config.candidates, solver))
        if at is not None:
            break
        with clock("coverage"):
            last = rounds[-1]
            probability = probabilities.found.probability(last.evidence)
            likely = last.usable & (probability >= config.accepted)
            score, reach = np.where(likely, probability, 0), same_place(part, config.select)
            state = cover(state, scene, part, last, score, reach, config.coverage)
            free = to_search(state, scene, part, config.coverage)
        if not free.any():
            break
        if sum(len(found.searched.rows) for found in rounds) >= config.most_seeds:
            left = free.sum() / scene.foreground.sum()
            warnings = (*warnings, f"{left:.0%} of the foreground was not searched: narrow it down to where parts are")
            break
    with clock("selection"):
        joined = join(rounds)
        choice = _selected(joined, probabilities.found, part, config)
    if choice.kept.any():
        with clock("refinement"):
            rows = np.flatnonzero(choice.kept | choice.contenders)
            joined = improved(model, part, scene, joined, rows, seed, config.candidates)
        with clock("selection"):
            choice = _selected(joined, probabilities.refined, part, config)
    with clock("report"):
        probability = probabilities.refined.probability(joined.evidence)
        found = [
            _detection(row, float(probability[row]), float(choice.gap[row]), joined, part, scene)
            for row in np.flatnonzero(choice.kept).tolist()
        ]
        found.sort(key=lambda pose: -pose.probability * pose.visible_fraction)
    reason = None if found else "; ".join(filter(None, (_reason(joined, part), scene.doubt)))
    return Detections(part.name, scene.unit, tuple(found), clock.timing, reason, warnings)


def _selected(found: Candidates, calibration: Calibration, part: Part, config: DetectConfig) -> Selection:
    """Choose among the most probable candidates."""
    probability = calibration.probability(found.evidence)
    possible = found.usable & (probability >= config.reported)
    ranked = np.argsort(-np.where(possible, probability, -1), kind="stable")[: config.considered]
    few = np.zeros_like(possible)
    few[ranked] = possible[ranked]
    return select(found.T_view_object, probability, few, part, config.select)


def _detection(row: int, probability: float, gap: float, found: Candidates, part: Part, scene: Scene) -> Detection:
    T_scene_view = scene.view.T_scene_view
    pose = T_scene_view @ found.T_view_object[row].astype(np.float64)
    pose = canonical_pose(pose, part.symmetries)
    shares = {name: float(found.evidence[row, EVIDENCE.index(name)]) for name in _SHARES}
    prediction = crop_prediction(found, row)
    return Detection(
        T_scene_object=pose,
        probability=probability,
        num_inliers=int(found.num_inliers[row]),
        visible_fraction=1 - shares["occluded"],
        runner_up_gap=gap,
        seed=placed(T_scene_view, np.asarray(found.searched.crops.seed[found.crop[row]])),
        prediction=replace(prediction, points=placed(T_scene_view, prediction.points).astype(np.float32)),
        warnings=tuple(
            text for text, holds in ((_SYMMETRIC, part.is_symmetric), (_RIVALLED, gap < _CLOSE_GAP)) if holds
        ),
        **shares,
    )


def canonical_pose(T_scene_object: Float[np.ndarray, "4 4"], symmetries: Symmetries) -> Float[np.ndarray, "4 4"]:
    """Return, of the poses that look the same, the one whose axes are nearest to the scene's, as a proper rigid pose.

    Nearest means the largest trace of the rotation; continuous symmetries are turned to it exactly.
    """
    rotation = _orthonormal(T_scene_object[:3, :3])
    forms = [rotation @ other for other in symmetries.rotations]
    for axis in symmetries.axes:
        forms = [_turned_to_identity(form, axis) for form in forms]
    best = max(range(len(forms)), key=lambda row: (round(float(np.trace(forms[row])), 6), -row))
    result = np.eye(4)
    result[:3, :3] = forms[best]
    # The symmetry's centre stays where it is.
    place = rotation @ symmetries.center + T_scene_object[:3, 3]
    result[:3, 3] = place - forms[best] @ symmetries.center
    return result


def _turned_to_identity(rotation: Float[np.ndarray, "3 3"], axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation followed, in the object's frame, by the turn about an axis that makes its trace largest."""
    cross = np.cross(np.eye(3), axis)  # the matrix of the product with the axis, up to its sign
    outer = np.outer(axis, axis)
    cosine = float(np.trace(rotation) - axis @ rotation @ axis)
    sine = float(np.trace(rotation @ cross.T))
    angle = np.arctan2(sine, cosine)
    turn = outer + np.cos(angle) * (np.eye(3) - outer) + np.sin(angle) * cross.T
    return rotation @ turn


def _orthonormal(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the nearest rotation: float32 leaves errors of 1e-6."""
    left, _, right = np.linalg.svd(rotation)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def _reason(found: Candidates, part: Part) -> str:
    """Say why nothing is reported."""
    if not found.usable.any():
        places = len(np.unique(found.searched.rows))
        return f"no pose of {part.name} agrees with any of the {places} places that were searched"
    return f"none of the {int(found.usable.sum())} poses that were found is probable: {part.name} may not be there"
