"""Candidates: seeds over the foreground, a pose around each, and what speaks for and against it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int, Key

from kmn_jax.detection._evidence import Sight, evidence_of
from kmn_jax.detection._halves import in_halves
from kmn_jax.detection._improve import ImproveConfig, improve, main_turns
from kmn_jax.detection._result import CropPrediction
from kmn_jax.detection._scene import LEAST_POINTS, Scene, nearest_row, padded_flags
from kmn_jax.detection._search import (
    CropFeatures,
    Hypotheses,
    Predictions,
    SearchConfig,
    crop_features,
    search,
    seed_keys,
)
from kmn_jax.detection._search import spread_seeds as _spread
from kmn_jax.detection._verify import VerifyConfig
from kmn_jax.errors import InputError
from kmn_jax.geometry import intrinsics
from kmn_jax.models import Model
from kmn_jax.objects import Part, arrays_of
from kmn_jax.simulate import Surfels
from kmn_jax.typing import PRNGKey

NUM_SEEDS = 32  # that are searched in one call: one number, so one compilation
_TRIES = 4  # crops around a place that was asked for
_VERIFIED_POINTS = 2048  # on an object's surface
_REMEMBERED = 8  # searches of a scene, of tens of megabytes each
_LENGTH_STEP = 1.02  # parts whose diameters are nearer than that share crops and their features


@dataclass(frozen=True)
class CandidateConfig:
    """How candidates are found; lengths are shares of the object's diameter."""

    search: SearchConfig = field(default_factory=SearchConfig)
    verify: VerifyConfig = field(default_factory=VerifyConfig)
    improve: ImproveConfig = field(default_factory=ImproveConfig)
    most_points: int = 131_072  # of a scan: more are thinned out at random
    seed_spacing: float = 0.4  # seeds are at most about so far apart, as far as there are enough

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        if self.most_points < LEAST_POINTS or not self.seed_spacing > 0:
            raise InputError(
                f"most_points = {self.most_points} must be at least {LEAST_POINTS}, and seed_spacing ="
                f" {self.seed_spacing} above zero"
            )


class Seeds(NamedTuple):
    """Rows of a scene's points, in a compiled number; those that are not real are not searched."""

    rows: Int[Array, " s"]
    real: Bool[Array, " s"]


class Searched(NamedTuple):
    """Crops that were searched, and what the network says of them; arrays on the host."""

    rows: Int[np.ndarray, " c"]  # of the seeds, in the scene's points
    crops: CropFeatures  # without the features
    said: Predictions


class Candidates(NamedTuple):
    """Poses of a part in the view's frame, each with its evidence; arrays on the host, lengths in the scene's unit."""

    T_view_object: Float32[np.ndarray, "s 4 4"]
    usable: Bool[np.ndarray, " s"]  # whether a pose was found
    evidence: Float32[np.ndarray, "s f"]  # see EVIDENCE
    num_inliers: Int[np.ndarray, " s"]
    inlier_share: Float32[np.ndarray, " s"]
    crop: Int[np.ndarray, " s"]  # row of what was searched
    searched: Searched


Solver: TypeAlias = Callable[[Part, Scene, CropFeatures, PRNGKey], tuple[Hypotheses, Predictions]]


def seeds_over(
    scene: Scene, open_points: Bool[np.ndarray, " r"], part: Part, config: CandidateConfig, most: int = NUM_SEEDS
) -> Seeds:
    """Return up to `most` seeds spread over points of the scene, no more than it takes to be near to all of them."""
    flags = padded_flags(open_points, scene.arrays.mask.shape[0])
    cells = np.floor(scene.points[open_points] / (config.seed_spacing * part.diameter)).astype(np.int64)
    rows, real = spread_seeds(scene.arrays, flags, count=NUM_SEEDS)
    return Seeds(rows, real & (np.arange(NUM_SEEDS) < min(most, len(np.unique(cells, axis=0)))))


def seeds_at(scene: Scene, places: Float[np.ndarray, "k 3"]) -> Seeds:
    """Return the points nearest to places in the view's frame, each several times: crops around it are drawn anew."""
    nearest = np.array([nearest_row(scene.points, place) for place in places], dtype=np.int32)
    rows = np.repeat(nearest, _TRIES)
    padding = -len(rows) % NUM_SEEDS
    return Seeds(jnp.asarray(np.pad(rows, (0, padding))), jnp.arange(len(rows) + padding) < len(rows))


def find_candidates(
    model: Model,
    part: Part,
    scene: Scene,
    seeds: Seeds,
    seed: int,
    config: CandidateConfig,
    solver: Solver | None = None,
) -> Candidates:
    """Return a candidate around each seed.

    The part's lengths are in the unit of the scene. The same inputs and `seed` give the same bits on one device.
    `solver` finds poses in crops by other means than the network's.
    """
    key = jax.random.key(seed)
    crop_keys, pose_keys = seed_keys(key, len(seeds.rows))
    crops = _crops(model, part, scene, seeds, crop_keys, seed, config)
    arrays, surfels, sight = arrays_of(model, part), surfels_of(part), sight_of(scene)

    def proof_of(found: Hypotheses, said: Predictions, crops: CropFeatures) -> Float[Array, "s h f"]:
        shown = crops._replace(features=crops.features[:, :, :0])
        return _evidence_of(found, said, shown, arrays, surfels, sight, config=config.verify)

    def poses_in(crops: CropFeatures, keys: Key[Array, " s"]) -> tuple[Hypotheses, Predictions, Float[Array, "s h f"]]:
        found, said = search(model.graphdef, model.parameters, arrays, crops, keys, config.search)
        return found, said, proof_of(found, said, crops)

    if solver is None:
        found, said, proof = in_halves(poses_in, crops, pose_keys)
    else:
        found, said = solver(part, scene, crops, key)
        proof = proof_of(found, said, crops)
    crops = crops._replace(features=crops.features[:, :, :0])
    host: Any = jax.device_get((found, proof, seeds.rows, crops, said))
    real = np.flatnonzero(seeds.real)
    found, proof, *searched = jax.tree.map(lambda leaf: leaf[real], host)
    count, modes = found.found.shape
    flat = jax.tree.map(lambda leaf: leaf.reshape(count * modes, *leaf.shape[2:]), (found, proof))
    return Candidates(
        flat[0].T_scene_object,
        flat[0].found,
        flat[1],
        flat[0].num_inliers,
        flat[0].inlier_share,
        np.repeat(np.arange(count), modes),
        Searched(*searched),
    )


def improved(
    model: Model,
    part: Part,
    scene: Scene,
    found: Candidates,
    chosen: Int[np.ndarray, " k"],
    seed: int,
    config: CandidateConfig,
) -> Candidates:
    """Return some of the candidates refined on all points around them, and turned forms of them that fit as well.

    The first k are the candidates themselves; all have evidence of their own.
    """
    count = len(chosen)
    slots = count + -count % NUM_SEEDS
    rows = np.pad(chosen, (0, slots - count), mode="edge")
    crop = found.crop[rows]
    surfels, sight, arrays = surfels_of(part), sight_of(scene), arrays_of(model, part)
    turns, is_rival = main_turns(part)

    def forms_of(
        poses: Float[Array, "k 4 4"], real: Bool[Array, " k"], seeds: Int[Array, " k"], keys: Key[Array, " k"]
    ) -> tuple[Float[Array, "k a 4 4"], Bool[Array, "k a"]]:
        return improve(
            poses,
            real,
            seeds,
            scene.arrays,
            sight,
            surfels,
            jnp.asarray(turns),
            jnp.asarray(is_rival),
            jnp.float32(part.diameter),
            keys,
            config.improve,
            config.verify,
        )

    poses, there = in_halves(
        forms_of,
        jnp.asarray(found.T_view_object[rows]),
        jnp.arange(slots) < count,
        jnp.asarray(found.searched.rows[crop]),
        jax.random.split(jax.random.key(seed), slots),
    )
    forms = there.shape[1]
    wide = [np.repeat(column[rows, None], forms, axis=1) for column in (found.num_inliers, found.inlier_share)]
    hypotheses = Hypotheses(poses, there, *(jnp.asarray(column) for column in wide))
    crops, said = jax.tree.map(lambda leaf: jnp.asarray(leaf[crop]), (found.searched.crops, found.searched.said))

    def proof_of(found: Hypotheses, said: Predictions, crops: CropFeatures) -> Float[Array, "s h f"]:
        return _evidence_of(found, said, crops, arrays, surfels, sight, config=config.verify)

    proof = in_halves(proof_of, hypotheses, said, crops)
    host: Any = jax.device_get((hypotheses, proof))

    def flat(leaf: np.ndarray) -> np.ndarray:
        return np.swapaxes(leaf[:count], 0, 1).reshape(forms * count, *leaf.shape[2:])

    hypotheses, proof = jax.tree.map(flat, host)
    return Candidates(
        hypotheses.T_scene_object,
        hypotheses.found,
        proof,
        hypotheses.num_inliers,
        hypotheses.inlier_share,
        np.tile(found.crop[chosen], forms),
        found.searched,
    )


def join(parts: list[Candidates]) -> Candidates:
    """Return the candidates of several searches as one."""
    starts = np.cumsum([0, *(len(part.searched.rows) for part in parts)])
    shifted = [part._replace(crop=part.crop + start) for part, start in zip(parts, starts, strict=False)]
    joined: Any = jax.tree.map(lambda *leaves: np.concatenate(leaves), *shifted)
    return cast(Candidates, joined)


def crop_prediction(found: Candidates, row: int) -> CropPrediction:
    """Return what the network says of the crop of a candidate, in the view's frame."""
    crops, said = jax.tree.map(lambda leaf: leaf[found.crop[row]], (found.searched.crops, found.searched.said))
    mask = crops.mask
    return CropPrediction(
        (crops.points + crops.seed)[mask], said.on_object[mask], said.scores.argmax(axis=1).astype(np.int32)[mask]
    )


def _crops(
    model: Model,
    part: Part,
    scene: Scene,
    seeds: Seeds,
    keys: Key[Array, " s"],
    seed: int,
    config: CandidateConfig,
) -> CropFeatures:
    """Return the crops' features, those that the scene remembers if there are any."""
    length = _LENGTH_STEP ** round(np.log(part.diameter) / np.log(_LENGTH_STEP))
    number = model.config.num_scene_points
    name = (
        id(model.parameters),
        np.asarray(seeds.rows).tobytes(),
        np.asarray(seeds.real).tobytes(),
        length,
        seed,
        config.search,
        number,
    )
    if name not in scene.features:
        if len(scene.features) >= _REMEMBERED:
            scene.features.clear()

        def encoded(rows: Int[Array, " s"], real: Bool[Array, " s"], keys: Key[Array, " s"]) -> CropFeatures:
            return crop_features(
                model.graphdef,
                model.parameters,
                scene.arrays,
                rows,
                real,
                jnp.float32(length),
                keys,
                config.search,
                number,
            )

        scene.features[name] = in_halves(encoded, seeds.rows, seeds.real, keys)
    return scene.features[name]


def surfels_of(part: Part) -> Surfels:
    """Return the points of a part that poses are verified with."""
    count = _VERIFIED_POINTS
    return Surfels(jnp.asarray(part.points[:count]), jnp.asarray(part.normals[:count]), jnp.float32(part.area))


def sight_of(scene: Scene) -> Sight:
    """Return the depth image that poses are verified with."""
    return Sight(scene.depth, intrinsics(scene.view.camera))


spread_seeds = jax.jit(_spread, static_argnames="count")
_evidence_of = jax.jit(evidence_of, static_argnames="config")
