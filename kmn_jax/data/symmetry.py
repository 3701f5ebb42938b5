"""Rotations that map an object onto itself, found from its geometry.

Such a rotation fixes the centroid of the surface, and its second moments. So an axis of order three or more is a
principal axis whose other two moments are equal, an axis of order two is a principal axis or lies in a plane of equal
moments, and only where all three are equal need every direction be tried.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from kmn_jax.checks import InputError

Distance = Callable[[np.ndarray], np.ndarray]  # (n, 3) points to (n,) distances from the surface

_MAX_ORDER = 36
_PRIMES = (2, 3, 5, 7, 11, 13)  # every order tried is a multiple of one of these
_SAME_MOMENT = 0.03  # two moments this close, relative to the largest, may belong to equal ones
_COARSE_POINTS = 256


@dataclass(frozen=True)
class Symmetries:
    """Rotational symmetries of an object, in its frame and unit; all rotations are about `center`."""

    rotations: Float[np.ndarray, "s 3 3"]  # discrete ones, the identity first
    axes: Float[np.ndarray, "c 3"]  # unit directions about which every angle is a symmetry
    center: Float[np.ndarray, "3"]
    tolerance: float  # largest distance of a rotated surface point from the surface, a share of the diameter

    @property
    def transforms(self) -> Float[np.ndarray, "s 4 4"]:
        """The discrete symmetries as poses `T_object_object`."""
        result = np.tile(np.eye(4), (len(self.rotations), 1, 1))
        result[:, :3, :3] = self.rotations
        result[:, :3, 3] = self.center - self.rotations @ self.center
        return result


def find_symmetries(
    points: Float[np.ndarray, "n 3"],
    center: Float[np.ndarray, "3"],
    moments: Float[np.ndarray, "3 3"],
    distance: Distance,
    diameter: float,
    tolerance: float = 0.02,
) -> Symmetries:
    """Return the rotations under which every surface point stays within `tolerance` diameters of the surface.

    `center` and `moments` are the surface's area centroid and covariance, `points` lie on it, `distance` returns
    the distances of points from it. Orders up to 36 are tried; an axis that passes them all is continuous, one
    that fails some is not, however fine its teeth. With a continuous axis only rotations that are not about it are
    listed: one half turn across it, if that is a symmetry. Raises InputError for a tolerance outside of (0, 0.2].
    """
    if not 0 < tolerance <= 0.2:
        raise InputError(f"tolerance = {tolerance} must be a share of the diameter above 0 and at most 0.2")
    search = _Search(points, center, distance, tolerance * diameter)
    values, vectors = np.linalg.eigh(moments)
    equal = [abs(values[i] - values[j]) <= _SAME_MOMENT * values.max() for i, j in ((1, 2), (0, 2), (0, 1))]
    isotropic = equal[1] or (equal[0] and equal[2])  # smallest and largest alike: all three are
    axes = _sphere_directions(1500) if isotropic else vectors.T
    generators: list[np.ndarray] = []
    for prime in (2, 3, 5) if isotropic else _PRIMES:
        for axis in search.nearly(axes, prime):
            axis = search.refined(axis, prime)
            multiples = range(prime, _MAX_ORDER + 1, prime)
            orders = [order for order in multiples if search.holds(rotation_about(axis, 2 * np.pi / order))]
            if len(orders) == len(multiples):
                return search.continuous(axis, tolerance)
            generators += [rotation_about(axis, 2 * np.pi / order) for order in orders]
    if not isotropic:
        for axis in (vectors[:, index] for index in range(3) if equal[index]):
            half_turns = (_half_turn(search.refined(way, 2)) for way in search.nearly(_around(axis, 180), 2))
            generators += next(([turn] for turn in half_turns if search.holds(turn)), [])
    return Symmetries(search.closed(generators), np.zeros((0, 3)), center, tolerance)


def rotation_about(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """Return the right-handed rotation about a unit axis by an angle in radians."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


class _Search:
    def __init__(
        self, points: Float[np.ndarray, "n 3"], center: Float[np.ndarray, "3"], distance: Distance, bound: float
    ) -> None:
        self.points, self.center, self.distance, self.bound = points - center, center, distance, bound
        # The outermost points tell most rotations apart, whatever their number.
        order = np.argsort(-np.linalg.norm(self.points, axis=1), kind="stable")
        self.coarse = self.points[np.concatenate([order[:_COARSE_POINTS], order[:: max(1, len(order) // 256)]])]

    def deviation(self, rotation: Float[np.ndarray, "3 3"], points: Float[np.ndarray, "n 3"] | None = None) -> float:
        points = self.points if points is None else points
        return float(self.distance(points @ rotation.T + self.center).max())

    def holds(self, rotation: Float[np.ndarray, "3 3"]) -> bool:
        return self.deviation(rotation, self.coarse) <= self.bound and self.deviation(rotation) <= self.bound

    def continuous(self, axis: Float[np.ndarray, "3"], tolerance: float) -> Symmetries:
        """Return the symmetries of a body of revolution: about its axis, maybe turned over, maybe a sphere."""
        across = _across(axis)[0]
        turned_over = [_half_turn(across)] if self.holds(_half_turn(across)) else []
        if turned_over and all(self.holds(rotation_about(across, angle)) for angle in (0.4, 1.1, 2.0)):
            return Symmetries(np.eye(3)[None], np.eye(3), self.center, tolerance)
        return Symmetries(np.stack([np.eye(3), *turned_over]), axis[None], self.center, tolerance)

    def nearly(self, axes: Float[np.ndarray, "a 3"], order: int) -> Float[np.ndarray, "b 3"]:
        """Return the axes whose rotation of this order comes near to a symmetry, the 24 nearest at most, in order.

        Near is three times the tolerance: a grid of directions misses an axis by about two degrees, which moves the
        outermost points by 3% of the size.
        """
        for points in (self.coarse[:: len(self.coarse) // 32], self.coarse):
            turned = [points @ rotation_about(axis, 2 * np.pi / order).T + self.center for axis in axes]
            if turned:
                deviations = self.distance(np.concatenate(turned)).reshape(len(axes), -1).max(axis=1)
                axes = axes[np.argsort(deviations, kind="stable")[: (deviations <= 3 * self.bound).sum()]]
        return axes[:24]

    def refined(self, axis: Float[np.ndarray, "3"], order: int) -> Float[np.ndarray, "3"]:
        """Turn an axis to where its rotation fits the surface best, by halving steps across it."""
        best, step = self.deviation(rotation_about(axis, 2 * np.pi / order), self.coarse), np.radians(1.5)
        while step > np.radians(0.05):
            trials = [axis + step * way for side in _across(axis) for way in (side, -side)]
            trials = [trial / np.linalg.norm(trial) for trial in trials]
            scores = [self.deviation(rotation_about(trial, 2 * np.pi / order), self.coarse) for trial in trials]
            if min(scores) < best:
                best, axis = min(scores), trials[int(np.argmin(scores))]
            else:
                step /= 2
        return axis

    def closed(self, generators: list[Float[np.ndarray, "3 3"]]) -> Float[np.ndarray, "s 3 3"]:
        """Return the group that generators span, as far as each member holds on the geometry."""
        group = [np.eye(3)]
        for generator in generators:
            if not _contains(group, generator):
                group.append(generator)
        index = 1
        while index < len(group) and len(group) <= 120:  # the icosahedron has 60 rotations, a fine wheel 72
            for other in group[1 : index + 1]:
                for product in (group[index] @ other, other @ group[index]):
                    if not _contains(group, product) and self.holds(product):
                        group.append(product)
            index += 1
        return np.stack(group)


def _half_turn(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    return 2 * np.outer(axis, axis) - np.eye(3)


def _contains(group: list[Float[np.ndarray, "3 3"]], rotation: Float[np.ndarray, "3 3"]) -> bool:
    # trace(A B^T) = 1 + 2 cos(angle between them): below 5 degrees they are the same, up to the tolerance
    limit = 1 + 2 * np.cos(np.radians(5))
    return bool((np.einsum("nij,ij->n", np.stack(group), rotation) > limit).any())


def _around(axis: Float[np.ndarray, "3"], count: int) -> Float[np.ndarray, "n 3"]:
    """Return directions across an axis; half a turn of them suffices, as axes have no sign."""
    first, second = _across(axis)
    angles = np.pi * np.arange(count) / count
    return np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second


def _across(axis: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return two unit directions that with a unit axis are right-handed."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def _sphere_directions(count: int) -> Float[np.ndarray, "n 3"]:
    """Return evenly spread directions on a half sphere, the coordinate axes first."""
    index = np.arange(count) + 0.5
    height, angle = 1 - index / count, np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - height**2)
    spread = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    return np.concatenate([np.eye(3), spread])
