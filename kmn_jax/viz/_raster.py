"""A part of a camera's image as a raster, and a part's surface on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from kmn_jax.geometry import Camera
from kmn_jax.viz._shading import image_places


@dataclass(frozen=True)
class Canvas:
    """A raster over a part of a camera's image: `scale` of its pixels for one of the camera's."""

    camera: Camera
    left: float  # of the raster's corner, in the camera's pixels
    top: float
    scale: float
    width: int
    height: int

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top in the camera's pixels."""
        return self.left, self.left + self.width / self.scale, self.top + self.height / self.scale, self.top

    def seen(
        self, normals: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "n 6 3"]
    ) -> Int[np.ndarray, "height width"]:
        """Return the hexagon seen at each pixel, -1 for none; only those that face the camera are seen."""
        from PIL import Image, ImageDraw

        centers = corners.mean(axis=1)
        places = (image_places(self.camera, corners) - [self.left, self.top]) * self.scale - 0.5
        facing = ((centers * normals).sum(axis=1) < 0) & (corners[..., 2] > 0).all(axis=1)
        rows = np.flatnonzero(facing & (np.ptp(places, axis=1).max(axis=1) < max(self.width, self.height)))
        image = Image.new("I", (self.width, self.height), -1)
        draw = ImageDraw.Draw(image)
        for row in rows[np.argsort(-centers[rows, 2])].tolist():
            draw.polygon(places[row].ravel().tolist(), fill=row)
        return np.asarray(image)
