"""Poses of different parts exclude each other: where two would stand in one place, the more probable one stays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.detection._frames import placed
from kmn_jax.detection._result import Detections
from kmn_jax.detection._selection import DEPTH, OVERLAP, share_inside
from kmn_jax.geometry import inverse
from kmn_jax.objects import Part
from kmn_jax.programs import compiled_size
from kmn_jax.typing import Normals, Points, Scalar

_POINTS = 512  # on each surface, that are compared
_NEAR = 0.6  # of both diameters together: with centres farther apart than that, parts do not touch

Surface = tuple[Points, Normals, Scalar]  # and how far the points are apart


def apart(found: Sequence[Detections], parts: Sequence[Part]) -> tuple[Detections, ...]:
    """Return the results of several parts without the poses that stand where a more probable one of another part does.

    Lengths of results and parts are in one unit. Of equal probabilities, the part that was named first stays.
    """
    rows = [(number, row) for number, one in enumerate(found) for row in range(len(one.poses))]
    clashes = _clashes(found, parts)
    kept: set[tuple[int, int]] = set()
    for key in sorted(rows, key=lambda key: -found[key[0]].poses[key[1]].probability):
        if not any(other in kept for other in clashes.get(key, ())):
            kept.add(key)
    results = []
    for number, one in enumerate(found):
        poses = tuple(pose for row, pose in enumerate(one.poses) if (number, row) in kept)
        left_out = len(one.poses) - len(poses)
        if left_out:
            text = f"{left_out} of {len(one.poses)} poses were left out, as more probable ones of other parts are there"
            one = replace(
                one,
                poses=poses,
                warnings=(*one.warnings, text) if poses else one.warnings,
                reason=one.reason if poses else text,
            )
        results.append(one)
    return tuple(results)


def _clashes(found: Sequence[Detections], parts: Sequence[Part]) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """Return which poses of other parts each pose cannot stand beside, by numbers of parts and poses."""
    result: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for first, second in combinations(range(len(found)), 2):
        one, other = parts[first], parts[second]
        poses = [np.array([pose.T_scene_object for pose in found[k].poses]).reshape(-1, 4, 4) for k in (first, second)]
        centers = [
            np.array([placed(pose, (part.minimum + part.maximum) / 2) for pose in group]).reshape(-1, 3)
            for part, group in ((one, poses[0]), (other, poses[1]))
        ]
        away = np.linalg.norm(centers[0][:, None] - centers[1][None], axis=2)
        pairs = np.argwhere(away <= _NEAR * (one.diameter + other.diameter))
        if not len(pairs):
            continue
        # In double precision, as the scene's frame may be far away.
        between = np.linalg.inv(poses[1][pairs[:, 1]]) @ poses[0][pairs[:, 0]]
        depth = np.float32(DEPTH * min(one.diameter, other.diameter))
        for row, column in pairs[_overlapping(between, one, other, depth)].tolist():
            result.setdefault((first, row), []).append((second, column))
            result.setdefault((second, column), []).append((first, row))
    return result


def _overlapping(between: Float[np.ndarray, "p 4 4"], one: Part, other: Part, depth: np.float32) -> np.ndarray:
    """Tell of poses `T_other_one` whether the parts overlap."""
    capacity = max(16, compiled_size(len(between)))
    padded = np.concatenate([between, np.tile(np.eye(4), (capacity - len(between), 1, 1))]).astype(np.float32)
    both = _overlaps(padded, np.int32(len(between)), _surface(one), _surface(other), depth)
    return np.asarray(both)[: len(between)]


def _surface(part: Part) -> tuple[np.ndarray, np.ndarray, np.float32]:
    points, normals = part.points[:_POINTS], part.normals[:_POINTS]
    return points, normals, np.float32(np.sqrt(part.area / len(points)))


@jax.jit
def _overlaps(
    between: Float[Array, "p 4 4"], count: Int[Array, ""], one: Surface, other: Surface, depth: Scalar
) -> Bool[Array, " p"]:
    def overlap(pair: tuple[Float[Array, "4 4"], Int[Array, ""]]) -> Bool[Array, ""]:
        T_other_one, row = pair

        def share() -> Scalar:
            inside = share_inside(T_other_one, one[:2], other[:2], other[2], depth)
            return jnp.maximum(inside, share_inside(inverse(T_other_one), other[:2], one[:2], one[2], depth))

        return jax.lax.cond(row < count, share, lambda: jnp.float32(0)) > OVERLAP

    return jax.lax.map(overlap, (between, jnp.arange(len(between))))
