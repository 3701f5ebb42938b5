"""Bins of an object's copies: physics, cameras, exact and splatted views, and what a depth sensor makes of them."""

from kmn_jax.simulate._bin_scene import Bin, BinScene, Fixture
from kmn_jax.simulate._blocks import block_mesh, container_blocks
from kmn_jax.simulate._containers import Container, container_surfels, hidden_by_container
from kmn_jax.simulate._faults import FaultConfig, Faults, displaced, draw_faults, measured
from kmn_jax.simulate._hulls import CollisionShape, HullConfig, collision_shape
from kmn_jax.simulate._physics import BinConfig, DropResult, settle
from kmn_jax.simulate._raycast import RayMesh, pack_bits, render, visible_bin_surfels, visible_surfels
from kmn_jax.simulate._sensor import PERFECT, SensorConfig, sense
from kmn_jax.simulate._splat import (
    BIN,
    FOREIGN,
    BinInView,
    SplatConfig,
    Surfels,
    VisiblePoints,
    bin_surfels,
    picture_by_splatting,
    visible_by_splatting,
    visible_from_bits,
)
from kmn_jax.simulate._views import CameraConfig, place_camera
from kmn_jax.simulate._world_physics import WorldDrop, rows_of, settle_in
from kmn_jax.simulate._worlds import World, WorldConfig, make_world

__all__ = [
    "BIN",
    "FOREIGN",
    "PERFECT",
    "Bin",
    "BinConfig",
    "BinInView",
    "BinScene",
    "CameraConfig",
    "CollisionShape",
    "Container",
    "DropResult",
    "FaultConfig",
    "Faults",
    "Fixture",
    "HullConfig",
    "RayMesh",
    "SensorConfig",
    "SplatConfig",
    "Surfels",
    "VisiblePoints",
    "World",
    "WorldConfig",
    "WorldDrop",
    "bin_surfels",
    "block_mesh",
    "collision_shape",
    "container_blocks",
    "container_surfels",
    "displaced",
    "draw_faults",
    "hidden_by_container",
    "make_world",
    "measured",
    "pack_bits",
    "picture_by_splatting",
    "place_camera",
    "render",
    "rows_of",
    "sense",
    "settle",
    "settle_in",
    "visible_bin_surfels",
    "visible_by_splatting",
    "visible_from_bits",
    "visible_surfels",
]
