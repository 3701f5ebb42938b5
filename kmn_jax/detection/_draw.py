"""One draw of a crop: what the network says of its points, and the poses that it finds, compares and refines."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from kmn_jax.detection._mapping import map_rows
from kmn_jax.errors import InputError
from kmn_jax.geometry import Crop, SmoothConfig, even_rows, spread_rows, with_normals
from kmn_jax.models import KeyMatchNet, KeyMatchNetConfig
from kmn_jax.objects import PartArrays
from kmn_jax.pose import (
    IcpConfig,
    MatchConfig,
    Matches,
    PoseResult,
    RansacConfig,
    SurfaceConfig,
    find_matches,
    icp,
    ransac_modes,
    surface_agreement,
)
from kmn_jax.typing import PRNGKey, Scalar

_NORMAL_RADIUS = 0.06  # diameters, of normals without smoothing
_LEAST_DRAWN = 1024  # points of a draw, ...
_MOST_DRAWS = 4  # ... around a place that is given


@dataclass(frozen=True)
class CropSearchConfig:
    """How poses are found in a crop; lengths are shares of the object's diameter."""

    num_draws: int | None = None  # of points that the network sees, at most; 4 unless given, see `of_network`
    enough: float | None = 0.7  # of a pose's surface score, -1 to 3: then no more draws are made; None: all are made
    give_up: bool = False  # no more draws where the first one has no pose: a few copies fewer, in turn far less time
    side_by_side: bool | None = None  # all draws at once; None: unless JAX runs on a CPU
    num_modes: int = 4  # poses of each draw that are compared with the surface
    num_poses: int = 3  # that are refined and returned: the best ones that differ
    distinct: float = 0.1  # how far apart, somewhere on the surface, poses differ
    num_points: int | None = None  # of a draw; by the network unless given, see `of_network`
    crop_points: int = 4096  # of the crop at least, from which normals are estimated
    smooth: SmoothConfig | None = field(default_factory=SmoothConfig)
    matches: MatchConfig = field(default_factory=lambda: MatchConfig(capacity=1024, least_points=40))
    ransac: RansacConfig = field(
        default_factory=lambda: RansacConfig(num_hypotheses=500, num_candidates=8192, normal_gate_degrees=60.0)
    )
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    surface_points: int = 128  # on the object
    icp: IcpConfig | None = field(default_factory=lambda: IcpConfig(iterations=8))  # None: poses stay as found
    icp_points: int = 256  # of a draw, on the object

    def __post_init__(self) -> None:
        for name in ("num_draws", "num_modes", "num_poses", "surface_points", "icp_points"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)} must be 1 or more")
        if self.enough is not None and not abs(self.enough) < float("inf"):
            raise InputError(f"enough = {self.enough} must be finite; None makes all draws")

    def of_network(self, config: KeyMatchNetConfig) -> CropSearchConfig:
        """Return the same with the numbers of draws and of their points, unless they are given.

        A draw has as many points as the network was trained with, or more: one of 512 finds more in 1,024
        (experiments/RESULTS.md). All over a scene draws are fewer and smaller, see `SearchConfig.of_network`.
        """
        num_points = self.num_points or max(config.num_scene_points, _LEAST_DRAWN)
        return replace(self, num_points=num_points, num_draws=self.num_draws or _MOST_DRAWS)

    @property
    def most_draws(self) -> int:
        """How many draws there are at most. Raises InputError if it is not known, see `of_network`."""
        if self.num_draws is None:
            raise InputError("num_draws is not given: take the config's of_network(model.config)")
        return self.num_draws

    @property
    def points_of_draw(self) -> int:
        """How many points a draw has. Raises InputError if it is not known, see `of_network`."""
        if self.num_points is None:
            raise InputError("num_points is not given: take the config's of_network(model.config)")
        return self.num_points


class Draw(NamedTuple):
    """Some of a crop's points, the seed first, smoothed; with their normals, towards the camera."""

    points: Float[Array, "n 3"]  # relative to the crop's seed as it was measured
    normals: Float[Array, "n 3"]
    mask: Bool[Array, " n"]


class Prediction(NamedTuple):
    """What the network says of the n points of a draw; with a leading axis, of several draws."""

    points: Float[Array, "*d n 3"]  # relative to the crop's seed
    normals: Float[Array, "*d n 3"]
    mask: Bool[Array, "*d n"]
    segmentation: Float[Array, "*d n 2"]
    logits: Float[Array, "*d n k"]

    @property
    def on_object(self) -> Bool[Array, "*d n"]:
        """Which points are taken for the seed's copy."""
        return self.mask & (self.segmentation[..., 1] > self.segmentation[..., 0])


def draw_of_crop(crop: Crop, draw: Int[ArrayLike, ""], diameter: Scalar, config: CropSearchConfig) -> Draw:
    """Return one draw of a crop, evenly over its points.

    Draws share only the seed, unless the points are too few for that: each gets as many as it has room for.
    """
    others = config.points_of_draw - 1
    slots = max(config.most_draws * others, 1)  # of all draws, which lie evenly over the points
    total = jnp.maximum(crop.mask.sum(dtype=jnp.int32) - 1, others)
    slot = jnp.arange(others, dtype=jnp.int32) * config.most_draws + jnp.asarray(draw, dtype=jnp.int32)
    rows = jnp.concatenate([jnp.zeros(1, jnp.int32), 1 + even_rows(slot, total, slots)])
    mask = crop.mask[rows]
    points = jnp.where(mask[:, None], crop.points[rows], 0)
    points, normals = with_normals(
        points, mask, crop.points, crop.mask, -crop.seed, diameter, _NORMAL_RADIUS, config.smooth
    )
    return Draw(points, normals, mask)


def predict(network: KeyMatchNet, part: PartArrays, draw: Draw) -> Prediction:
    """Return what the network says of a draw."""
    points = jnp.where(draw.mask[:, None], draw.points - draw.points[:1], 0)  # as it sees them: from the seed's place
    features = network.encode_scene(jnp.concatenate([points, draw.normals], axis=1), part.diameter, draw.mask)
    return Prediction(*draw, *network.match(features, part.features, draw.mask))


def matches_of(prediction: Prediction, part: PartArrays, config: MatchConfig) -> Matches:
    """Return the matches of a draw, relative to the crop's seed."""
    count = part.features.shape[0]
    return find_matches(
        prediction.segmentation,
        prediction.logits,
        prediction.points,
        prediction.normals,
        part.points[:count],
        part.normals[:count],
        part.diameter,
        prediction.mask,
        config,
    )


def poses_of_draw(
    prediction: Prediction, valid: Bool[Array, ""], part: PartArrays, key: PRNGKey, config: CropSearchConfig
) -> PoseResult:
    """Return the poses that the matches of a draw agree on, (h, ...), relative to the crop's seed."""
    matches = matches_of(prediction, part, config.matches)
    return ransac_modes(key, matches._replace(mask=matches.mask & valid), config.num_modes, config.ransac)


def surface_scores(
    poses: PoseResult, predictions: Prediction, seed: Float[Array, "3"], part: PartArrays, config: CropSearchConfig
) -> Float[Array, " p"]:
    """Return how well the points of all draws that were made confirm each pose; minus infinity where there is none.

    A score is that of `surface_agreement` and the share of matches that agree, -1 to 3 in sum.
    """
    surface = part.points[: config.surface_points], part.normals[: config.surface_points]
    draws = predictions.points, predictions.normals, predictions.mask, predictions.on_object
    points, normals, mask, taken = map(flat, draws)

    def one(pose: PoseResult) -> Scalar:
        def compared() -> Scalar:
            agreement = surface_agreement(
                pose.T_scene_object, *surface, points, normals, mask, taken, -seed, part.diameter, config.surface
            )
            return agreement.score + pose.score

        return jax.lax.cond(pose.converged, compared, lambda: jnp.float32(-jnp.inf))

    return map_rows(one, poses)


def refined(
    pose: Float[Array, "4 4"], prediction: Prediction, part: PartArrays, config: CropSearchConfig
) -> Float[Array, "4 4"]:
    """Return a pose moved onto the points of a draw that are taken for the object."""
    rows, real = spread_rows(prediction.on_object, config.icp_points)
    assert config.icp is not None
    fine = icp(
        part.points,
        prediction.points[rows],
        pose,
        part.diameter,
        scene_normals=prediction.normals[rows],
        scene_mask=real,
        config=config.icp,
    )
    return fine.T_scene_object


def flat(leaf: Shaped[Array, "d n ..."]) -> Shaped[Array, "m ..."]:
    """Return what is of the rows of several draws as one array."""
    return leaf.reshape(-1, *leaf.shape[2:])
