"""What a depth sensor makes of an exact rendering: noise, missing pixels, steps. Everything is off unless asked for."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from kmn_jax.errors import InputError
from kmn_jax.geometry import depth_to_points
from kmn_jax.simulate._bin_scene import BinScene
from kmn_jax.simulate._raycast import RayMesh, Rendering, hidden_from

_LEAST_COSINE = 0.05  # of the slant: at 87 degrees the noise stops to grow


@dataclass(frozen=True)
class SensorConfig:
    """Strengths of a sensor's faults, each independent of the others; the defaults are those of a perfect sensor.

    Lengths are in diagonals of the object. The slant is the angle between the surface's normal and the ray.
    """

    noise: float = 0.0  # standard deviation of the depth at `noise_depth`; it grows with the depth squared
    noise_depth: float = 8.0
    slant_noise: float = 0.0  # 1: the deviation also grows with 1 / cos(slant); between 0 and 1: that share of it
    step: float = 0.0  # depths are multiples of it
    max_slant: float = 90.0  # degrees; what is slanted more is missing
    edge_width: int = 0  # pixels that can be missing on both sides of a jump in depth
    edge_jump: float = 0.05
    edge_loss: float = 1.0  # the probability that such a pixel is missing
    flank_loss: float = 0.0  # a pixel is missing with the probability flank_loss * (1 - cos(slant))^flank_power, ...
    flank_power: float = 4.0
    flank_patch: float = 0.0  # ... in patches of this radius; 0: pixel by pixel
    projector: tuple[float, float, float] = (0.0, 0.0, 0.0)  # its place in the camera frame: it lights all that is seen

    @classmethod
    def structured_light(cls) -> SensorConfig:
        """Return plausible values for a structured-light scanner above a bin of metal parts.

        Noise and flanks follow one real scan of a gear motor: of its pixels 2% were missing up to a slant of 60
        degrees, 5% at 65, 30% at 75 and 65% at 85, and the deviation of the others grew about as 1 / cos(slant).
        """
        return cls(
            noise=0.0015,
            slant_noise=1.0,
            step=0.0002,
            max_slant=85.0,
            edge_width=1,
            flank_loss=1.0,
            flank_patch=0.03,
            projector=(1.6, 0.0, 0.0),
        )

    def __post_init__(self) -> None:
        for name in ("noise", "step", "flank_patch", "edge_width"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(f"sensor config: {name} is {getattr(self, name)}, but must be zero or above")
        for name in ("noise_depth", "edge_jump", "flank_power"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"sensor config: {name} is {getattr(self, name)}, but must be above zero")
        for name in ("slant_noise", "edge_loss", "flank_loss"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"sensor config: {name} is {getattr(self, name)}, but must be between 0 and 1")
        if not 0 < self.max_slant <= 90:
            raise InputError(f"sensor config: max_slant is {self.max_slant}, but must be above 0 and up to 90 degrees")
        if not np.isfinite(self.projector).all():
            raise InputError(f"sensor config: projector is {self.projector}, but must be finite")


PERFECT = SensorConfig()


def sense(
    mesh: RayMesh, scene: BinScene, rendering: Rendering, config: SensorConfig, rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """Return the depth image that a sensor gives of a scene and its exact rendering, 0 where it gives none.

    Every fault follows from the exact scene and draws from a generator of its own, so that switching one on or off
    leaves the others as they are. Raises InputError if the rendering has another size than the scene's camera.
    """
    camera, diagonal = scene.camera, mesh.diagonal
    if rendering.depth.shape != (camera.height, camera.width):
        raise InputError(
            f"the rendering has {rendering.depth.shape[1]} x {rendering.depth.shape[0]} pixels, but the scene's camera"
            f" {camera.width} x {camera.height}: render this scene"
        )
    noise_rng, edge_rng, flank_rng = rng.spawn(3)
    exact, normals = rendering.depth, rendering.normals
    if not exact.any():
        return np.zeros_like(exact)
    points = np.asarray(depth_to_points(jnp.asarray(exact), jnp.asarray(camera.matrix, dtype=jnp.float32)))
    ranges = np.linalg.norm(points, axis=-1)
    cosine = -np.einsum("hwc,hwc->hw", normals, points) / np.maximum(ranges, np.finfo(np.float32).tiny)
    missing = exact <= 0
    if config.max_slant < 90:
        missing |= cosine < np.cos(np.radians(config.max_slant))
    if config.edge_width and config.edge_loss > 0:
        edges = _near_jumps(exact, config.edge_jump * diagonal, config.edge_width)
        missing |= edges & (edge_rng.random(exact.shape, dtype=np.float32) < config.edge_loss)
    if config.flank_loss > 0:
        radius = config.flank_patch * diagonal * camera.fx / float(np.median(exact[exact > 0]))
        missing |= (
            _uniform_field(exact.shape, radius, flank_rng)
            < config.flank_loss * np.clip(1 - cosine, 0, 1) ** config.flank_power
        )
    if any(config.projector):
        hit = exact > 0
        missing[hit] |= hidden_from(mesh, scene, points[hit], normals[hit], diagonal * np.array(config.projector))
    depth = exact
    if config.noise > 0:
        growth = 1 + config.slant_noise * (1 / np.maximum(cosine, _LEAST_COSINE) - 1)
        deviation = config.noise * diagonal * (exact / (config.noise_depth * diagonal)) ** 2 * growth
        depth = exact + deviation * noise_rng.standard_normal(exact.shape, dtype=np.float32)
    if config.step > 0:
        step = config.step * diagonal
        depth = step * np.round(depth.astype(np.float64) / step)
    return np.where(missing | (depth <= 0), 0, depth).astype(np.float32)


def _near_jumps(depth: Float[np.ndarray, "h w"], jump: float, width: int) -> Bool[np.ndarray, "h w"]:
    """Return the pixels at most `width` - 1 pixels from one whose neighbour's depth differs by more than `jump`."""
    from scipy.ndimage import maximum_filter

    filled = np.where(depth > 0, depth, depth.max() + 2 * jump)
    near = np.zeros(depth.shape, dtype=bool)
    across, down = np.abs(np.diff(filled, axis=1)) > jump, np.abs(np.diff(filled, axis=0)) > jump
    near[:, :-1] |= across
    near[:, 1:] |= across
    near[:-1] |= down
    near[1:] |= down
    return maximum_filter(near, size=2 * width - 1)


def _uniform_field(shape: tuple[int, ...], radius: float, rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Return numbers that are uniform in [0, 1] at every pixel and alike within about `radius` pixels."""
    from scipy.ndimage import gaussian_filter
    from scipy.special import ndtr

    if radius < 1:
        return rng.random(shape, dtype=np.float32)
    white = rng.standard_normal(shape, dtype=np.float32)
    # White noise that is blurred so has this variance; wrapping around keeps it the same up to the borders.
    return ndtr(gaussian_filter(white, radius, mode="wrap") * np.float32(2 * np.pi**0.5 * radius))
