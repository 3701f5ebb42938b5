"""Object cards: all that a search needs to know of an object, made once, and the network's features of it."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from kmn_jax.errors import InputError, shown
from kmn_jax.files import read_safetensors, safetensors_bytes, write_whole
from kmn_jax.io import far_origin
from kmn_jax.limits import parse_json
from kmn_jax.models import Model, encode_object
from kmn_jax.objects._object_model import ObjectModel
from kmn_jax.objects._symmetry import Symmetries
from kmn_jax.typing import Scalar
from kmn_jax.units import METRES, check_unit

CARD_SUFFIX = ".kmn"
_FORMAT = "kmn_jax object card 1"
_LIMIT = 1_000_000  # bytes of a card
_ROUNDING = 1e-3  # diameters by which float32 may move a point


@dataclass(frozen=True, eq=False, repr=False)
class Part:
    """An object to look for. Lengths are in `unit`, in the object's own frame.

    Points are in farthest-point order: any first part of them covers the surface evenly, and the first K, as many as
    there are rows of `features`, are the keypoints. They are float32, or float64 if the object lies too far from the
    origin of its frame: see `origin`.
    """

    name: str
    unit: str
    points: Float[np.ndarray, "m 3"]
    normals: Float[np.ndarray, "m 3"]  # unit, outwards
    features: Float[np.ndarray, "k o"]
    diameter: float
    minimum: Float[np.ndarray, "3"]  # of the axis-aligned box around it
    maximum: Float[np.ndarray, "3"]
    area: float
    symmetries: Symmetries
    source_digest: str  # SHA-256 of the file it was made of
    model_digest: str  # of the network that made the features, see `model_digest`
    is_unit_assumed: bool = False  # whether nobody stated its unit, so that its numbers were taken for millimetres

    def __repr__(self) -> str:
        counts = f"{len(self.points)} points, {self.num_keypoints} keypoints"
        return f"Part({self.name}: diameter {self.diameter:.4g} {self.unit}, {counts}, {self.symmetries})"

    @property
    def num_keypoints(self) -> int:
        """K."""
        return len(self.features)

    @property
    def is_symmetric(self) -> bool:
        """Whether another pose than the given one looks the same."""
        return len(self.symmetries.rotations) > 1 or len(self.symmetries.axes) > 0

    @property
    def origin(self) -> Float[np.ndarray, "3"]:
        """The middle of the object if it lies too far from its frame's origin for float32, else zero."""
        return far_origin(self.minimum, self.maximum)

    def centred(self) -> Part:
        """Return the same part in a frame with its `origin`, which float32 holds."""
        origin = self.origin
        if not origin.any():
            return self
        return replace(
            self,
            points=(self.points - origin).astype(np.float32),
            minimum=self.minimum - origin,
            maximum=self.maximum - origin,
            symmetries=replace(self.symmetries, center=self.symmetries.center - origin),
        )

    def in_unit(self, unit: str) -> Part:
        """Return the same part with its lengths in another unit; the features do not depend on it."""
        factor = METRES[self.unit] / METRES[check_unit(unit)]
        if factor == 1:
            return self
        return replace(
            self,
            unit=unit,
            points=(self.points * factor).astype(self.points.dtype),
            diameter=self.diameter * factor,
            minimum=self.minimum * factor,
            maximum=self.maximum * factor,
            area=self.area * factor**2,
            symmetries=replace(self.symmetries, center=self.symmetries.center * factor),
        )


def model_digest(model: Model) -> str:
    """Return the SHA-256 of a network's config and parameters, wherever they were loaded from."""
    digest = hashlib.sha256(repr(model.config).encode())
    for path, value in sorted(nnx.to_flat_state(model.parameters), key=lambda pair: str(pair[0])):
        digest.update(".".join(map(str, path)).encode())
        digest.update(np.ascontiguousarray(np.asarray(value[...], dtype=np.float32)).tobytes())
    return digest.hexdigest()


class PartArrays(NamedTuple):
    """What a search needs of an object, in the scene's unit; the first K points are the keypoints."""

    points: Float[Array, "m 3"]
    normals: Float[Array, "m 3"]
    features: Float[Array, "k o"]
    diameter: Scalar


def make_part(found: ObjectModel, model: Model, digest: str | None = None) -> Part:
    """Encode an object.

    Raises InputError if it has fewer points than the network takes, or the network was trained for another one.
    """
    config = model.config
    if config.object_digest not in ("", found.digest):
        raise InputError(f"this network was trained for one object, and {found.name} is of another CAD file")
    count = config.num_object_points
    if len(found.points) < count:
        raise InputError(f"{found.name} has {len(found.points)} points, but this network takes {count}: make more")
    cloud = np.concatenate([found.centred().points, found.normals], axis=1)[:count].astype(np.float32)
    keypoints = np.arange(config.num_keypoints)
    features = encode_object(model, cloud, keypoints, np.float32(found.diameter)).features
    return Part(
        name=found.name,
        unit=found.unit,
        points=found.points,
        normals=found.normals.astype(np.float32),
        features=np.asarray(jax.device_get(features), dtype=np.float32),
        diameter=float(found.diameter),
        minimum=found.minimum.astype(np.float64),
        maximum=found.maximum.astype(np.float64),
        area=float(found.area),
        symmetries=found.symmetries,
        source_digest=found.digest,
        model_digest=digest or model_digest(model),
    )


def arrays_of(model: Model, part: Part) -> PartArrays:
    """Return what a search needs of a part.

    Raises InputError if it must be `centred` first, or if its features are not those of such a network.
    """
    width = model.config.object_width
    if part.features.shape[1:] != (width,):
        raise InputError(
            f"{part.name} has features of the shape {part.features.shape}, but this network needs {width} for each"
            " keypoint: make it again with kmn prepare"
        )
    if part.origin.any():
        raise InputError(f"{part.name} lies too far from the origin of its frame for float32: take part.centred()")
    count = model.config.num_object_points
    points, normals = jnp.asarray(part.points[:count]), jnp.asarray(part.normals[:count])
    return PartArrays(points, normals, jnp.asarray(part.features), jnp.float32(part.diameter))


def save_part(part: Part, path: str | Path) -> None:
    """Write an object card, of less than a megabyte; it holds arrays and text only."""
    tensors = {
        "points": part.points,
        "normals": part.normals,
        "features": part.features,
        "minimum": part.minimum,
        "maximum": part.maximum,
        "symmetry_rotations": part.symmetries.rotations,
        "symmetry_axes": part.symmetries.axes,
        "symmetry_center": part.symmetries.center,
    }
    facts = {
        "name": part.name,
        "unit": part.unit,
        "diameter": part.diameter,
        "area": part.area,
        "symmetry_tolerance": part.symmetries.tolerance,
        "source_digest": part.source_digest,
        "model_digest": part.model_digest,
    }
    if part.is_unit_assumed:
        facts["is_unit_assumed"] = True
    content = safetensors_bytes(tensors, {"format": _FORMAT, "facts": json.dumps(facts)})
    if len(content) > _LIMIT:
        raise InputError(
            f"the card of {part.name} would have {len(content)} bytes, more than {_LIMIT}: take fewer points"
        )
    write_whole(path, content)


def load_part(path: str | Path, digest: str | None = None) -> Part:
    """Read an object card.

    Raises InputError if it is damaged, of another format, or, with the digest of a network, made by another one.
    """
    tensors, metadata = read_safetensors(path)
    if metadata.get("format") != _FORMAT:
        raise InputError(f"{path} is no object card of this version: make it again with kmn prepare")
    try:
        facts = dict(parse_json(metadata["facts"]))
        part = _part(tensors, facts)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is a damaged object card ({shown(error)}): make it again with kmn prepare") from None
    if digest is not None and part.model_digest != digest:
        raise InputError(
            f"{path} was made by other weights than those in use: make it again with kmn prepare CAD_FILE -o {path},"
            " and with the same --weights"
        )
    return part


def _part(tensors: dict[str, np.ndarray], facts: dict[str, object]) -> Part:
    def array(name: str, *shape: int | None) -> np.ndarray:
        value = tensors[name]
        fits = value.ndim == len(shape) and all(
            size is None or size == found for size, found in zip(shape, value.shape, strict=True)
        )
        with np.errstate(over="ignore"):
            finite = np.isfinite(value).all() and np.isfinite(value.astype(np.float32)).all()
        if not fits or not finite:
            raise ValueError(f"{name} has shape {value.shape} or values that are not finite")
        return value

    def number(name: str) -> float:
        value = float(str(facts[name]))
        if not 0 < value < 1e9:
            raise ValueError(f"{name} = {value}")
        return value

    points = array("points", None, 3)
    points = points.astype(np.float64 if points.dtype == np.float64 else np.float32)
    features = array("features", None, None).astype(np.float32)
    if not 1 <= len(features) <= len(points):
        raise ValueError(f"{len(features)} keypoints of {len(points)} points")
    with np.errstate(over="ignore"):
        normals = array("normals", len(points), 3).astype(np.float32)
        lengths = np.linalg.norm(normals, axis=1)
    if not np.allclose(lengths, 1, atol=1e-3):
        raise ValueError("normals that are not of unit length")
    minimum, maximum = (array(name, 3).astype(np.float64) for name in ("minimum", "maximum"))
    if not (minimum <= maximum).all():
        raise ValueError(f"minimum {minimum.tolist()} above maximum {maximum.tolist()}")
    diameter, extents = number("diameter"), maximum - minimum
    if not 0.99 * extents.max() <= diameter <= 1.01 * float(np.linalg.norm(extents)):
        raise ValueError(f"a diameter of {diameter:g} in a box of {extents.tolist()}")
    margin = _ROUNDING * diameter
    if not ((points >= minimum - margin) & (points <= maximum + margin)).all():
        raise ValueError("points outside of its box")
    rotations = array("symmetry_rotations", None, 3, 3).astype(np.float64)
    if not len(rotations):
        raise ValueError("no symmetry, not even the identity")
    axes = array("symmetry_axes", None, 3).astype(np.float64)
    products = rotations.transpose(0, 2, 1) @ rotations
    if not np.allclose(products, np.eye(3), atol=1e-3) or not np.allclose(np.linalg.norm(axes, axis=1), 1, atol=1e-3):
        raise ValueError("symmetries that are no rotations")
    symmetries = Symmetries(
        rotations,
        axes,
        array("symmetry_center", 3).astype(np.float64),
        number("symmetry_tolerance"),
    )
    return Part(
        name=str(facts["name"]),
        unit=check_unit(str(facts["unit"])),
        points=points,
        normals=normals,
        features=features,
        diameter=diameter,
        minimum=minimum,
        maximum=maximum,
        area=number("area"),
        symmetries=symmetries,
        source_digest=str(facts["source_digest"]),
        model_digest=str(facts["model_digest"]),
        is_unit_assumed=facts.get("is_unit_assumed") is True,  # older cards do not say
    )
