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
    disparity_step: float = (
        0.0  # between depths at `noise_depth` that can be told apart; it grows with the depth squared
    )
    shared_noise: float = (
        0.0  # deviation, at `noise_depth`, of errors that neighbours share; it grows as the noise does
    )
    shared_patch: float = 0.1  # how far they share them
    holes: float = 0.0  # share of the pixels that is missing in patches ...
    hole_patch: float = 0.1  # ... of this radius
    flying: float = 0.0  # share of the pixels beside a jump, as above, that hang between its two sides

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

    @classmethod
    def stereo(cls) -> SensorConfig:
        """Return plausible values for an active stereo camera that sees a part of 50 mm from 400 mm.

        With 640 columns over 65 degrees and cameras 50 mm apart, a twelfth of a pixel of disparity is half a millimetre
        there; errors come from matching windows of some pixels, and so neighbours share them.
        """
        return cls(
            noise=0.004,
            disparity_step=0.01,
            shared_noise=0.008,
            shared_patch=0.12,
            edge_width=2,
            edge_loss=0.5,
            holes=0.03,
            hole_patch=0.1,
            flank_loss=0.7,
            flank_patch=0.05,
            projector=(1.0, 0.0, 0.0),
        )

    @classmethod
    def time_of_flight(cls) -> SensorConfig:
        """Return plausible values for a time-of-flight camera that sees a part of 50 mm from 400 mm.

        Data sheets of such cameras state deviations of millimetres at half a metre, and systematic errors as large;
        pixels at edges see both sides of them, and measure something between.
        """
        return cls(
            noise=0.03,
            shared_noise=0.02,
            shared_patch=0.5,
            edge_width=2,
            edge_loss=0.1,
            flying=0.5,
            max_slant=80.0,
        )

    def __post_init__(self) -> None:
        for name in ("noise", "step", "flank_patch", "edge_width", "disparity_step", "shared_noise"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(f"sensor config: {name} is {getattr(self, name)}, but must be zero or above")
        for name in ("noise_depth", "edge_jump", "flank_power", "shared_patch", "hole_patch"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"sensor config: {name} is {getattr(self, name)}, but must be above zero")
        for name in ("slant_noise", "edge_loss", "flank_loss", "holes", "flying"):
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
    noise_rng, edge_rng, flank_rng, shared_rng, hole_rng, flying_rng = rng.spawn(6)
    exact, normals = rendering.depth, rendering.normals
    if not exact.any():
        return np.zeros_like(exact)
    points = np.asarray(depth_to_points(jnp.asarray(exact), jnp.asarray(camera.matrix, dtype=jnp.float32)))
    ranges = np.linalg.norm(points, axis=-1)
    cosine = -np.einsum("hwc,hwc->hw", normals, points) / np.maximum(ranges, np.finfo(np.float32).tiny)
    missing = exact <= 0
    if config.max_slant < 90:
        missing |= cosine < np.cos(np.radians(config.max_slant))
    edges = np.zeros_like(missing)
    if config.edge_width and (config.edge_loss > 0 or config.flying > 0):
        edges = _near_jumps(exact, config.edge_jump * diagonal, config.edge_width)
    if config.edge_loss > 0:
        missing |= edges & (edge_rng.random(exact.shape, dtype=np.float32) < config.edge_loss)
    pixels = diagonal * camera.fx / float(np.median(exact[exact > 0]))  # that a diagonal is wide
    if config.flank_loss > 0:
        missing |= (
            _uniform_field(exact.shape, config.flank_patch * pixels, flank_rng)
            < config.flank_loss * np.clip(1 - cosine, 0, 1) ** config.flank_power
        )
    if config.holes > 0:
        missing |= _uniform_field(exact.shape, config.hole_patch * pixels, hole_rng) < config.holes
    if any(config.projector):
        hit = exact > 0
        missing[hit] |= hidden_from(mesh, scene, points[hit], normals[hit], diagonal * np.array(config.projector))
    depth, farther = exact, (exact / (config.noise_depth * diagonal)) ** 2 * diagonal
    if config.flying > 0:
        depth = _flying(exact, edges, config, flying_rng)
    if config.noise > 0:
        growth = 1 + config.slant_noise * (1 / np.maximum(cosine, _LEAST_COSINE) - 1)
        depth = depth + config.noise * farther * growth * noise_rng.standard_normal(exact.shape, dtype=np.float32)
    if config.shared_noise > 0:
        field = _normal_field(exact.shape, config.shared_patch * pixels, shared_rng)
        depth = depth + config.shared_noise * farther * field
    if config.disparity_step > 0:
        # Equal steps of 1 / depth.
        steps = (config.noise_depth * diagonal) ** 2 / (config.disparity_step * diagonal)
        disparity = np.round(steps / np.where(depth > 0, depth, np.inf))
        depth = np.where(disparity > 0, steps / np.maximum(disparity, 1), 0)
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


def _flying(
    exact: Float[np.ndarray, "h w"], edges: Bool[np.ndarray, "h w"], config: SensorConfig, rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """Return the depth where some of the pixels beside a jump hang between its two sides."""
    from scipy.ndimage import maximum_filter, minimum_filter

    size = 2 * config.edge_width + 1
    far = maximum_filter(exact, size)
    near = minimum_filter(np.where(exact > 0, exact, exact.max()), size)
    chosen = edges & (exact > 0) & (rng.random(exact.shape, dtype=np.float32) < config.flying)
    between = near + rng.random(exact.shape, dtype=np.float32) * (far - near)
    return np.where(chosen, between, exact).astype(np.float32)


def _uniform_field(shape: tuple[int, ...], radius: float, rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Return numbers that are uniform in [0, 1] at every pixel and alike within about `radius` pixels."""
    from scipy.special import ndtr

    return rng.random(shape, dtype=np.float32) if radius < 1 else ndtr(_normal_field(shape, radius, rng))


def _normal_field(shape: tuple[int, ...], radius: float, rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Return standard normal numbers that are alike within about `radius` pixels."""
    from scipy.ndimage import gaussian_filter

    white = rng.standard_normal(shape, dtype=np.float32)
    if radius < 1:
        return white
    # White noise that is blurred so has this variance; wrapping around keeps it the same up to the borders.
    return gaussian_filter(white, radius, mode="wrap") * np.float32(2 * np.pi**0.5 * radius)
