"""Copies of an object settle in a bin: rigid-body simulation, and what a scene must satisfy to be used."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from kmn_jax.checks import InputError
from kmn_jax.data.hulls import CollisionShape
from kmn_jax.data.scene import Bin

SIMULATED_DIAGONAL = 0.1  # metres: the parameters below are tuned for objects of this size under earth's gravity
GRAVITY = 9.81
WALLS = ((1, 0), (-1, 0), (0, 1), (0, -1))  # outward directions of the bin's four walls


@dataclass(frozen=True)
class BinConfig:
    """How copies are dropped, simulated and accepted. Lengths are in diagonals of the object, times in seconds.

    The bin is `length` x `width` x `height` times one factor, drawn for each attempt from `scale`; factors whose bin
    would overflow, at `packing` (hulls' volume to filled volume), are left out.
    """

    length: float = 3.4
    width: float = 2.4
    height: float = 1.2
    thickness: float = 0.05
    scale: tuple[float, float] = (0.7, 1.1)
    packing: float = 0.4

    step: float = 0.002
    friction: float = 0.5
    damping: tuple[float, float] = (1.0, 0.5)  # of the speed and of the rotation, per second
    check_every: float = 0.1
    rest_checks: int = 2
    rest_speed: float = 0.15  # diagonals per second
    rest_rotation: float = 0.3  # radians per second
    time_cap: float = 4.0

    penetration: float = 0.003
    overlap: float = 0.003  # of hulls and the bin's walls and floor
    attempts: int = 8

    def __post_init__(self) -> None:
        for name in ("length", "width", "height", "thickness", "step", "check_every", "time_cap", "penetration"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"bin config: {name} is {getattr(self, name)}, but must be above zero and finite")
        if not 0 < self.scale[0] <= self.scale[1] < math.inf:
            raise InputError(f"bin config: scale is {self.scale}, but must be a range above zero")
        if not 0 < self.packing <= 1:
            raise InputError(f"bin config: packing is {self.packing}, but must be above 0 and at most 1")
        if self.attempts < 1 or self.rest_checks < 1:
            raise InputError("bin config: attempts and rest_checks must be 1 or more")
        if self.check_every < self.step:
            raise InputError("bin config: check_every is shorter than one step")


@dataclass(frozen=True)
class DropResult:
    """What became of a drop. Poses and bin are in the object's unit, and of the last attempt where none was accepted.

    `penetration`: the deepest contact; `speed`: of the fastest copy, a second; both in diagonals. `capped`: not at rest
    when the time was over. `floor_share`: copies that touch the floor. `rejected`: why each attempt was not used.
    """

    accepted: bool
    T_bin_object: Float[np.ndarray, "n 4 4"]
    bin: Bin
    penetration: float
    speed: float
    rotation: float
    simulated_time: float
    capped: bool
    floor_share: float
    attempts: int
    rejected: tuple[str, ...]


@dataclass(frozen=True)
class _Rest:
    """The end of one simulation, in simulated metres."""

    T_bin_body: np.ndarray
    penetration: float
    speed: float
    rotation: float
    time: float
    floor_share: float
    above_rim: bool


def settle(shape: CollisionShape, copies: int, config: BinConfig, seed: int | Sequence[int]) -> DropResult:
    """Drop copies of an object into a bin and let them come to rest.

    The same arguments give the same bits on one machine. That nothing was accepted is told by the result, never by an
    exception.

    Args:
        shape: collision shape of the object, see `collision_shape`.
        copies: how many, 1 or more.
        seed: a number, or several (of the run, of the object, of the drop).

    Raises:
        InputError: there are no copies, or the shape is not finite.
    """
    if copies < 1:
        raise InputError(f"copies is {copies}, but a bin needs 1 or more")
    if not (math.isfinite(shape.diagonal) and shape.diagonal > 0 and math.isfinite(shape.volume) and shape.volume > 0):
        raise InputError(
            f"the collision shape has diagonal {shape.diagonal} and volume {shape.volume}: both must be > 0"
        )
    rng = np.random.default_rng(seed)
    scales = _bin_scales(shape, copies, config)
    body = _Body(shape)
    rejected: list[str] = []
    for attempt in range(1, config.attempts + 1):
        factor = SIMULATED_DIAGONAL * rng.uniform(*scales)
        size = np.array([config.length, config.width, config.height]) * factor
        spawned = _spawn(body, copies, size, rng)
        if spawned is None:
            rejected.append("the bin is too small to drop the object into it")
            continue
        rest = _simulate(body, spawned, size, config)
        reasons = _faults(body, rest, size, config)
        if not reasons:
            return _result(True, body, rest, size, attempt, rejected, config)
        rejected.append(reasons)
    if spawned is None:
        rest = _Rest(np.zeros((0, 4, 4)), 0.0, 0.0, 0.0, 0.0, 0.0, False)
    return _result(False, body, rest, size, config.attempts, rejected, config)


class _Body:
    """The shape as it is simulated: diagonal 0.1 m, centre of mass at the origin, principal axes along the axes."""

    def __init__(self, shape: CollisionShape) -> None:
        self.shape = shape
        self.scale = SIMULATED_DIAGONAL / shape.diagonal
        self.parts = [(part - shape.center) @ shape.R_object_principal * self.scale for part in shape.parts]
        self.corners = np.concatenate(self.parts)
        self.mass = 1000.0 * shape.volume * self.scale**3
        self.inertia = shape.inertia * self.scale**2 * self.mass

    def to_object(self, T_bin_body: np.ndarray) -> np.ndarray:
        """Return the poses of the object itself, in its own unit."""
        rotation = T_bin_body[:, :3, :3] @ self.shape.R_object_principal.T
        T_bin_object = np.tile(np.eye(4), (len(T_bin_body), 1, 1))
        T_bin_object[:, :3, :3] = rotation
        T_bin_object[:, :3, 3] = T_bin_body[:, :3, 3] / self.scale - rotation @ self.shape.center
        return T_bin_object


def _bin_scales(shape: CollisionShape, copies: int, config: BinConfig) -> tuple[float, float]:
    """Return the range of scales whose bins hold the copies; the largest bin where none does."""
    room = config.length * config.width * config.height * shape.diagonal**3 * config.packing
    least = (copies * shape.volume / room) ** (1 / 3)
    return min(max(config.scale[0], least), config.scale[1]), config.scale[1]


def _spawn(body: _Body, copies: int, size: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """Return random poses above the floor, each copy lowered until its box would touch another's; None without room."""
    from scipy.spatial.transform import Rotation

    gap = 0.02 * SIMULATED_DIAGONAL
    boxes: list[tuple[np.ndarray, np.ndarray]] = []
    poses = np.tile(np.eye(4), (copies, 1, 1))
    for pose in poses:
        for _ in range(20):
            rotation = Rotation.random(rng=rng).as_matrix()
            corners = body.corners @ rotation.T
            low, high = corners.min(axis=0) - gap, corners.max(axis=0) + gap
            room = size[:2] - (high - low)[:2]
            if (room > 0).all():
                break
        else:
            return None
        best = None
        for _ in range(4):
            at = np.append(rng.uniform(size=2) * room - size[:2] / 2 - low[:2], -low[2])
            below = [
                top[2]
                for bottom, top in boxes
                if (bottom[:2] < (high + at)[:2]).all() and (top[:2] > (low + at)[:2]).all()
            ]
            at[2] += max(below, default=0.0)
            if best is None or at[2] < best[2]:
                best = at
        pose[:3, :3], pose[:3, 3] = rotation, best
        boxes.append((low + best, high + best))
    return poses


def _model(body: _Body, copies: int, size: np.ndarray, config: BinConfig) -> Any:
    """Return the mujoco model: four walls and a floor as planes, one free body a copy."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.option.timestep = config.step
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.iterations = 30
    spec.option.tolerance = 1e-7
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    spec.option.gravity = [0, 0, -GRAVITY]
    contact: dict[str, Any] = {
        "condim": 4,
        "friction": [config.friction, 0.005, 0.0001],
        "solref": [0.005, 1],
        "solimp": [0.95, 0.99, 0.0005, 0.5, 2],
    }
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name="floor", type=plane, size=[1, 1, 1], **contact)
    for number, (x, y) in enumerate(WALLS):
        position = [x * size[0] / 2, y * size[1] / 2, 0]
        spec.worldbody.add_geom(
            name=f"wall{number}", type=plane, size=[1, 1, 1], pos=position, zaxis=[-x, -y, 0], **contact
        )
    for number, part in enumerate(body.parts):
        spec.add_mesh(name=f"part{number}", uservert=part.ravel())
    for _ in range(copies):
        added = spec.worldbody.add_body(mass=body.mass, inertia=body.inertia, explicitinertial=True)
        added.add_freejoint()
        for number in range(len(body.parts)):
            added.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"part{number}", mass=0, **contact)
    model = spec.compile()
    model.dof_damping[:] = np.tile(
        np.concatenate([np.full(3, body.mass * config.damping[0]), body.inertia * config.damping[1]]), copies
    )
    return model


def _simulate(body: _Body, T_bin_body: np.ndarray, size: np.ndarray, config: BinConfig) -> _Rest:
    import mujoco
    from scipy.spatial.transform import Rotation

    copies = len(T_bin_body)
    model = _model(body, copies, size, config)
    data = mujoco.MjData(model)
    quaternions = Rotation.from_matrix(T_bin_body[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    data.qpos[:] = np.concatenate([T_bin_body[:, :3, 3], quaternions], axis=1).ravel()
    steps = round(config.check_every / config.step)
    calm, finite = 0, True
    speed = rotation = math.inf
    while calm < config.rest_checks and data.time < config.time_cap - config.step / 2 and finite:
        mujoco.mj_step(model, data, nstep=steps)
        velocity = data.qvel.reshape(copies, 2, 3)
        finite = bool(np.isfinite(data.qpos).all() and np.isfinite(velocity).all()) and not data.warning.number.any()
        speed, rotation = np.linalg.norm(velocity, axis=2).max(axis=0)
        still = speed < config.rest_speed * SIMULATED_DIAGONAL and rotation < config.rest_rotation
        calm = calm + 1 if still else 0
    mujoco.mj_forward(model, data)
    poses = np.tile(np.eye(4), (copies, 1, 1))
    if finite:
        poses[:, :3, 3] = data.xpos[1:]
        poses[:, :3, :3] = data.xmat[1:].reshape(copies, 3, 3)
    geoms, distances = data.contact.geom, data.contact.dist
    on_floor = np.unique(model.geom_bodyid[geoms[(geoms == 0).any(axis=1)]])
    on_wall = ((geoms > 0) & (geoms <= len(WALLS))).any(axis=1)
    return _Rest(
        T_bin_body=poses,
        penetration=float(max(0.0, -distances.min(initial=0.0))) if finite else math.inf,
        speed=float(speed),
        rotation=float(rotation),
        time=float(data.time),
        floor_share=(len(on_floor) - (0 in on_floor)) / copies,
        above_rim=bool((data.contact.pos[on_wall, 2] > size[2]).any()),
    )


def _at_rest(rest: _Rest, config: BinConfig) -> bool:
    return rest.speed < config.rest_speed * SIMULATED_DIAGONAL and rest.rotation < config.rest_rotation


def _faults(body: _Body, rest: _Rest, size: np.ndarray, config: BinConfig) -> str:
    """Return why a scene cannot be used; empty if it can."""
    faults = []
    if not math.isfinite(rest.penetration):
        return "the simulation diverged"
    if rest.penetration > config.penetration * SIMULATED_DIAGONAL:
        faults.append(f"copies penetrate by {rest.penetration / SIMULATED_DIAGONAL:.2%} of the diagonal")
    corners = np.einsum("nij,vj->nvi", rest.T_bin_body[:, :3, :3], body.corners) + rest.T_bin_body[:, None, :3, 3]
    beyond = max((np.abs(corners[..., :2]) - size[:2] / 2).max(), -corners[..., 2].min())
    if beyond > config.overlap * SIMULATED_DIAGONAL:
        faults.append(f"a copy is {beyond / SIMULATED_DIAGONAL:.2%} of the diagonal inside of a wall or the floor")
    if rest.above_rim:
        faults.append("a copy leans on the wall above the rim")
    return ", ".join(faults)


def _result(
    accepted: bool, body: _Body, rest: _Rest, size: np.ndarray, attempts: int, rejected: list[str], config: BinConfig
) -> DropResult:
    length, width, height = (float(value) for value in size / body.scale)
    return DropResult(
        accepted=accepted,
        T_bin_object=body.to_object(rest.T_bin_body),
        bin=Bin(length, width, height, config.thickness * body.shape.diagonal),
        penetration=rest.penetration / SIMULATED_DIAGONAL,
        speed=rest.speed / SIMULATED_DIAGONAL,
        rotation=rest.rotation,
        simulated_time=rest.time,
        capped=not _at_rest(rest, config),
        floor_share=rest.floor_share,
        attempts=attempts,
        rejected=tuple(rejected),
    )
