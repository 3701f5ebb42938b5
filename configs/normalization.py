"""One choice of the network that no trained one can be asked about: how input coordinates are scaled.

normalization_metric, normalization_released
    Command:   python -m experiments.build_data electronics --limit 120 --folder outputs/packs/electronics_120
               python -m experiments.train normalization_metric --folder outputs/runs/normalization_metric
               python -m experiments.evaluate validation --methods ours
                   --weights outputs/runs/normalization_metric/model.safetensors
                   --output outputs/evaluation/normalization_metric, and the same with normalization_released.
    Hardware:  one core each, two side by side, of an AMD EPYC; 10 minutes of data, 20 and 17 of training, 2026-11-23.
    Expected:  recall without noise 0.76 ("metric") and 0.57 ("released"), experiments/RESULTS.md.
"""

from __future__ import annotations

from dataclasses import replace

from configs.small import small

# Raw coordinates, as invariant inputs need "metric" anyhow; few objects and samples, so to be compared only with
# each other.
normalization_metric, normalization_released = (
    replace(
        small,
        name=f"normalization_{normalization}",
        pack="outputs/packs/electronics_120",
        num_steps=2_000,
        network=replace(small.network, num_keypoints=20, inputs="raw", normalization=normalization),
    )
    for normalization in ("metric", "released")
)
