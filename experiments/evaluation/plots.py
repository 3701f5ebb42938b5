"""Recall over noise and over time."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.evaluation.configs import noise_name
from experiments.evaluation.scores import Cell, pooled
from kmn_jax.checks import InputError


def recall_plot(cells: Sequence[Cell], noises: Sequence[float]) -> bytes:
    """Return a PNG: recall of all objects over noise, with intervals, and over the mean time without noise."""
    figure, canvas = new_figure((12, 4.8))  # with one clear error if there is no matplotlib
    from matplotlib import ticker

    over_noise, over_time = figure.subplots(1, 2)
    for number, method in enumerate(dict.fromkeys(cell.method for cell in cells)):
        own = [pooled([c for c in cells if c.method == method and c.noise == noise], "all") for noise in noises]
        recall = np.array([cell.recall() for cell in own])
        low, high = np.array([cell.interval() for cell in own]).T
        style = {"color": f"C{number // 2 % 10}", "ls": "-" if method.endswith("ICP") else ":", "marker": "o", "ms": 4}
        shift = 1 + 0.01 * number
        places = [100 * noise * shift for noise in noises]
        over_noise.errorbar(places, recall, [recall - low, high - recall], label=method, lw=1.2, capsize=2, **style)
        seconds = np.concatenate([cell.seconds for cell in own])
        if len(seconds):
            refined = method.endswith("ICP")
            over_time.plot(1e3 * seconds.mean(), recall[0], "o" if refined else "x", color=style["color"])
    over_noise.set(
        title="dotted: without ICP",
        xlabel="noise, % of the longest side",
        ylabel="recall (ADI below 0.1 diameters)",
        ylim=(0, 1.02),
    )
    figure.legend(*over_noise.get_legend_handles_labels(), loc="outside right upper", fontsize=7)
    over_time.set(
        title="crosses: without ICP",
        xlabel="mean ms a crop, warm",
        xscale="log",
        ylabel=f"recall, {noise_name(noises[0])}",
        ylim=(0, 1.02),
    )
    over_time.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    over_time.xaxis.set_major_formatter(ticker.ScalarFormatter())
    over_time.xaxis.set_minor_formatter(ticker.NullFormatter())
    for axis in (over_noise, over_time):
        axis.grid(alpha=0.3)
    return as_png(canvas)


def new_figure(size: tuple[float, float]) -> tuple[Any, Any]:
    """Return a figure that needs no screen, and its canvas. Raises InputError without matplotlib."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError("reports need a package that is not installed: pip install 'kmn_jax[plots]'") from None
    figure = Figure(figsize=size, layout="constrained", dpi=100)
    return figure, FigureCanvasAgg(figure)


def as_png(canvas: Any) -> bytes:
    """Return a figure as a file."""
    content = io.BytesIO()
    canvas.print_png(content)
    return content.getvalue()
