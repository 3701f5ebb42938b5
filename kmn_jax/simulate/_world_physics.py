"""Parts of several kinds settle in or on a container of any shape: the rigid-body counterpart of `make_world`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from kmn_jax.errors import InputError
from kmn_jax.simulate._blocks import container_blocks
from kmn_jax.simulate._containers import Container
from kmn_jax.simulate._hulls import CollisionShape
from kmn_jax.simulate._physics import SIMULATED_DIAGONAL, BinConfig, Body, simulate, spawn

_TOUCHING = 1.005  # pitch of parts in rows, of their own size
_DROPS = 6
_ASIDE = 0.3  # diagonals; what ended farther outside of the container is taken away


@dataclass(frozen=True, eq=False)
class WorldDrop:
    """Where parts came to rest, in the unit of their shapes; `fault` says why the drop cannot be used, if so."""

    T_world_object: Float[np.ndarray, "n 4 4"]
    inside: Bool[np.ndarray, " n"]  # what rests in or on the container, and did not roll or fall off
    fault: str = ""


def settle_in(
    shapes: Sequence[CollisionShape],
    container: Container,
    config: BinConfig,
    random_seed: int | Sequence[int],
    starts: Float[np.ndarray, "n 4 4"] | None = None,
) -> WorldDrop:
    """Let parts fall into a container, or rest where they are put.

    Args:
        shapes: one for each part. Lengths of the container are in diagonals of the first one.
        config: its step, friction and limits; the bin is the container.
        starts: poses from which they fall, in the shapes' unit; random ones above the floor unless given.

    The container's frame is the world's. The same arguments give the same bits on one machine.
    Raises InputError if there are no parts.
    """
    if not shapes:
        raise InputError("shapes is empty, but something must fall: give one shape for each part")
    scale = SIMULATED_DIAGONAL / shapes[0].diagonal
    kinds = {id(shape): Body(shape, scale) for shape in shapes}
    bodies = [kinds[id(shape)] for shape in shapes]
    blocks = [block * SIMULATED_DIAGONAL for block in container_blocks(container)]
    half = np.asarray(container.half, dtype=np.float64)
    outer = np.asarray(container.outer, dtype=np.float64) if float(container.height) > 0 else half
    dividers = float(np.max(np.asarray(container.divider_height)))
    rng = np.random.default_rng(random_seed)
    fault = "the container is too small for the parts"
    for _ in range(1 if starts is not None else config.attempts):
        if starts is not None:
            begin = np.stack([body.from_object(start) for body, start in zip(bodies, starts, strict=True)])
        else:
            spawned = spawn(bodies, np.append(2 * half, 0) * SIMULATED_DIAGONAL, rng)
            if spawned is None:
                continue
            spawned[:, 2, 3] += dividers * SIMULATED_DIAGONAL
            begin = spawned
        end = simulate(bodies, begin, lambda spec, contact: _add_blocks(spec, contact, blocks), config)
        most = config.penetration * SIMULATED_DIAGONAL
        deep = f"parts penetrate by {end.penetration / SIMULATED_DIAGONAL:.2%} of the diagonal"
        fault = end.fault or (deep if end.penetration > most else "")
        if not fault:
            places = np.stack([_centre(body, pose) for body, pose in zip(bodies, end.T_world_body, strict=True)])
            places /= SIMULATED_DIAGONAL
            inside = (np.abs(places[:, :2]) <= outer + _ASIDE).all(axis=1) & (places[:, 2] > 0)
            poses = [body.to_object(pose[None])[0] for body, pose in zip(bodies, end.T_world_body, strict=True)]
            return WorldDrop(np.stack(poses), inside)
    return WorldDrop(np.zeros((0, 4, 4)), np.zeros(0, dtype=bool), fault)


def rows_of(
    shape: CollisionShape, rows: tuple[int, int], config: BinConfig, random_seed: int | Sequence[int]
) -> tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, "2"]]:
    """Return poses of parts that lie side by side, and half the length and width that they cover, in diagonals.

    They lie as the one that came to rest lowest, of a few that fell alone. Raises InputError if none comes to rest.
    """
    rng = np.random.default_rng(random_seed)
    body = Body(shape)
    flat, none = jnp.zeros(2), jnp.zeros(())
    alone = Container(flat + 2, none, none, none, none, flat, flat, none, jnp.full((), jnp.inf))
    drops = [settle_in([shape], alone, config, rng.integers(1 << 31).item()) for _ in range(_DROPS)]
    rests = [drop.T_world_object[0] for drop in drops if not drop.fault]
    if not rests:
        raise InputError(f"the part does not come to rest: {drops[-1].fault}")
    lying = min(rests, key=lambda pose: float(pose[2, :3] @ shape.center + pose[2, 3]))
    corners = body.corners / body.scale @ shape.R_object_principal.T
    rotation = min(
        (_about_z(angle) @ lying[:3, :3] for angle in np.radians(range(0, 180, 3))),
        key=lambda turn: float(np.ptp(corners @ turn.T, axis=0)[:2].prod()),
    )
    corners = corners @ rotation.T
    size = np.ptp(corners, axis=0)
    lowest = corners.min(axis=0) + size * [0.5, 0.5, 0]  # the middle of the underside, from the centre of mass
    poses = np.tile(np.eye(4), (rows[0] * rows[1], 1, 1))
    for number, pose in enumerate(poses):
        place = (np.array(divmod(number, rows[1])) - (np.array(rows) - 1) / 2) * size[:2] * _TOUCHING
        pose[:3, :3] = rotation
        pose[:3, 3] = np.append(place, 1e-3 * shape.diagonal) - lowest - rotation @ shape.center
    return poses, np.array(rows) * size[:2] * _TOUCHING / 2 / shape.diagonal


def _about_z(angle: float) -> Float[np.ndarray, "3 3"]:
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def _add_blocks(spec: Any, contact: dict[str, Any], blocks: list[Float[np.ndarray, "8 3"]]) -> None:
    import mujoco

    for number, block in enumerate(blocks):
        spec.add_mesh(name=f"block{number}", uservert=block.ravel())
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"block{number}", **contact)


def _centre(body: Body, T_world_body: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
    middle = (body.corners.min(axis=0) + body.corners.max(axis=0)) / 2
    return T_world_body[:3, :3] @ middle + T_world_body[:3, 3]
