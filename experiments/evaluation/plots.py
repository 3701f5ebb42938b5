"""Recall over noise and over time."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.evaluation.configs import noise_name
from experiments.evaluation.scores import Cell, pooled
from kmn_jax.errors import InputError
from kmn_jax.extras import install_command


def recall_plot(cells: Sequence[Cell], noises: Sequence[float]) -> bytes:
    """Return a PNG: recall of all objects, with intervals, over the mean time, and over noise if there are several.

    Recall over time is that at the first noise, the time that of all noises.
    """
    over_noise: Any = None
    if len(noises) > 1:
        figure, canvas = new_figure((12, 4.8))  # with one clear error if there is no matplotlib
        over_noise, over_time = figure.subplots(1, 2)
    else:
        figure, canvas = new_figure((8, 4.8))
        over_time = figure.subplots()
    from matplotlib import ticker

    for number, method in enumerate(dict.fromkeys(cell.method for cell in cells)):
        own = [pooled([c for c in cells if c.method == method and c.noise == noise], "all") for noise in noises]
        recall = np.array([cell.recall() for cell in own])
        low, high = np.array([cell.interval() for cell in own]).T
        spread = np.array([recall - low, high - recall])
        refined = method.endswith("ICP")
        style = {"color": f"C{number // 2 % 10}", "lw": 1.2, "capsize": 2, "ms": 4, "label": method}
        seconds = np.concatenate([cell.seconds for cell in own])
        mean_ms = 1e3 * seconds.mean() if len(seconds) else np.nan
        over_time.errorbar([mean_ms], recall[:1], spread[:, :1], ls="none", marker="o" if refined else "x", **style)
        if over_noise is not None:
            places = [100 * noise * (1 + 0.01 * number) for noise in noises]
            over_noise.errorbar(places, recall, spread, ls="-" if refined else ":", marker="o", **style)
    figure.legend(*over_time.get_legend_handles_labels(), loc="outside right upper", fontsize=7)
    over_time.set(
        title="crosses: without ICP",
        xlabel="mean ms a crop, warm",
        xscale="log",
        ylabel=f"recall, {noise_name(noises[0])} (ADI below 0.1 diameters)",
        ylim=(0, 1.02),
    )
    over_time.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    over_time.xaxis.set_major_formatter(ticker.ScalarFormatter())
    over_time.xaxis.set_minor_formatter(ticker.NullFormatter())
    over_time.grid(alpha=0.3)
    if over_noise is not None:
        over_noise.set(
            title="dotted: without ICP",
            xlabel="noise, % of the longest side",
            ylabel="recall (ADI below 0.1 diameters)",
            ylim=(0, 1.02),
        )
        over_noise.grid(alpha=0.3)
    return as_png(canvas)


def new_figure(size: tuple[float, float]) -> tuple[Any, Any]:
    """Return a figure that needs no screen, and its canvas. Raises InputError without matplotlib."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError(f"reports need a package that is not installed: {install_command('matplotlib')}") from None
    figure = Figure(figsize=size, layout="constrained", dpi=100)
    return figure, FigureCanvasAgg(figure)


def as_png(canvas: Any) -> bytes:
    """Return a figure as a file, of 256 colours: a third of the bytes, which look the same."""
    from PIL import Image

    whole, content = io.BytesIO(), io.BytesIO()
    canvas.print_png(whole)
    Image.open(whole).convert("RGB").quantize(256).save(content, "PNG", optimize=True)
    return content.getvalue()
