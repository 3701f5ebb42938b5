"""What depth sensors do to a crop's points, inside jit: three families of sensors, each of any strength in its range.

The ranges are wider than one instrument's, so that a network sees worse than it will meet. Lengths are shares of the
object's diameter. docs/data.md names the properties that each family is made from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kmn_jax.errors import InputError
from kmn_jax.typing import Mask, Normals, Points, PRNGKey, Scalar

_WAVES = 6  # of the ripple
_HOLES = 4
_MOST_SIGMAS = 3.0


@dataclass(frozen=True)
class FaultConfig:
    """How often crops are seen by which family of sensors; what is left of 1 is a perfect one."""

    structured_light: float = 0.35
    stereo: float = 0.3
    time_of_flight: float = 0.2

    def __post_init__(self) -> None:
        shares = (self.structured_light, self.stereo, self.time_of_flight)
        if min(shares) < 0 or sum(shares) > 1:
            raise InputError(f"the shares of sensors are {shares}: none may be negative, and their sum not above 1")


class Faults(NamedTuple):
    """Strengths of one sensor's faults at one crop."""

    noise: Scalar  # standard deviation along the ray
    slant_noise: Scalar  # share of it that grows with 1 / cos(slant)
    ripple: Scalar  # standard deviation of depth errors that neighbours share
    ripple_length: Scalar  # over which they change
    step: Scalar  # between the depths that the sensor can tell apart; 0: none
    flying: Scalar  # share of points that hang between surfaces
    least_cosine: Scalar  # of the slant: what is slanted more is missing
    flank_loss: Scalar  # a point is missing with the probability flank_loss * (1 - cos(slant))^4
    hole: Scalar  # radius of patches where all is missing; 0: none


def draw_faults(key: PRNGKey, config: FaultConfig) -> Faults:
    """Draw a family and the strengths of its faults."""
    family_key, *keys = jax.random.split(key, 10)
    place = jax.random.uniform(family_key)
    light = place < config.structured_light
    stereo = ~light & (place < config.structured_light + config.stereo)
    flight = ~light & ~stereo & (place < config.structured_light + config.stereo + config.time_of_flight)
    shares = [jax.random.uniform(key) for key in keys]

    def of(share: Scalar, *ranges: tuple[float, float]) -> Scalar:
        """Return a value from the range of the family that was drawn, in equal shares of its logarithm; else 0."""
        values = [low * (high / low) ** share for low, high in ranges]
        return jnp.where(light, values[0], jnp.where(stereo, values[1], jnp.where(flight, values[2], 0)))

    tiny = (1e-6, 1e-6)
    return Faults(
        noise=of(shares[0], (3e-4, 2e-2), (1e-3, 2e-2), (5e-3, 6e-2)),
        slant_noise=jnp.where(light, shares[1], 0),
        ripple=of(shares[2], tiny, (1e-3, 1.5e-2), (2e-3, 2e-2)),
        ripple_length=0.08 * 6 ** shares[3],
        step=of(shares[4], (1e-4, 2e-3), (1e-3, 2e-2), tiny),
        flying=of(shares[5], (1e-4, 5e-3), (1e-3, 2e-2), (5e-3, 6e-2)),
        least_cosine=of(shares[6], (0.05, 0.35), (0.05, 0.3), (0.03, 0.2)),
        flank_loss=jnp.where(light | stereo, shares[7], 0),
        hole=jnp.where(stereo & (shares[8] > 0.4), 0.05 + 0.2 * shares[8], 0),
    )


def measured(
    key: PRNGKey,
    faults: Faults,
    points: Points,
    normals: Normals,
    mask: Mask,
    diameter: Scalar,
    seed: Float[Array, "3"],
) -> Bool[Array, " n"]:
    """Tell which of the points that a camera sees its sensor measures; points are in the camera's frame.

    Patches that are missing lie around the seed's place, but never over it.
    """
    loss_key, place_key = jax.random.split(key)
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    ranges = jnp.sqrt(jnp.maximum(x**2 + y**2 + z**2, 1e-12))
    cosine = -(x * normals[:, 0] + y * normals[:, 1] + z * normals[:, 2]) / ranges
    lost = faults.flank_loss * jnp.clip(1 - cosine, 0, 1) ** 4
    kept = mask & (cosine > faults.least_cosine) & (jax.random.uniform(loss_key, x.shape) >= lost)
    radius = faults.hole * diameter
    directions = jax.random.normal(place_key, (_HOLES, 2))
    lengths = jnp.sqrt((directions**2).sum(axis=1, keepdims=True)) + 1e-6
    centres = seed[None, :2] + directions * jnp.maximum(0.5 * diameter, 1.1 * radius / lengths)
    for centre in centres:
        kept = kept & ((x - centre[0]) ** 2 + (y - centre[1]) ** 2 >= radius**2)
    return kept


def displaced(key: PRNGKey, faults: Faults, points: Points, normals: Normals, diameter: Scalar) -> Points:
    """Return points of the camera's frame as the sensor measures them: moved along their rays."""
    white_key, wave_key, phase_key, flying_key, depth_key, step_key = jax.random.split(key, 6)
    ranges = jnp.sqrt((points**2).sum(axis=1, keepdims=True))
    rays = points / jnp.where(ranges > 0, ranges, 1)
    cosine = jnp.maximum(-(rays * normals).sum(axis=1), 0.05)
    white = jnp.clip(jax.random.normal(white_key, cosine.shape), -_MOST_SIGMAS, _MOST_SIGMAS)
    error = faults.noise * (1 + faults.slant_noise * (1 / cosine - 1)) * white
    waves = jax.random.normal(wave_key, (2, _WAVES)) / faults.ripple_length
    phases = 2 * jnp.pi * jax.random.uniform(phase_key, (1, _WAVES))
    places = points[:, :2] / diameter
    product = places[:, :1] * waves[:1] + places[:, 1:] * waves[1:]
    error = error + faults.ripple * jnp.sqrt(2.0 / _WAVES) * jnp.cos(product + phases).sum(axis=1)
    chosen = jax.random.uniform(flying_key, error.shape) < faults.flying
    error = error + jnp.where(chosen, 0.3 * jax.random.uniform(depth_key, error.shape, minval=-1.0), 0)
    depth = ranges[:, 0] / diameter + error
    step = jnp.where(faults.step > 1e-5, faults.step, 1)
    phase = jax.random.uniform(step_key)
    depth = jnp.where(faults.step > 1e-5, step * (jnp.round(depth / step + phase) - phase), depth)
    return rays * (depth * diameter)[:, None]
