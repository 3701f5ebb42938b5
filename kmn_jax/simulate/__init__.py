"""Bins of an object's copies: physics, cameras, exact and splatted views, and what a depth sensor makes of them."""

from kmn_jax.simulate._bin_scene import Bin, BinScene
from kmn_jax.simulate._hulls import CollisionShape, HullConfig, collision_shape
from kmn_jax.simulate._physics import BinConfig, DropResult, settle
from kmn_jax.simulate._raycast import RayMesh, pack_bits, render, visible_bin_surfels, visible_surfels
from kmn_jax.simulate._sensor import PERFECT, SensorConfig, sense
from kmn_jax.simulate._splat import (
    BIN,
    BinInView,
    SplatConfig,
    Surfels,
    VisiblePoints,
    bin_surfels,
    visible_by_splatting,
    visible_from_bits,
)
from kmn_jax.simulate._views import CameraConfig, place_camera

__all__ = [
    "BIN",
    "PERFECT",
    "Bin",
    "BinConfig",
    "BinInView",
    "BinScene",
    "CameraConfig",
    "CollisionShape",
    "DropResult",
    "HullConfig",
    "RayMesh",
    "SensorConfig",
    "SplatConfig",
    "Surfels",
    "VisiblePoints",
    "bin_surfels",
    "collision_shape",
    "pack_bits",
    "place_camera",
    "render",
    "sense",
    "settle",
    "visible_bin_surfels",
    "visible_by_splatting",
    "visible_from_bits",
    "visible_surfels",
]
