"""Named training configs, one file for each family. The docstrings there are the records of the runs."""

from __future__ import annotations

import difflib

from configs.base import base, base_worlds
from configs.debug import debug
from configs.normalization import normalization_metric, normalization_released
from configs.paper import paper, paper_tenth, paper_worlds
from configs.per_object import per_object
from configs.small import small, worlds, worlds_long
from configs.variants import FEW, LONG, VARIANTS
from kmn_jax.errors import InputError
from kmn_jax.train._config import TrainConfig

CONFIGS: dict[str, TrainConfig] = {
    config.name: config
    for config in (
        paper,
        paper_tenth,
        paper_worlds,
        base,
        base_worlds,
        small,
        worlds,
        worlds_long,
        *VARIANTS,
        *FEW,
        *LONG,
        per_object,
        normalization_metric,
        normalization_released,
        debug,
    )
}


def find_config(name: str) -> TrainConfig:
    """Return the config of a name. Raises InputError with the nearest names if there is none."""
    if name in CONFIGS:
        return CONFIGS[name]
    near = difflib.get_close_matches(name, CONFIGS, n=2)
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(CONFIGS)}"
    raise InputError(f"there is no config {name!r}: {hint}")
