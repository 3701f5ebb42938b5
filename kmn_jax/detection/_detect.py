"""The copies of a part in a scene: rounds of candidates, the choice among them, and the order to pick them in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from kmn_jax.detection._calibration import Calibration, Probabilities
from kmn_jax.detection._canonical import canonical_pose
from kmn_jax.detection._choice import choose_and_refine, chosen
from kmn_jax.detection._config import DetectConfig
from kmn_jax.detection._coverage import cover, nothing_covered, to_search, unexplained
from kmn_jax.detection._depth_agreement import DepthImage
from kmn_jax.detection._device_part import DevicePart, device_part, same_place
from kmn_jax.detection._evidence import EVIDENCE, gather_evidence
from kmn_jax.detection._frames import placed
from kmn_jax.detection._polish import polish_one
from kmn_jax.detection._refinement import refine_one
from kmn_jax.detection._result import Detection, Detections
from kmn_jax.detection._scene import Scene
from kmn_jax.detection._search import (
    Candidates,
    SearchConfig,
    crop_prediction,
    join,
    no_poses,
    search_at,
)
from kmn_jax.detection._seeds import NUM_SEEDS, seeds_at, seeds_over
from kmn_jax.detection._selection import Selection
from kmn_jax.detection._timing import Clock
from kmn_jax.detection._verification import verify_ahead
from kmn_jax.geometry import PaddedCloud
from kmn_jax.io import object_doubt
from kmn_jax.models import Model
from kmn_jax.objects import Part
from kmn_jax.programs import meanwhile

_SHARES = ("explained", "violated", "occluded", "unknown")
_CLOSE_GAP = 0.05  # of probabilities
_MOST_UNEXPLAINED = 0.5  # of the foreground: with more, it is told how to narrow it down
_FLUSH = 0.4  # of the outline: with more of it in the plane of a larger surface, a pose may be on a wall or a table
_MANY_FLUSH = 3  # poses: fewer need not be told
_FEW_POINTS = 100  # of the foreground: with fewer, that nothing was found says nothing of the scan
_SYMMETRIC = "the object is symmetric: of the poses that look the same, this is the canonical one"
_NARROW = (
    ": on walls, rims and tables poses may be wrong though they are called probable; give the scan without parts"
    " (--background), or the box that parts are in (--roi)"
)
_RIVALLED = (
    "another pose in this place is nearly as probable: the object may be turned about its axis or lie the other way"
    " round"
)


def detect(
    model: Model,
    probabilities: Probabilities,
    part: Part,
    scene: Scene,
    random_seed: int,
    config: DetectConfig,
    at: Float[np.ndarray, "k 3"] | None = None,
    clock: Clock | None = None,
) -> Detections:
    """Return the copies of a part, whose lengths are in the scene's unit, in pick order.

    With places `at`, in the camera's frame, each has one pose or none: that of the crop around the nearest point. The
    same inputs and `random_seed` give the same bits on one device.
    """
    clock = clock or Clock()
    search = config.search_of(model.config, at_places=at is not None)
    on_device, warnings = device_part(model, part), scene.warnings
    propose = partial(search_at, model, on_device, scene, random_seed=random_seed, config=search)
    if at is None:
        if jax.default_backend() == "cpu":  # elsewhere what is called is compiled for all poses at once
            meanwhile(compile_ahead, on_device, scene.cloud, scene.image, search, model.config.num_keypoints)
        found, more = explore(scene, part, propose, probabilities.found, config, clock)
        warnings = (*warnings, *more)
        found, choice, probability = choose_and_refine(
            found, probabilities, on_device, scene, random_seed, config, search, clock
        )
    else:
        with clock("search"):
            found = propose(seeds_at(scene, at))
            found = found._replace(usable=found.usable & found.is_first)
        with clock("selection"):
            choice = chosen(found, probabilities.found, on_device, config)
        probability = probabilities.found.probability(found.evidence)
    with clock("report"):
        poses = detections(found, choice, probability, part, scene)
        accepted = choice.kept & (probability >= config.accepted)
        left = unexplained(scene.foreground, scene, part, found.T_camera_object[accepted])
        share, points = left.sum() / scene.foreground.sum(), scene.placed(scene.points[left])
    doubt = None if accepted.any() else _object_doubt(part, scene)
    reason = None if poses else "; ".join(filter(None, (_reason(found, part, scene), scene.doubt, doubt)))
    if poses and doubt is not None:
        warnings = (*warnings, doubt)
    result = Detections(part.name, scene.unit, poses, clock.timing, reason, warnings)
    if at is not None:
        return result
    if poses and not scene.is_narrowed:
        warnings = (*warnings, *narrowing(found.evidence[accepted], float(share)))
    return replace(result, warnings=warnings, unexplained=float(share), unexplained_points=points)


def explore(
    scene: Scene,
    part: Part,
    propose: Callable[[Int[np.ndarray, " c"]], Candidates],
    calibration: Calibration,
    config: DetectConfig,
    clock: Clock,
) -> tuple[Candidates, tuple[str, ...]]:
    """Return what is proposed around seeds, round by round until the foreground is covered, and warnings."""
    rounds: list[Candidates] = []
    warnings: tuple[str, ...] = ()
    free, state, reach = scene.foreground, nothing_covered(scene), same_place(part)
    while True:
        with clock("search"):
            rounds.append(propose(seeds_over(scene, free, part, config.later_seeds if rounds else NUM_SEEDS)))
        with clock("coverage"):
            found = rounds[-1]
            probability = np.where(found.usable, calibration.probability(found.evidence), 0)
            likely = probability >= config.likely
            promising = likely | (probability >= config.promising)
            state = cover(state, scene, part, found, likely, promising, reach)
            free = to_search(state, scene, part, config.patience)
        if not free.any():
            break
        if sum(len(found.seed_rows) for found in rounds) >= config.most_seeds:
            left = free.sum() / scene.foreground.sum()
            warnings = (f"{left:.0%} of the foreground was not searched: narrow it down to where the object may be",)
            break
    return join(rounds), warnings


def compile_ahead(
    on_device: DevicePart, cloud: PaddedCloud, image: DepthImage, config: SearchConfig, num_keypoints: int
) -> None:
    """Judge the poses of a crop that has none, and refine, polish and verify some pose: so all of that is compiled."""
    none = no_poses(config.crops, num_keypoints)
    gather_evidence(none, on_device.arrays, on_device.surfels, image, config.agreement)
    pose, row = jax.device_put((np.eye(4, dtype=np.float32), np.int32(0)))
    refine_one(pose, row, jax.random.key(0), on_device, cloud, image, config.crops.smooth, config.agreement)
    polish_one(pose, on_device, image)
    verify_ahead(pose, on_device, image)


def detections(
    found: Candidates, choice: Selection, probability: Float[np.ndarray, " s"], part: Part, scene: Scene
) -> tuple[Detection, ...]:
    """Return the poses that stand as plain records in the scene's frame, in pick order."""
    poses = [
        _detection(row, float(probability[row]), choice, found, part, scene)
        for row in np.flatnonzero(choice.kept).tolist()
    ]
    return tuple(sorted(poses, key=lambda pose: -pose.probability * pose.visible_fraction))


def _detection(
    row: int, probability: float, choice: Selection, found: Candidates, part: Part, scene: Scene
) -> Detection:
    pose = canonical_pose(scene.T_scene_camera @ found.T_camera_object[row].astype(np.float64), part.symmetries)
    shares: dict[str, Any] = {name: float(found.evidence[row, EVIDENCE.index(name)]) for name in _SHARES}
    prediction = crop_prediction(found, row)
    gap = float(choice.gap[row])
    notes = ((_SYMMETRIC, part.is_symmetric), (_RIVALLED, bool(choice.rivalled[row]) and gap < _CLOSE_GAP))
    return Detection(
        T_scene_object=pose,
        probability=probability,
        num_inliers=int(found.num_inliers[row]),
        visible_fraction=1 - shares["occluded"],
        runner_up_gap=gap,
        seed=placed(scene.T_scene_camera, np.asarray(found.found.seed[found.crop[row]])),
        prediction=replace(prediction, points=scene.placed(prediction.points)),
        warnings=tuple(text for text, holds in notes if holds),
        **shares,
    )


def narrowing(evidence: Float[np.ndarray, "a f"], share: float) -> tuple[str, ...]:
    """Return warnings that name how to say where parts are, given the evidence on accepted poses and what is left."""
    flush = int((evidence[:, EVIDENCE.index("coplanar")] > _FLUSH).sum())
    texts = (
        (flush >= _MANY_FLUSH, f"{flush} poses lie flush in a larger surface"),
        (share > _MOST_UNEXPLAINED, f"{share:.0%} of the foreground is on no pose that was found"),
    )
    return tuple(text + _NARROW for holds, text in texts if holds)


def _object_doubt(part: Part, scene: Scene) -> str | None:
    """Say which other unit the part may be in, if its own was assumed."""
    if not part.is_unit_assumed or scene.size is None:
        return None
    return object_doubt(part.in_unit("mm").diameter, scene.size, scene_follows=scene.has_unit_of_part)


def _reason(found: Candidates, part: Part, scene: Scene) -> str:
    """Say why nothing is reported."""
    points = int(scene.foreground.sum())
    if points < _FEW_POINTS:
        return f"only {points} points of the scan may show {part.name}, too few to tell"
    if not found.usable.any():
        places = len(np.unique(found.seed_rows))
        return f"no pose of {part.name} agrees with any of the {places} places that were searched"
    return f"none of the {int(found.usable.sum())} poses that were found is probable: {part.name} may not be there"
