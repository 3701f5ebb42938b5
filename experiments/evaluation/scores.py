"""From predictions to recall under both gates, its intervals, how exact right poses are, and times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Shaped

from experiments.bins import adi_of_pairs, mssd_of_pairs, padded
from experiments.evaluation.configs import noise_name
from experiments.evaluation.predictions import Export, Predictions, Truth
from kmn_jax.detection import symmetry_transforms
from kmn_jax.objects import ObjectModel
from kmn_jax.pose import average_recall, symmetric_pose_error

THRESHOLD = 0.1  # of the object's size
_POINTS = 1000  # of an object's surface, for errors
_REACH = 0.8  # diameters: copies whose centres are farther from the pose's are not near enough to be right
_Z = 1.959964  # of a normal distribution's middle 95%


class Offsets(NamedTuple):
    """By how much each pose is off the nearest copy, symmetries taken out; infinite where no pose was found."""

    degrees: Float[np.ndarray, " c"]
    millimetres: Float[np.ndarray, " c"]  # between the object's centres
    shares: Float[np.ndarray, " c"]  # the same in diameters
    mssd: Float[np.ndarray, " c"]  # in diameters


@dataclass(frozen=True)
class Cell:
    """One method on one object at one noise, or on several together."""

    method: str
    object: str
    noise: float
    errors: Float[np.ndarray, " c"]  # ADI to the nearest copy, in diameters; infinite where no pose was found
    on_seed: Bool[np.ndarray, " c"]  # whether that copy is the one that the crop is around
    diagonal: Float[np.ndarray, " c"]  # of the object's bounding box, in diameters
    seconds: Float[np.ndarray, " c"]
    scenes: Shaped[np.ndarray, " c"]  # what crops of one scan share
    offsets: Offsets | None = None

    def recall(self, gate: str = "diameter") -> float:
        """Return the share of right poses: ADI below a tenth of the diameter, or of the diagonal."""
        return float(self._right(gate).mean()) if len(self.errors) else float("nan")

    def interval(self, gate: str = "diameter") -> tuple[float, float]:
        """Return Wilson's 95% interval of the recall."""
        return wilson(int(self._right(gate).sum()), len(self.errors))

    def seed_recall(self) -> float:
        """Return the share of poses that are right, within a tenth of the diameter, on the copy the crop is around."""
        return float((self._right("diameter") & self.on_seed).mean()) if len(self.errors) else float("nan")

    def ahead_of(self, other: Cell, gate: str = "diameter") -> tuple[float, float, float]:
        """Return by how much recall is higher than another method's on the same crops, with its 95% interval.

        Crops of one scan may go wrong together: the interval is that of sums over scans, which are independent
        (cluster-robust, normal). Of a single scan nothing can be said.
        """
        apart = self._right(gate).astype(float) - other._right(gate)
        scans, scan = np.unique(self.scenes, return_inverse=True)
        if len(scans) < 2:
            return float(apart.mean()) if len(apart) else 0.0, -1.0, 1.0
        sums = np.bincount(scan, apart - apart.mean())
        half = _Z * float(np.sqrt((sums**2).sum() * len(sums) / (len(sums) - 1))) / len(apart)
        return float(apart.mean()), float(apart.mean()) - half, float(apart.mean()) + half

    def _right(self, gate: str) -> np.ndarray:
        size = self.diagonal if gate == "diagonal" else np.ones_like(self.errors)
        return self.errors < THRESHOLD * size


def wilson(right: int, total: int) -> tuple[float, float]:
    """Return the 95% interval of a share after so many trials (Wilson, 1927); (0, 1) without any."""
    if total == 0:
        return 0.0, 1.0
    share, spread = right / total, _Z**2 / total
    middle = (share + spread / 2) / (1 + spread)
    half = _Z * np.sqrt(share * (1 - share) / total + spread / (4 * total)) / (1 + spread)
    # The share itself is inside, whatever rounding does at 0 and 1.
    return max(min(float(middle - half), share), 0.0), min(max(float(middle + half), share), 1.0)


def pooled(cells: Sequence[Cell], name: str) -> Cell:
    """Return cells of one method and noise as one."""
    first = cells[0]
    fields = ("errors", "on_seed", "diagonal", "seconds", "scenes")
    columns = {field: np.concatenate([getattr(cell, field) for cell in cells]) for field in fields}
    offsets = [cell.offsets for cell in cells if cell.offsets is not None]
    together = Offsets(*map(np.concatenate, zip(*offsets, strict=True))) if len(offsets) == len(cells) else None
    return Cell(first.method, name, first.noise, **columns, offsets=together)


def cells_of(
    folder: Export, models: Mapping[str, ObjectModel], methods: Mapping[str, str], noises: Sequence[float]
) -> list[Cell]:
    """Score all predictions: each method as it is, and with the refinement that all share."""
    cells = []
    for name, model in models.items():
        for noise in noises:
            truth = folder.truth(name, noise)
            scenes = np.array([f"{name}/{case.rpartition('/')[0]}" for case in truth.names], dtype=np.str_)
            for key, title in methods.items():
                found = folder.read(key, name, noise)
                coarse, refined = (
                    _errors(poses, found, truth, model) for poses in (found.T_camera_object, found.refined)
                )
                size = np.full(len(coarse.errors), model.diagonal / model.diameter)
                total = found.seconds + found.refine_seconds
                for text, scored, seconds in ((title, coarse, found.seconds), (f"{title} + ICP", refined, total)):
                    cells.append(
                        Cell(text, name, noise, scored.errors, scored.on_seed, size, seconds, scenes, scored.offsets)
                    )
    return cells


class _Errors(NamedTuple):
    errors: Float[np.ndarray, " c"]
    on_seed: Bool[np.ndarray, " c"]
    offsets: Offsets


def _errors(poses: Float[np.ndarray, "c 4 4"], found: Predictions, truth: Truth, model: ObjectModel) -> _Errors:
    """Return the ADI of each pose to the nearest copy of its scan, in diameters, and whether that is the seed's."""
    middle = np.append((model.minimum + model.maximum) / 2, 1)
    pairs: list[np.ndarray] = []
    rows: list[int] = []
    of_seed: list[bool] = []
    for row, (pose, copies, seed) in enumerate(zip(poses, truth.T_camera_object, truth.copy, strict=True)):
        if not found.found[row]:
            continue
        away = np.linalg.norm((copies @ middle - pose @ middle)[:, :3], axis=1)
        near = np.flatnonzero(away <= _REACH * model.diameter).tolist()
        pairs += [np.stack([pose, copies[copy]]) for copy in near]
        rows += [row] * len(near)
        of_seed += [copy == seed for copy in near]
    errors, own = np.full(len(poses), np.inf), np.full(len(poses), np.inf)
    offsets = Offsets(*np.full((4, len(poses)), np.inf))
    if pairs:
        each, is_own = pair_errors(np.stack(pairs), model), np.array(of_seed)
        np.minimum.at(errors, rows, each)
        np.minimum.at(own, np.array(rows)[is_own], each[is_own])
        nearest = {row: number for number, row in enumerate(rows) if each[number] <= errors[row]}
        found_rows = list(nearest)
        for column, values in zip(
            offsets, _offsets(np.stack([pairs[k] for k in nearest.values()]), model), strict=True
        ):
            column[found_rows] = values
    return _Errors(errors, np.isfinite(own) & (own <= errors), offsets)


def _offsets(pairs: Float[np.ndarray, "p 2 4 4"], model: ObjectModel) -> Offsets:
    """Return by how much the first one of pairs of poses is off the second, true one."""
    near, points = padded(pairs), jnp.asarray(model.points[:_POINTS], dtype=jnp.float32)
    own = model.symmetries
    symmetries = [jnp.asarray(value, dtype=jnp.float32) for value in (own.rotations, own.axes, own.center)]
    turned, shifted = (np.asarray(value)[: len(pairs)] for value in _turned_and_shifted(near, *symmetries))
    largest = np.asarray(mssd_of_pairs(near, points, jnp.asarray(symmetry_transforms(own))))[: len(pairs)]
    return Offsets(np.degrees(turned), shifted, shifted / model.diameter, largest / model.diameter)


@jax.jit
def _turned_and_shifted(pairs: jax.Array, *symmetries: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jax.lax.map(lambda pair: symmetric_pose_error(pair[0], pair[1], *symmetries), pairs)


def pair_errors(pairs: Float[np.ndarray, "p 2 4 4"], model: ObjectModel) -> Float[np.ndarray, " p"]:
    """Return the ADI of pairs of poses, the second one the true one, in diameters."""
    points = jnp.asarray(model.points[:_POINTS], dtype=jnp.float32)
    return np.asarray(adi_of_pairs(padded(pairs), points))[: len(pairs)] / model.diameter


def recall_rows(cells: Sequence[Cell], objects: str) -> list[dict[str, Any]]:
    """Return a table's rows: for each method, the recall of all objects together at each noise, and times."""
    rows = []
    for method, own in _by_method(cells).items():
        row: dict[str, Any] = {"method": method}
        for noise, whole in _by_noise(own, objects).items():
            row[noise_name(noise)] = cell_text(whole, "diameter")
            row[f"{noise_name(noise)}, by diagonal"] = f"{whole.recall('diagonal'):.2f}"
        everything = np.concatenate([cell.seconds for cell in own])
        row["mean ms"] = float(everything.mean() * 1e3) if len(everything) else None
        row["median ms"] = float(np.median(everything) * 1e3) if len(everything) else None
        row["crops"] = len(everything)
        rows.append(row)
    return rows


def paired_rows(cells: Sequence[Cell], own: str) -> list[dict[str, Any]]:
    """Return a table's rows: for each other method, by how much our own finds more of the same crops."""
    by_method = {method: _by_noise(those, "") for method, those in _by_method(cells).items()}
    ours = by_method.pop(own)
    rows = []
    for method, whole in by_method.items():
        row: dict[str, Any] = {"method": method}
        for noise, theirs in whole.items():
            for gate, name in (("diameter", noise_name(noise)), ("diagonal", f"{noise_name(noise)}, by diagonal")):
                ahead, low, high = ours[noise].ahead_of(theirs, gate)
                row[name] = f"{ahead:+.3f} ({low:+.3f} to {high:+.3f})"
        rows.append(row)
    return rows


def accuracy_rows(cells: Sequence[Cell], noise: float) -> list[dict[str, Any]]:
    """Return a table's rows at one noise: for each method, how exact right poses are, and its recall by MSSD."""
    rows = []
    for method, own in _by_method(cells).items():
        whole = _by_noise([cell for cell in own if cell.noise == noise], "").get(noise)
        if whole is None or whole.offsets is None or not len(whole.errors):
            continue
        right = whole.errors < THRESHOLD
        off = whole.offsets
        rows.append(
            {
                "method": method,
                "shifted, mm": _median_and_most(off.millimetres[right]),
                "shifted, % of the diameter": _median_and_most(100 * off.shares[right]),
                "turned, degrees": _median_and_most(off.degrees[right]),
                "MSSD recall": f"{(off.mssd < THRESHOLD).mean():.2f}",
                "MSSD recall, BOP": f"{average_recall(off.mssd.astype(np.float32)):.2f}",
            }
        )
    return rows


def _median_and_most(values: Float[np.ndarray, " n"]) -> str:
    """Return the median and the 90th percentile as text."""
    return " / ".join(f"{np.percentile(values, share):.3g}" for share in (50, 90)) if len(values) else "-"


def seed_rows(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Return a table's rows: for each method, right poses of the very copies that the crops are around."""
    return [
        {"method": method}
        | {noise_name(noise): f"{whole.seed_recall():.2f}" for noise, whole in _by_noise(own, "").items()}
        for method, own in _by_method(cells).items()
    ]


def object_rows(cells: Sequence[Cell], noise: float) -> list[dict[str, Any]]:
    """Return a table's rows: for each method, the recall of each object at one noise."""
    return [
        {"method": method} | {cell.object: cell_text(cell, "diameter") for cell in own if cell.noise == noise}
        for method, own in _by_method(cells).items()
    ]


def _by_method(cells: Sequence[Cell]) -> dict[str, list[Cell]]:
    return {
        method: [cell for cell in cells if cell.method == method]
        for method in dict.fromkeys(cell.method for cell in cells)
    }


def _by_noise(cells: Sequence[Cell], name: str) -> dict[float, Cell]:
    """Return the cells of one method, pooled over objects."""
    noises = dict.fromkeys(cell.noise for cell in cells)
    return {noise: pooled([cell for cell in cells if cell.noise == noise], name) for noise in noises}


def cell_text(cell: Cell, gate: str) -> str:
    """Return a recall with its interval, in two digits."""
    low, high = cell.interval(gate)
    return f"{cell.recall(gate):.2f} ({low:.2f}-{high:.2f})"
