"""How a scene is searched: the settings of detection, and the named ones."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from kmn_jax.detection._draw import CropSearchConfig
from kmn_jax.detection._search import SearchConfig
from kmn_jax.errors import InputError
from kmn_jax.models import KeyMatchNetConfig


@dataclass(frozen=True)
class DetectConfig:
    """How a scene is searched; lengths are shares of the object's diameter."""

    search: SearchConfig = field(default_factory=SearchConfig)
    give_up: bool = True  # on seeds whose first draw has no pose; not where places are given
    many_points: bool = False  # in each draw, and more draws, as always where places are given: `CropSearchConfig`
    patience: int | None = 3  # rounds with nothing promising, after which it is not searched finely; None goes on
    later_seeds: int = 16  # at most in a round after the first; rounds go on until the foreground is covered
    most_seeds: int = 512  # at least so many are searched before it is given up to cover the foreground
    likely: float = 0.5  # the probability from which on a pose, as it is found, explains points: they are done
    promising: float = 0.1  # that from which on such a pose, in a new place, is a reason to go on, as likely ones are
    accepted: float = 0.8  # that from which on a pose counts as found: in world bins 95% of such poses are right
    reported: float = 0.1  # less probable poses are left out
    # Where another pose of the scene is `sure`, of that probability: how many poses of a place are refined after the
    # best one, as long as the one that stands there is not. Those that stay so are then refined once more. 0 and 0.0
    # leave it at the best ones.
    next_best: int = 4
    sure: float = 0.9

    def __post_init__(self) -> None:
        if self.patience is not None and self.patience < 1:
            raise InputError(f"patience = {self.patience} must be at least 1, or none")
        if not (0 <= self.promising <= 1 and 0 <= self.likely <= 1):
            raise InputError(f"promising = {self.promising} and likely = {self.likely} must be probabilities")
        if self.next_best < 0 or not 0 <= self.sure <= 1:
            raise InputError(f"next_best = {self.next_best} must not be below 0, and sure = {self.sure} a probability")
        if min(self.later_seeds, self.most_seeds) < 1 or not 0 <= self.reported <= self.accepted <= 1:
            raise InputError(
                f"later_seeds = {self.later_seeds} and most_seeds = {self.most_seeds} must be at least 1, and reported"
                f" = {self.reported} and accepted = {self.accepted} probabilities in this order"
            )

    def search_of(self, config: KeyMatchNetConfig, at_places: bool = False) -> SearchConfig:
        """Return how is searched with a network: around seeds all over the scene, or at places that are given."""
        crops = self.search.crops
        if at_places or self.many_points:
            search = replace(self.search, crops=crops.of_network(config))
        else:
            search = self.search.of_network(config)
        give_up = crops.give_up or (self.give_up and not at_places)
        return replace(search, crops=replace(search.crops, give_up=give_up))


FAST = DetectConfig(search=SearchConfig(crops=CropSearchConfig(num_draws=1)))
THOROUGH = DetectConfig(patience=None, give_up=False, many_points=True)
Effort = Literal["fast", "usual", "thorough"]


def config_of(effort: str) -> DetectConfig:
    """Return how is searched with an effort: "fast", "usual" or "thorough".

    docs/detect.md says what they gain and cost. Raises InputError if there is no such effort.
    """
    known = {"fast": FAST, "usual": DetectConfig(), "thorough": THOROUGH}
    if effort not in known:
        raise InputError(f"effort = {effort!r} is not known: choose among {', '.join(known)}")
    return known[effort]
