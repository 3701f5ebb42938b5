"""What each stage has to compute and to move, from shapes alone: for floors that no program can beat.

Operations are counted once each (a multiply and an add are two), comparisons of a selection not at all; bytes are
inputs and outputs once, and the tensors of a two-layer EdgeConv block once each way, as its normalisation needs all
of them before any can go on.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from benchmarks.timing import Ceilings
from kmn_jax.models import (
    LATER_PAIR_CHANNELS,
    OBJECT_CHANNELS,
    PAIR_CHANNELS,
    SCENE_CHANNELS,
    KeyMatchNetConfig,
)
from kmn_jax.pose import IcpConfig, MatchConfig, RansacConfig

_FLOAT = 4
_SQUARE = 8.0  # operations of a squared distance in space
_TURN = 18.0  # of a rotated point, or normal
_MATCH = 16.0  # numbers of a match
_RAW = 6  # numbers of a point with its normal


class Work(NamedTuple):
    """Operations and bytes of a stage."""

    flops: float
    moved: float
    matrix: bool = False  # whether nearly all are matrix products, which accelerators have units for

    def __add__(self, other: Work) -> Work:  # type: ignore[override]
        """Do one after the other."""
        return Work(self.flops + other.flops, self.moved + other.moved, self.matrix and other.matrix)

    def times(self, count: float) -> Work:
        """Do it so many times."""
        return Work(count * self.flops, count * self.moved, self.matrix)

    @property
    def intensity(self) -> float:
        """Operations for each byte."""
        return self.flops / self.moved

    def floor_ms(self, ceilings: Ceilings, low_precision: bool = False) -> float:
        """Return the larger of the time to compute and to move; products in bfloat16 if low precision will do."""
        return ceilings.floor_ms(self.flops, self.moved, low_precision and self.matrix)

    def bound(self, ceilings: Ceilings) -> str:
        """Return which of the two it is, in float32."""
        return "arithmetic" if self.flops / ceilings.matmul_flops > self.moved / ceilings.copy_bytes else "memory"


def order_of(points: int, inputs: int) -> Work:
    """Move points and their features into an order, comparisons of the sort not counted; and where each has gone."""
    return Work(0.0, _FLOAT * points * (2.0 * (3 + inputs) + 1))


def neighbors(points: int, width: int, count: int, queries: int | None = None) -> Work:
    """All distances, of which the nearest are kept."""
    queries = queries or points
    distances = (_SQUARE if width == 3 else 2.0 * width) * queries * points
    return Work(distances, _FLOAT * (points * width + queries * count), width > 3)


def edge_conv(points: int, count: int, inputs: int, width: int, depth: int, pairs: int = 0) -> Work:
    """Gather, edge layers and maximum."""
    edges = points * count
    flops = 2.0 * (2 * points * inputs * width + edges * pairs * width) + 2.0 * edges * width
    moved = _FLOAT * (points * (inputs + width) + edges)
    if depth == 2:
        flops, moved = flops + 2.0 * edges * width * width, moved + _FLOAT * 2 * edges * width
    return Work(flops, moved, True)


def global_layers(points: int, local: int, embedding: int, out: int) -> Work:
    """Embed, pool, and the layer on [global ; local]."""
    flops = 2.0 * (points * local * (embedding + out) + embedding * out)
    weights = local * embedding + (embedding + local) * out
    return Work(flops, _FLOAT * (points * (local + out) + weights), True)


def pair_head(points: int, keypoints: int, scene: int, part: int, width: int) -> Work:
    """Two pair layers and both logits."""
    layers = 2.0 * (points * (scene + width + 2) * width + keypoints * 2 * part * width)
    weights = (scene + 2 * part + width) * width
    moved = _FLOAT * (points * (scene + 2 + keypoints) + keypoints * part + weights)
    return Work(layers + 3.0 * points * keypoints * width, moved)


def scene_stages(config: KeyMatchNetConfig, points: int) -> dict[str, Work]:
    """The scene branch and the pair head of a network, in order."""
    inputs, pairs = SCENE_CHANNELS[config.inputs], PAIR_CHANNELS[config.inputs]
    count, width = min(config.num_neighbors, points), config.edge_width
    stages = {
        "order of the points": order_of(points, inputs),
        "kNN on coordinates": neighbors(points, 3, count),
        "EdgeConv 1": edge_conv(points, count, inputs, width, 2, pairs),
        "kNN on features, first": neighbors(points, width, count),
        "EdgeConv 2": edge_conv(points, count, width, width, 2, LATER_PAIR_CHANNELS[config.inputs]),
        "kNN on features, second": neighbors(points, width, count),
        "EdgeConv 3": edge_conv(points, count, width, width, 1),
        "global and output layers": global_layers(points, 3 * width, config.embedding_width, config.scene_width),
        "points as given": Work(0.0, _FLOAT * points * (2.0 * config.scene_width + 1)),
        "pair head": pair_head(
            points, config.num_keypoints, config.scene_width, config.object_width, config.pair_width
        ),
    }
    return {name: work for name, work in stages.items() if config.graph == "dynamic" or "features" not in name}


def object_work(config: KeyMatchNetConfig) -> Work:
    """The object branch: all points in its first block, the neighbours of the keypoints in its second."""
    points, keypoints, width = config.num_object_points, config.num_keypoints, config.edge_width
    inputs, pairs = OBJECT_CHANNELS[config.inputs], PAIR_CHANNELS[config.inputs]
    count = min(config.num_neighbors, points)
    work = order_of(points, inputs) + neighbors(points, 3, count) + edge_conv(points, count, inputs, width, 2, pairs)
    if config.graph == "dynamic":
        work = work + neighbors(points, width, count, keypoints)
    work = (
        work
        + edge_conv(keypoints, count, width, width, 2, LATER_PAIR_CHANNELS[config.inputs])
        + edge_conv(keypoints, 1, width, width, 1)
    )
    return work + global_layers(keypoints, 3 * width, config.embedding_width, config.object_width)


def total(works: Iterable[Work]) -> Work:
    """All stages, one after the other."""
    first, *rest = works
    return sum(rest, start=first)


def drawn_crop(scan: int, drawn: int, kept: int) -> Work:
    """Draw points around a seed and fit planes through all drawn ones around each that is kept."""
    return Work(20.0 * scan + kept * drawn * (_SQUARE + 20), _FLOAT * (4 * scan + 6 * kept))


def matches(points: int, keypoints: int, config: MatchConfig) -> Work:
    """Scores along the keypoints, and the most trusted pairs."""
    return Work(
        6.0 * points * keypoints,
        _FLOAT * (points * (keypoints + 8) + _MATCH * min(config.capacity, points * keypoints)),
    )


def ransac(count: int, modes: int, config: RansacConfig) -> Work:
    """Draw triangles, fit the most congruent, score them against all matches, refine the best."""
    score = 2 * _TURN + 12
    draw, fit = 90.0 * config.num_candidates, 400.0 * config.num_hypotheses
    refine = modes * (config.num_refinements * count * (score + 40) + 20.0 * config.num_hypotheses)
    flops = draw + fit + config.num_hypotheses * count * score + refine
    return Work(flops, _FLOAT * (_MATCH * count + 6 * config.num_candidates + modes * (16 + count)))


def surface_scores(poses: int, surface: int, points: int) -> Work:
    """Compare poses with measured points, from both sides, and with the lines of sight to them."""
    pair = 3 * _SQUARE + 2 * 6
    return Work(poses * surface * points * pair, _FLOAT * (_RAW * (surface + points) + 16 * poses))


def icp(part: int, points: int, config: IcpConfig) -> Work:
    """Pair all points with their nearest, and solve for a motion, as often as allowed."""
    step = _SQUARE * part * points + (2 * _TURN + 90) * points
    return Work(config.iterations * step, _FLOAT * (3 * part + _RAW * points + 16))


def training_step(config: KeyMatchNetConfig, batch: int, crops_per_object: int) -> Work:
    """Forward and backward, which is twice the forward; weights are few. Making the samples is not in it."""
    forward = total(scene_stages(config, config.num_scene_points).values())
    return (forward + object_work(config).times(1 / crops_per_object)).times(3 * batch)
