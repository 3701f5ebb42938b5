"""Rotations that map an object onto itself, found from its geometry.

Such a rotation fixes the centroid of the surface, and its second moments. So an axis of order three or more is a
principal axis whose other two moments are equal, an axis of order two is a principal axis or lies in a plane of equal
moments, and only where all three are equal need every direction be tried.

Rotations near to a symmetry hold too, within the tolerance. What is returned is therefore built as one of the finite
rotation groups (cyclic, dihedral, tetrahedral, octahedral, icosahedral), all of whose members hold.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float

from kmn_jax.errors import InputError

Distance = Callable[[np.ndarray], np.ndarray]  # (n, 3) points to (n,) distances from the surface
_Spin = tuple[np.ndarray, int]  # an axis and its order

_MAX_ORDER = 36
_PRIMES = (2, 3, 5, 7, 11, 13)  # every order tried is a multiple of one of these
_COARSE_POINTS = 256
_FIRST_POINTS = 16  # by which most rotations fail
_NEARLY = 24  # axes that are looked at closely
_MOST_DISTANCES = 4_000_000  # from the surface, after which no more axes are tried: several times what parts take
_LOG = logging.getLogger(__name__)
_SAME_AXIS = np.cos(np.radians(6))
# Angles between neighbouring axes of order 5 in the icosahedral group, 4 in the octahedral, 3 in the tetrahedral one.
_POLYHEDRAL = ((5, np.arctan(2)), (4, np.pi / 2), (3, np.arccos(1 / 3)))


@dataclass(frozen=True, eq=False)
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

    def __str__(self) -> str:
        if len(self.axes):
            return "turns about an axis look the same" if len(self.axes) == 1 else "looks the same from all sides"
        return f"{len(self.rotations)} poses look the same" if len(self.rotations) > 1 else "no symmetry"


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
    listed: one half turn across it, if that is a symmetry. The discrete rotations are the largest group found; an
    order counts only if its rotations fit clearly better than others about the axis.
    Raises InputError for a tolerance outside of (0, 0.2].
    """
    if not 0 < tolerance <= 0.2:
        raise InputError(f"tolerance = {tolerance} must be a share of the diameter above 0 and at most 0.2")
    search = _Search(points, center, distance, float(tolerance * diameter))
    values, vectors = np.linalg.eigh(moments)
    # A rotation that moves no point further than the bound from the surface changes no spread by more.
    spreads = np.sqrt(np.maximum(values, 0))
    equal = [abs(spreads[i] - spreads[j]) <= search.bound for i, j in ((1, 2), (0, 2), (0, 1))]
    isotropic = equal[1]  # the smallest and the largest
    axes = np.concatenate([vectors.T, _sphere_directions(1500)]) if isotropic else vectors.T
    spins: list[_Spin] = []
    for prime in (5, 3, 2) if isotropic else _PRIMES:
        for start in search.nearly(axes, prime) if not search.is_spent else ():
            if search.is_spent:
                break
            if any(abs(start @ axis) > _SAME_AXIS and order % prime == 0 for axis, order in spins):
                continue
            axis = search.refined(start, prime)
            if search.all_hold(_turn(axis, order) for order in range(2, _MAX_ORDER + 1)):
                return search.about_continuous(axis, tolerance)
            order = search.order_about(axis)
            if order > prime:  # the higher order knows the axis better
                finer = search.refined(axis, order)
                axis = finer if search.group_holds(_cyclic(finer, order)) else axis
            if order > 1:
                spins.append((axis, order))
    if not isotropic:
        spins += [(vectors[:, index], 1) for index in range(3) if equal[index]]
    group = search.largest_group(spins)
    if search.is_spent:
        _LOG.warning(
            "the search for symmetries ended after %d million distances, and may have missed some: the object looks"
            " nearly the same from many sides, as a damaged mesh does",
            _MOST_DISTANCES // 1_000_000,
        )
    return Symmetries(group, np.zeros((0, 3)), center, tolerance)


def rotation_about(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """Return the right-handed rotation about a unit axis by an angle in radians."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


class _Search:
    def __init__(
        self, points: Float[np.ndarray, "n 3"], center: Float[np.ndarray, "3"], distance: Distance, bound: float
    ) -> None:
        self.center, self.distance, self.bound = center, distance, bound
        # The outermost points tell most rotations apart, whatever their number.
        order = np.argsort(-np.linalg.norm(points - center, axis=1), kind="stable")
        self.points = (points - center)[order]
        self.coarse = np.concatenate([self.points[:_COARSE_POINTS], self.points[:: max(1, len(order) // 256)]])
        self.spent = 0  # distances

    @property
    def is_spent(self) -> bool:
        """Whether no more axes are tried."""
        return self.spent > _MOST_DISTANCES

    def deviations(
        self, rotations: Float[np.ndarray, "r 3 3"], points: Float[np.ndarray, "n 3"], most: float = np.inf
    ) -> Float[np.ndarray, " r"]:
        """Return how far each rotation moves points from the surface; of more than `most`, only that it is more."""
        result, start, step = np.zeros(len(rotations)), 0, _FIRST_POINTS
        while start < len(points) and (result <= most).any():
            left = np.flatnonzero(result <= most)
            turned = points[start : start + step] @ rotations[left].transpose(0, 2, 1) + self.center
            self.spent += turned.size // 3
            found = self.distance(turned.reshape(-1, 3)).reshape(len(left), turned.shape[1])
            result[left] = np.maximum(result[left], found.max(axis=1, initial=0))
            start, step = start + step, 4 * step
        return result

    def all_hold(self, rotations: Iterable[Float[np.ndarray, "3 3"]]) -> bool:
        return all(
            self.deviations(rotation[None], points, self.bound)[0] <= self.bound
            for rotation in rotations
            for points in (self.coarse, self.points)
        )

    def group_holds(self, group: Float[np.ndarray, "s 3 3"]) -> bool:
        middle = len(group) // 2  # about an axis, the rotation by about half a turn tells most
        return self.all_hold((*group[middle:], *group[1:middle]))

    def order_about(self, axis: Float[np.ndarray, "3"]) -> int:
        """Return the largest order whose rotations all hold, and fit clearly better than any others about the axis.

        On an axis that is nearly continuous, rotations in between the true ones hold now and then too; those that make
        a group of a wrong order come at least two thirds of the way to the worst one.
        """
        limit = None
        for order in range(_MAX_ORDER, 1, -1):
            group = _cyclic(axis, order)
            if not self.group_holds(group):
                continue
            if limit is None:
                some = np.stack([rotation_about(axis, angle) for angle in np.radians(np.arange(5, 181, 5))])
                limit = 0.6 * float(self.deviations(some, self.coarse).max())
            if self.deviations(group, self.coarse, limit).max() <= limit:
                return order
        return 1

    def about_continuous(self, axis: Float[np.ndarray, "3"], tolerance: float) -> Symmetries:
        """Return the symmetries of a body of revolution: about its axis, maybe turned over, maybe a sphere."""
        across = _across(axis)[0]
        turned_over = [_turn(across, 2)] if self.all_hold([_turn(across, 2)]) else []
        if turned_over and self.all_hold(rotation_about(across, angle) for angle in (0.4, 1.1, 2.0)):
            return Symmetries(np.eye(3)[None], np.eye(3), self.center, tolerance)
        return Symmetries(np.stack([np.eye(3), *turned_over]), axis[None], self.center, tolerance)

    def nearly(self, axes: Float[np.ndarray, "a 3"], order: int) -> Float[np.ndarray, "b 3"]:
        """Return the axes whose rotation of this order comes near to a symmetry, the nearest ones, in order.

        Near is three times the tolerance: a grid of directions misses an axis by about two degrees, which moves the
        outermost points by 3% of the size.
        """
        most = 3 * self.bound
        turns = np.stack([_turn(axis, order) for axis in axes])
        few = self.deviations(turns, self.coarse[:: len(self.coarse) // 32], most)
        ranked = np.argsort(few, kind="stable")[: (few <= most).sum()]
        # The best of the few points first: what deviates by more than the 24th so far need not be known exactly.
        kept = np.zeros(0, dtype=np.int64)
        deviations = np.zeros(0)
        for start in range(0, len(ranked), 2 * _NEARLY):
            some = ranked[start : start + 2 * _NEARLY]
            kept = np.concatenate([kept, some])
            deviations = np.concatenate([deviations, self.deviations(turns[some], self.coarse, most)])
            best = np.argsort(deviations, kind="stable")[: min(_NEARLY, int((deviations <= most).sum()))]
            kept, deviations = kept[best], deviations[best]
            if len(best) == _NEARLY:
                most = float(deviations[-1])
        return axes[kept]

    def refined(
        self, axis: Float[np.ndarray, "3"], order: int, about: Float[np.ndarray, "3"] | None = None
    ) -> Float[np.ndarray, "3"]:
        """Turn an axis, in any way or only about another one, to where its rotation fits best, by halving steps."""
        distances = self.distance(self.coarse @ _turn(axis, order).T + self.center)
        points = self.coarse[np.argsort(-distances)]  # those that fit worst tell most of what is near, too
        best, step = float(distances.max()), np.radians(1.5)
        self.spent += len(points)
        while step > np.radians(0.02):
            sides = _across(axis) if about is None else (np.cross(about, axis),)
            trials = [axis + step * way for side in sides for way in (side, -side)]
            trials = [trial / np.linalg.norm(trial) for trial in trials]
            scores = self.deviations(np.stack([_turn(trial, order) for trial in trials]), points, best)
            if scores.min() < best:
                best, axis = float(scores.min()), trials[int(scores.argmin())]
            else:
                step /= 2
        return axis

    def largest_group(self, spins: list[_Spin]) -> Float[np.ndarray, "s 3 3"]:
        """Return the largest group, all of whose members hold, to which axes and their orders lead."""
        for order, angle in _POLYHEDRAL:
            axes = [axis for axis, multiple in spins if multiple % order == 0]
            for first, second in combinations(axes, 2):
                second = second if first @ second > 0 else -second
                if abs(np.arccos(min(1.0, float(first @ second))) - angle) < np.radians(6):
                    group = _polyhedral(first, second, order, angle)
                    if self.group_holds(group):
                        return group
        best = np.eye(3)[None]
        for axis, order in sorted(spins, key=lambda spin: -spin[1]):
            if 2 * order <= len(best):
                break
            if self.is_spent:
                best = _cyclic(axis, order) if order > len(best) else best
                break
            if order > len(best):
                best = _cyclic(axis, order)
            others = [other for other, _ in spins if abs(other @ axis) < 0.1]
            first, second = _across(axis)
            angles = np.radians(np.arange(180))[:, None]  # half a turn suffices, as axes have no sign
            for way in self.nearly(np.stack([*others, *(np.cos(angles) * first + np.sin(angles) * second)]), 2):
                way = way - way @ axis * axis
                turn = _turn(self.refined(way / np.linalg.norm(way), 2, about=axis), 2)
                dihedral = np.concatenate([_cyclic(axis, order), turn @ _cyclic(axis, order)])
                if self.group_holds(dihedral):
                    best = dihedral
                    break
        return best


def _turn(axis: Float[np.ndarray, "3"], order: int) -> Float[np.ndarray, "3 3"]:
    return rotation_about(axis, 2 * np.pi / order)


def _cyclic(axis: Float[np.ndarray, "3"], order: int) -> Float[np.ndarray, "s 3 3"]:
    return np.stack([rotation_about(axis, 2 * np.pi * index / order) for index in range(order)])


def _polyhedral(
    first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"], order: int, angle: float
) -> Float[np.ndarray, "s 3 3"]:
    """Return the group that two axes span, the second one moved to the exact angle from the first."""
    across = second - second @ first * first
    second = np.cos(angle) * first + np.sin(angle) * across / np.linalg.norm(across)
    generators = [_turn(first, order), _turn(second, order)]
    group = [np.eye(3)]
    for member in group:  # which grows
        for product in (member @ generator for generator in generators):
            if np.einsum("nij,ij->n", np.stack(group), product).max() < 2.9:  # 3 for equal ones, 2.6 for neighbours
                group.append(product)
    return np.stack(group)


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
