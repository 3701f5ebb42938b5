"""Pictures of the images in which detection did worst."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from experiments.bins import WorldImage
from experiments.detect_bins import Tally
from kmn_jax.detection import Detections, Scene
from kmn_jax.files import make_folder
from kmn_jax.viz import save_picture

_KEPT = 3  # images of a family


@dataclass(frozen=True)
class _Image:
    missed: int
    wrong: int
    image: WorldImage
    scene: Scene
    found: Detections


@dataclass
class WorstImages:
    """The images of each family with the most visible copies that were not accepted, and wrong poses that were."""

    accepted: float  # probability
    _kept: dict[str, list[_Image]] = field(default_factory=dict)

    def add(self, image: WorldImage, scene: Scene, found: Detections, counted: Tally) -> None:
        """Look at an image; one without faults is never among the worst."""
        chosen = np.array(counted.probability) >= self.accepted
        wrong = int((chosen & ~np.array(counted.right, dtype=bool)).sum())
        missed = counted.copies - counted.num_found(self.accepted)
        if wrong + missed:
            family = self._kept.setdefault(image.family, [])
            family.append(_Image(missed, wrong, image, scene, found))
            family.sort(key=lambda one: -(one.missed + one.wrong))  # of equal ones, the first stay
            del family[_KEPT:]

    def save(self, folder: Path) -> list[Path]:
        """Draw them, with the true poses, and return the files: named by family, image, missed copies, wrong poses."""
        make_folder(folder)
        paths = []
        for family, images in self._kept.items():
            for one in images:
                key, name = one.image.key, family.replace(" ", "_")
                file = f"{name}-{key.scene_id:06d}-{key.image_id:06d}-{one.missed}_missed-{one.wrong}_wrong.png"
                save_picture(folder / file, one.scene, one.image.part, one.found, list(one.image.truth))
                paths.append(folder / file)
        return paths
