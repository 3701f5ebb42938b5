"""Means of what the training steps measured since the last row of the metrics."""

from __future__ import annotations

import time
from collections.abc import Mapping

from kmn_jax.train._step import Metrics

MEANS = ("loss", "segmentation_loss", "keypoint_loss", "segmentation_accuracy", "keypoint_accuracy")


class Window:
    """Sums over steps. They are part of a snapshot, so that a resumed run writes the rows of an uninterrupted one."""

    def __init__(self, saved: Mapping[str, float] | None = None) -> None:
        """Begin empty, or with what `saved` returned. Its speed is that since now."""
        self._sums = dict.fromkeys((*MEANS, "gradient_norm", "crops", "steps"), 0.0) | dict(saved or {})
        self._samples, self._since = 0, time.monotonic()

    def add(self, metrics: Metrics, batch_size: int) -> None:
        """Take the metrics of a step, on the host; those of a batch count by its valid crops."""
        crops = float(metrics.num_crops)
        for name in MEANS:
            self._sums[name] += crops * float(getattr(metrics, name))
        self._sums["gradient_norm"] += float(metrics.gradient_norm)  # type: ignore[arg-type]
        self._sums["crops"] += crops
        self._sums["steps"] += 1
        self._samples += batch_size

    def pause(self, seconds: float) -> None:
        """Leave out of the speed what was not training."""
        self._since += seconds

    def means(self) -> dict[str, float]:
        """Return the means and the speed."""
        result = {name: self._sums[name] / max(self._sums["crops"], 1) for name in MEANS}
        result["gradient_norm"] = self._sums["gradient_norm"] / max(self._sums["steps"], 1)
        result["samples_per_second"] = self._samples / max(time.monotonic() - self._since, 1e-9)
        return result

    def saved(self) -> dict[str, float]:
        """Return the sums, for another Window."""
        return dict(self._sums)
