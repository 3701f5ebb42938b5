"""From predictions to recall under both gates, its intervals, and times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from experiments.bins import adi_of_pairs
from experiments.evaluation.configs import noise_name
from experiments.evaluation.predictions import Export, Predictions, Truth
from kmn_jax.objects import ObjectModel

THRESHOLD = 0.1  # of the object's size
_POINTS = 1000  # of an object's surface, for errors
_REACH = 0.8  # diameters: copies whose centres are farther from the pose's are not near enough to be right
_Z = 1.959964  # of a normal distribution's middle 95%


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

    def recall(self, gate: str = "diameter") -> float:
        """Return the share of right poses: ADI below a tenth of the diameter, or of the diagonal."""
        return float(self._right(gate).mean()) if len(self.errors) else float("nan")

    def interval(self, gate: str = "diameter") -> tuple[float, float]:
        """Return Wilson's 95% interval of the recall."""
        return wilson(int(self._right(gate).sum()), len(self.errors))

    def seed_recall(self) -> float:
        """Return the share of poses that are right, within a tenth of the diameter, on the copy the crop is around."""
        return float((self._right("diameter") & self.on_seed).mean()) if len(self.errors) else float("nan")

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
    fields = ("errors", "on_seed", "diagonal", "seconds")
    columns = [np.concatenate([getattr(cell, field) for cell in cells]) for field in fields]
    return Cell(first.method, name, first.noise, *columns)


def cells_of(
    folder: Export, models: Mapping[str, ObjectModel], methods: Mapping[str, str], noises: Sequence[float]
) -> list[Cell]:
    """Score all predictions: each method as it is, and with the refinement that all share."""
    cells = []
    for name, model in models.items():
        for noise in noises:
            truth = folder.truth(name, noise)
            for key, title in methods.items():
                found = folder.read(key, name, noise)
                coarse, refined = (
                    _errors(poses, found, truth, model) for poses in (found.T_camera_object, found.refined)
                )
                size = np.full(len(coarse.errors), model.diagonal / model.diameter)
                cells.append(Cell(title, name, noise, *coarse, size, found.seconds))
                total = found.seconds + found.refine_seconds
                cells.append(Cell(f"{title} + ICP", name, noise, *refined, size, total))
    return cells


class _Errors(NamedTuple):
    errors: Float[np.ndarray, " c"]
    on_seed: Bool[np.ndarray, " c"]


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
    if pairs:
        each, is_own = pair_errors(np.stack(pairs), model), np.array(of_seed)
        np.minimum.at(errors, rows, each)
        np.minimum.at(own, np.array(rows)[is_own], each[is_own])
    return _Errors(errors, np.isfinite(own) & (own <= errors))


def pair_errors(pairs: Float[np.ndarray, "p 2 4 4"], model: ObjectModel) -> Float[np.ndarray, " p"]:
    """Return the ADI of pairs of poses, the second one the true one, in diameters."""
    capacity = 1 << max(len(pairs) - 1, 0).bit_length()
    origin = pairs[:, :1, :3, 3].copy()  # float32 of millimetres far from the camera would lose digits
    near = pairs.copy()
    near[:, :, :3, 3] -= origin
    padded = np.concatenate([near, np.tile(np.eye(4), (capacity - len(pairs), 2, 1, 1))]).astype(np.float32)
    points = jnp.asarray(model.points[:_POINTS], dtype=jnp.float32)
    return np.asarray(adi_of_pairs(padded, points))[: len(pairs)] / model.diameter


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
