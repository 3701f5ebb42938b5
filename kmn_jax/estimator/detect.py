"""The copies of a part in a scene: rounds of candidates, the choice among them, and the order to pick them in."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from kmn_jax.checks import InputError
from kmn_jax.data.symmetry import Symmetries
from kmn_jax.estimator.calibrate import Calibration, Probabilities
from kmn_jax.estimator.candidates import (
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
from kmn_jax.estimator.evidence import EVIDENCE
from kmn_jax.estimator.frames import into, placed
from kmn_jax.estimator.part import Part
from kmn_jax.estimator.result import Detection, Detections
from kmn_jax.estimator.scene import Scene
from kmn_jax.estimator.select import SelectConfig, Selection, select
from kmn_jax.estimator.timing import Clock
from kmn_jax.models import Model

_SHARES = ("explained", "violated", "occluded", "unknown")
_LEAST_CROWD = 16  # points of a cell: fewer make no crop
_COVER_POINTS = 1024  # on a part's surface


@dataclass(frozen=True)
class DetectConfig:
    """How a scene is searched; lengths are shares of the object's diameter."""

    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    select: SelectConfig = field(default_factory=SelectConfig)
    rounds: int = 8  # at most; each spreads seeds over what no seed is near and no found pose explains
    accepted: float = 0.5  # the probability from which on a pose explains points, and counts as found
    reported: float = 0.1  # less probable poses are left out
    considered: int = 128  # most probable poses that are compared with each other
    explained: float = 0.05  # points so near to the surface of a found part need no other one

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        if self.rounds < 1 or not 0 <= self.reported <= self.accepted <= 1 or not self.explained > 0:
            raise InputError(
                f"rounds = {self.rounds} must be at least 1, reported = {self.reported} and accepted = {self.accepted}"
                f" probabilities in this order, and explained = {self.explained} above zero"
            )


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
    free = scene.foreground
    while True:
        with clock("search"):
            seeds = seeds_over(scene, free, part, config.candidates) if at is None else seeds_at(scene, at)
            rounds.append(find_candidates(model, part, scene, seeds, seed + len(rounds), config.candidates, solver))
        if at is not None or len(rounds) == config.rounds:
            break
        with clock("coverage"):
            last = rounds[-1]
            likely = last.usable & (probabilities.found.probability(last.evidence) >= config.accepted)
            free = _uncovered(scene, free, part, last, likely, config)
        if not free.any():
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
    reason = None if found else _reason(joined, part)
    return Detections(part.name, scene.unit, tuple(found), clock.timing, reason, scene.warnings)


def _selected(found: Candidates, calibration: Calibration, part: Part, config: DetectConfig) -> Selection:
    """Choose among the most probable candidates."""
    probability = calibration.probability(found.evidence)
    possible = found.usable & (probability >= config.reported)
    ranked = np.argsort(-np.where(possible, probability, -1), kind="stable")[: config.considered]
    few = np.zeros_like(possible)
    few[ranked] = possible[ranked]
    return select(found.T_view_object, probability, few, part, config.select)


def _uncovered(
    scene: Scene,
    free: Bool[np.ndarray, " r"],
    part: Part,
    found: Candidates,
    likely: Bool[np.ndarray, " s"],
    config: DetectConfig,
) -> Bool[np.ndarray, " r"]:
    """Return the free points that no searched seed is near to and no likely pose explains, but for stray ones."""
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(free)
    spacing = config.candidates.seed_spacing * part.diameter
    searched = cKDTree(np.asarray(found.searched.crops.seed))
    near, _ = searched.query(scene.points[rows], distance_upper_bound=spacing / 2)
    rows = rows[~np.isfinite(near)]
    size = min(len(part.points), _COVER_POINTS)
    surface, reach = cKDTree(part.points[:size]), config.explained * part.diameter + float(np.sqrt(part.area / size))
    for row in _one_a_place(found, likely, part, config.select.same_pose):
        local = into(found.T_view_object[row].astype(np.float64), scene.points[rows])
        inside = np.flatnonzero(((local >= part.minimum - reach) & (local <= part.maximum + reach)).all(axis=1))
        distance, _ = surface.query(local[inside], distance_upper_bound=reach)
        rows = np.delete(rows, inside[np.isfinite(distance)])
    cells = np.floor(scene.points[rows] / spacing).astype(np.int64)
    _, which, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    result = np.zeros_like(free)
    result[rows[counts[which.reshape(-1)] >= _LEAST_CROWD]] = True
    return result


def _one_a_place(found: Candidates, likely: Bool[np.ndarray, " s"], part: Part, reach: float) -> list[int]:
    """Return rows of likely candidates whose centres are apart."""
    centers = (found.T_view_object @ np.append((part.minimum + part.maximum) / 2, 1))[:, :3]
    chosen: list[int] = []
    for row in np.flatnonzero(likely).tolist():
        if all(np.linalg.norm(centers[row] - centers[other]) > reach * part.diameter for other in chosen):
            chosen.append(row)
    return chosen


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
        warnings=("the part is symmetric: of the poses that look the same, this is the canonical one",)
        if part.is_symmetric
        else (),
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
        return f"no pose of {part.name} agrees with any of the {len(found.usable)} places that were searched"
    return f"none of the {int(found.usable.sum())} poses that were found is probable: {part.name} may not be there"
