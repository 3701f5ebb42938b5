"""The estimator of one part as a serialised program that runs without this package, wherever JAX does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import export as jax_export
from jaxtyping import Array, Bool, Float, UInt32

from kmn_jax.checks import InputError
from kmn_jax.data.splat import Intrinsics
from kmn_jax.estimator.candidates import NUM_SEEDS, arrays_of, spread_seeds, surfels_of
from kmn_jax.estimator.estimator import PoseEstimator
from kmn_jax.estimator.evidence import Sight, evidence_of
from kmn_jax.estimator.part import Part
from kmn_jax.estimator.scene import LEAST_POINTS
from kmn_jax.estimator.search import SceneArrays, crop_features, search, seed_keys
from kmn_jax.estimator.select import distances, overlaps, same_place, symmetry_transforms
from kmn_jax.estimator.verify import depth_buffer
from kmn_jax.files import write_whole

PLATFORMS = ("cpu", "cuda")
_SIDE = 512  # pixels along the depth image that is made of the points
_MOST = 2**20


def export_estimator(estimator: PoseEstimator, part: Part, path: str | Path, num_points: int = 65_536) -> int:
    """Write a program that finds a part in scans of up to `num_points` points, and return its bytes' number.

    The file is what `jax.export.deserialize` reads. The program takes points (num_points, 3) in the sensor's frame and
    the part's unit, float32, a mask (num_points,) of which are real and of the foreground, and a key (2,), uint32. It
    returns a dict of arrays with a row for each of s poses: T_scene_object (s, 4, 4), probability, num_inliers, and
    `keep`, true for the poses that stand: the most probable one of each place. It searches in one round, unlike
    `PoseEstimator.detect`. Raises InputError if the number of points is out of range or the file cannot be written.
    """
    if not LEAST_POINTS <= num_points <= _MOST:
        raise InputError(f"points is {num_points}, but must be between {LEAST_POINTS} and {_MOST}")
    arguments = (
        jax.ShapeDtypeStruct((num_points, 3), jnp.float32),
        jax.ShapeDtypeStruct((num_points,), jnp.bool_),
        jax.ShapeDtypeStruct((2,), jnp.uint32),
    )
    exported = jax_export.export(jax.jit(_program(estimator, part)), platforms=PLATFORMS)(*arguments)
    content = bytes(exported.serialize())
    write_whole(path, content)
    return len(content)


def _program(estimator: PoseEstimator, part: Part) -> Callable[..., dict[str, Array]]:
    """Return the search as a function of arrays only; all else is part of the program."""
    model, config = estimator.model, estimator.config
    weights = np.array(estimator.probabilities.found.weights, dtype=np.float32)
    transforms = symmetry_transforms(part.symmetries)
    own, surfels = arrays_of(model, part), surfels_of(part)
    diameter = jnp.float32(part.diameter)
    settings, choice = config.candidates, config.select
    total = NUM_SEEDS * settings.search.num_modes
    first, second = np.triu_indices(total, 1)

    def program(points: Float[Array, "r 3"], mask: Bool[Array, " r"], key: UInt32[Array, " 2"]) -> dict[str, Array]:
        mask = mask & jnp.isfinite(points).all(axis=1) & (points[:, 2] > 0)
        points = jnp.where(mask[:, None], points, 0)
        scene = SceneArrays(points, mask)
        rows, real = spread_seeds(scene, mask, count=NUM_SEEDS)
        crop_keys, pose_keys = seed_keys(jax.random.wrap_key_data(key), NUM_SEEDS)
        crops = crop_features(
            model.graphdef,
            model.parameters,
            scene,
            rows,
            real,
            diameter,
            crop_keys,
            settings.search,
            num_points=model.config.num_scene_points,
        )
        found, said = search(model.graphdef, model.parameters, own, crops, pose_keys, settings.search)
        camera = _fitting_camera(scene)
        sight = Sight(depth_buffer(points, mask, camera, (_SIDE, _SIDE)), camera)
        proof = evidence_of(found, said, crops, own, surfels, sight, settings.verify)
        logits = estimator.probabilities.found.bias + (proof * weights[None, None]).sum(axis=2)
        probability = jnp.where(found.found, jax.nn.sigmoid(logits), 0).reshape(-1)
        usable, poses = found.found.reshape(-1), found.T_scene_object.reshape(-1, 4, 4)
        pairs = jnp.stack([poses[first], poses[second]], axis=1)
        count = choice.num_points
        some = jnp.asarray(part.points[:count])
        apart = distances(pairs, some, jnp.asarray(transforms))
        shared = overlaps(
            pairs, some, jnp.asarray(part.normals[:count]), jnp.sqrt(surfels.area / count), choice.depth * diameter
        )
        shared = (apart <= same_place(part, choice)) | (shared > choice.overlap)
        excluded = jnp.zeros((total, total), dtype=bool).at[first, second].set(shared)
        excluded = excluded | excluded.T

        def take(kept: Bool[Array, " s"], row: Array) -> tuple[Bool[Array, " s"], None]:
            stands = usable[row] & ~(excluded[row] & kept).any()
            return kept.at[row].set(stands), None

        order = jnp.argsort(-probability, stable=True)
        keep, _ = jax.lax.scan(take, jnp.zeros(total, dtype=bool), order)
        return {
            "T_scene_object": poses,
            "probability": probability,
            "num_inliers": found.num_inliers.reshape(-1),
            "keep": keep,
        }

    return program


def _fitting_camera(scene: SceneArrays) -> Intrinsics:
    """Return a camera at the sensor that sees all points."""
    depth = jnp.where(scene.mask, scene.points[:, 2], 1)
    directions = scene.points[:, :2] / depth[:, None]
    low = jnp.where(scene.mask[:, None], directions, jnp.inf).min(axis=0)
    high = jnp.where(scene.mask[:, None], directions, -jnp.inf).max(axis=0)
    some = scene.mask.any()
    low, high = jnp.where(some, low, 0), jnp.where(some, high, 1)
    focal = (_SIDE - 2) / jnp.maximum((high - low).max(), 1e-3)
    side = jnp.float32(_SIDE)
    return Intrinsics(focal, focal, 1 - low[0] * focal, 1 - low[1] * focal, side, side)
