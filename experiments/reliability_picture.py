"""The reliability diagram: how often poses are right, over how probable they were said to be."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from experiments.evaluation.plots import as_png, new_figure
from kmn_jax.detection import reliability
from kmn_jax.files import write_whole

Row = Mapping[str, float]
_MOST_CURVES, _COLUMNS = 4, 5  # in one panel; of panels


def reliability_table(
    probability: Float[np.ndarray, " s"],
    right: Bool[np.ndarray, " s"],
    weights: Float[np.ndarray, " s"] | None = None,
) -> list[Row]:
    """Return rows of mean probability, share of right poses and their number; `weights` count some as several."""
    return [
        {"probability": mean, "share right": share, "poses": count}
        for mean, share, count in reliability(probability, right, weights=weights)
    ]


def save_reliability(tables: Mapping[str, Sequence[Row]], path: Path | None) -> None:
    """Draw tables with the columns `probability`, `share right` and `poses`; without a path, nothing.

    A few are curves in one panel, more have a panel each. Areas of the dots are as the numbers of poses in a panel.
    """
    if path is None:
        return
    panels = [tables] if len(tables) <= _MOST_CURVES else [{name: rows} for name, rows in tables.items()]
    columns = min(len(panels), _COLUMNS)
    figure, canvas = new_figure((5, 5) if columns == 1 else (3 * columns, 3.1 * math.ceil(len(panels) / columns)))
    for number, panel in enumerate(panels, start=1):
        _draw(figure.add_subplot(math.ceil(len(panels) / columns), columns, number), panel)
    write_whole(path, as_png(canvas))


def _draw(axis: Any, tables: Mapping[str, Sequence[Row]]) -> None:
    axis.plot([0, 1], [0, 1], color="grey", lw=1, ls="--", label="as often as said")
    most = max((row["poses"] for rows in tables.values() for row in rows), default=1)
    for name, rows in tables.items():
        said, right = ([row[column] for row in rows] for column in ("probability", "share right"))
        (line,) = axis.plot(said, right, lw=1.2, label=f"{name} ({sum(row['poses'] for row in rows):,} poses)")
        axis.scatter(said, right, [10 + 200 * row["poses"] / most for row in rows], color=line.get_color(), alpha=0.6)
    axis.set(xlabel="probability", ylabel="share right", xlim=(0, 1), ylim=(0, 1.02), aspect="equal")
    axis.legend(loc="upper left", fontsize="small")
    axis.grid(alpha=0.3)
