"""A whole image as a user searches it, for the top of the report: crops alone do not show what comes of a bin."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float

from experiments.bins import LEAST_VISIBLE
from experiments.evaluation.cases import UNIT, ObjectImages
from experiments.evaluation.pictures import Picture
from experiments.evaluation.scores import THRESHOLD, pair_errors
from experiments.evaluation.sources import BopImages
from kmn_jax.bop import BopFrame
from kmn_jax.detection import Detections, PoseEstimator, Scene
from kmn_jax.errors import InputError
from kmn_jax.objects import ObjectModel, Part, make_part
from kmn_jax.viz import save_picture


def whole_bin(objects: Sequence[ObjectImages], weights: str) -> Picture | None:
    """Search the fullest image of the first object of a BOP dataset, and draw it; None if there is no such dataset.

    What cannot be searched is told on stderr, and not drawn.
    """
    for found in objects:
        if not isinstance(found.images, BopImages):
            continue
        key, images = found.images.fullest, found.images
        try:
            frame = images.dataset.frame(*key, masks=True).with_visibility()
            estimator = PoseEstimator.from_pretrained(weights)
            part = make_part(found.model, estimator.model, estimator.digest)
            scene, poses = _searched(estimator, part, frame)
        except InputError as error:
            print(f"no whole bin is drawn: {error}", file=sys.stderr)
            return None
        copies = [one for one in frame.instances or () if one.object_id == images.object_id]
        truth = np.stack([copy.T_camera_object for copy in copies])
        accepted = [pose for pose in poses.poses if pose.probability >= estimator.config.accepted]
        accepted.sort(key=lambda pose: -pose.probability)
        right = num_right(np.array([pose.T_scene_object for pose in accepted]).reshape(-1, 4, 4), truth, found.model)
        visible = [copy.visible_fraction for copy in copies]
        shown = sum(share is not None and share >= LEAST_VISIBLE for share in visible)
        told = "" if None in visible else f"; {shown} copies are visible by {LEAST_VISIBLE:.0%} or more"
        text = (
            f"The image with the most copies of {found.name} (scene {key.scene_id}, image {key.image_id}{told}),"
            " searched whole, as by kmn detect, without being told the truth or the bin: poses of a probability of"
            f" {estimator.config.accepted:g} or more are accepted, and right if their ADI to a copy of their own is"
            " below a tenth of the diameter."
        )
        where = "image" if frame.bin is None else "bin"
        with TemporaryDirectory() as folder:
            target = Path(folder) / "whole_bin.png"
            save_picture(target, scene, part, poses, list(truth))
            return Picture(target.read_bytes(), headline(len(copies), len(accepted), right, where), text)
    return None


def headline(copies: int, accepted: int, right: int, where: str = "bin") -> str:
    """Return in a line how many copies were found, and how many of the accepted poses are wrong."""
    found = f"{right} of {copies} {'copy' if copies == 1 else 'copies'} found in this {where}"
    if accepted == right:
        return f"{found}, all accepted poses right" if right else f"{found}, no pose accepted"
    return f"{found}, {accepted - right} of {accepted} accepted poses wrong"


def num_right(poses: Float[np.ndarray, "s 4 4"], truth: Float[np.ndarray, "i 4 4"], model: ObjectModel) -> int:
    """Return how many poses, the most probable first, are right on a copy that none before them took."""
    if not len(poses):
        return 0
    pairs = np.stack(np.broadcast_arrays(poses[:, None], truth[None]), axis=2).reshape(-1, 2, 4, 4)
    errors = pair_errors(pairs, model).reshape(len(poses), len(truth))
    taken = np.zeros(len(truth), dtype=bool)
    for error in errors:
        free = np.where(taken, np.inf, error)
        if free.min() < THRESHOLD:
            taken[free.argmin()] = True
    return int(taken.sum())


def _searched(estimator: PoseEstimator, part: Part, frame: BopFrame) -> tuple[Scene, Detections]:
    """Search a depth image, of which nothing is given but the camera."""
    camera = frame.camera
    K = (camera.fx, camera.fy, camera.cx, camera.cy)
    scene = estimator.scene(frame.depth, part, K=K, depth_unit=UNIT)
    return scene, estimator.detect(part, scene)
