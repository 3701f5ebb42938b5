"""Copies of an object settle in a bin: rigid-body simulation, and what a scene must satisfy to be used."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from kmn_jax.errors import InputError
from kmn_jax.simulate._bin_scene import Bin
from kmn_jax.simulate._hulls import CollisionShape

SIMULATED_DIAGONAL = 0.1  # metres: the parameters below are tuned for objects of this size under earth's gravity
GRAVITY = 9.81
WALLS = ((1, 0), (-1, 0), (0, 1), (0, -1))  # outward directions of the bin's four walls


@dataclass(frozen=True)
class BinConfig:
    """How copies are dropped, simulated and accepted. Lengths are in diagonals of the object, times in seconds.

    Each attempt draws its bin: `length` x `width` times one factor from the range `scale`, of a height from the range
    `height`. Factors whose bin would overflow, where copies fill the share `packing` of the space, are left out. Small
    factors pile copies higher: of 20, about 80% touch the floor at 1.0, and 40% at 0.65.
    """

    length: float = 3.4
    width: float = 2.4
    scale: tuple[float, float] = (0.6, 1.05)
    height: tuple[float, float] = (1.0, 1.4)
    thickness: float = 0.05
    packing: float = 0.35

    step: float = 0.002
    friction: float = 0.5
    damping: tuple[float, float] = (1.0, 0.5)  # of speed and of rotation, per second
    check_every: float = 0.1
    rest_checks: int = 2
    rest_speed: float = 0.15  # diagonals per second
    rest_rotation: float = 0.3  # radians per second
    time_cap: float = 4.0

    penetration: float = 0.003  # the most that an accepted scene shows in a contact, and in walls and floor
    attempts: int = 8

    def __post_init__(self) -> None:
        sizes, times = ("length", "width", "thickness"), ("step", "check_every", "time_cap")
        for name in (*sizes, *times, "friction", "rest_speed", "rest_rotation", "penetration"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"bin config: {name} is {getattr(self, name)}, but must be above zero and finite")
        for name in ("scale", "height"):
            low, high = getattr(self, name)
            if not 0 < low <= high < math.inf:
                raise InputError(f"bin config: {name} is {(low, high)}, but must be a range above zero")
        if not 0 <= min(self.damping) <= max(self.damping) < math.inf:
            raise InputError(f"bin config: damping is {self.damping}, but must be 0 or more, and finite")
        if not 0 < self.packing <= 1:
            raise InputError(f"bin config: packing is {self.packing}, but must be above 0 and at most 1")
        if self.attempts < 1 or self.rest_checks < 1:
            raise InputError("bin config: attempts and rest_checks must be 1 or more")
        if self.check_every < self.step:
            raise InputError("bin config: check_every is shorter than one step")


@dataclass(frozen=True, eq=False)
class DropResult:
    """What became of a drop. Poses and bin are in the object's unit, and of the last attempt where none was accepted.

    `penetration` is the deepest contact, in diagonals. `capped` means not at rest when the time was over. `floor_share`
    of the copies touch the floor. `rejected` says why each attempt was not used. There are no poses where not even
    dropping was possible.
    """

    accepted: bool
    T_bin_object: Float[np.ndarray, "n 4 4"]
    bin: Bin
    penetration: float
    capped: bool
    floor_share: float
    attempts: int
    rejected: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Rest:
    """The end of one simulation, in simulated metres, and why it cannot be used; empty if it can."""

    T_bin_body: np.ndarray
    faults: str
    penetration: float = 0.0
    capped: bool = False
    floor_share: float = 0.0


def settle(shape: CollisionShape, copies: int, config: BinConfig, random_seed: int | Sequence[int]) -> DropResult:
    """Drop copies of an object into a bin and let them come to rest.

    The same arguments give the same bits on one machine. That nothing could be accepted is told by the result, never by
    an exception.

    Args:
        shape: collision shape of the object, see `collision_shape`.
        copies: how many, 1 or more.
        random_seed: one number or several, 0 or more, such as those of the run, of the object and of the drop.

    Raises:
        InputError: there are no copies, or a random seed is negative.
    """
    if copies < 1:
        raise InputError(f"copies is {copies}, but a bin needs 1 or more")
    if np.min(random_seed, initial=0) < 0:
        raise InputError(f"random_seed is {random_seed}, but must be 0 or more")
    rng = np.random.default_rng(random_seed)
    body = Body(shape)
    room = config.packing * config.length * config.width * config.height[0] * shape.diagonal**3
    most = config.scale[1]
    least = min(max(config.scale[0], math.sqrt(copies * shape.volume / room)), most)
    rejected: list[str] = []
    for _ in range(config.attempts):
        scale = rng.uniform(least, most)
        size = np.array([config.length * scale, config.width * scale, rng.uniform(*config.height)]) * SIMULATED_DIAGONAL
        spawned = spawn([body] * copies, size, rng)
        if spawned is None or copies * body.volume > size.prod():
            rest = _Rest(np.zeros((0, 4, 4)), "the bin is too small for the copies")
        else:
            rest = _rest_in_bin(body, spawned, size, config)
        if not rest.faults:
            break
        rejected.append(rest.faults)
        least = min(max(least, 1.1 * scale), most)  # most faults are those of a bin that is too full
    length, width, height = (float(value) for value in size / body.scale)
    return DropResult(
        accepted=not rest.faults,
        T_bin_object=body.to_object(rest.T_bin_body),
        bin=Bin(length, width, height, config.thickness * shape.diagonal),
        penetration=rest.penetration / SIMULATED_DIAGONAL,
        capped=rest.capped,
        floor_share=rest.floor_share,
        attempts=len(rejected) + (not rest.faults),
        rejected=tuple(rejected),
    )


class Body:
    """A shape as it is simulated: centre of mass at the origin, principal axes along the axes.

    Unless another scale is given, that of the shapes among which it lies, its diagonal is 0.1 m.
    """

    def __init__(self, shape: CollisionShape, scale: float | None = None) -> None:
        self.shape = shape
        self.scale = SIMULATED_DIAGONAL / shape.diagonal if scale is None else scale
        self.parts = [(part - shape.center) @ shape.R_object_principal * self.scale for part in shape.parts]
        self.corners = np.concatenate(self.parts)
        self.volume = shape.volume * self.scale**3
        self.mass = 1000.0 * self.volume
        self.inertia = shape.inertia * self.scale**2 * self.mass

    def to_object(self, T_bin_body: np.ndarray) -> np.ndarray:
        """Return the poses of the object itself, in its own unit."""
        rotation = T_bin_body[:, :3, :3] @ self.shape.R_object_principal.T
        T_bin_object = np.tile(np.eye(4), (len(T_bin_body), 1, 1))
        T_bin_object[:, :3, :3] = rotation
        T_bin_object[:, :3, 3] = T_bin_body[:, :3, 3] / self.scale - rotation @ self.shape.center
        return T_bin_object

    def from_object(self, T_bin_object: np.ndarray) -> np.ndarray:
        """Return the pose of the simulated body, in metres, of an object at a pose."""
        T_bin_body = np.eye(4)
        T_bin_body[:3, :3] = T_bin_object[:3, :3] @ self.shape.R_object_principal
        T_bin_body[:3, 3] = self.scale * (T_bin_object[:3, :3] @ self.shape.center + T_bin_object[:3, 3])
        return T_bin_body


def spawn(bodies: Sequence[Body], size: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """Return random poses above the floor, each body lowered until its box would touch another's; None without room."""
    from scipy.spatial.transform import Rotation

    gap = 0.02 * SIMULATED_DIAGONAL
    lows, highs = np.zeros((0, 3)), np.zeros((0, 3))
    poses = np.tile(np.eye(4), (len(bodies), 1, 1))
    for body, pose in zip(bodies, poses, strict=True):
        for rotation in Rotation.random(20, rng=rng).as_matrix():
            corners = body.corners @ rotation.T
            low, high = corners.min(axis=0) - gap, corners.max(axis=0) + gap
            room = size[:2] - (high - low)[:2]
            if (room > 0).all():
                break
        else:
            return None
        places = []
        for x, y in rng.uniform(size=(4, 2)) * room - size[:2] / 2 - low[:2]:
            place = np.array([x, y, -low[2]])
            under = ((lows < high + place) & (highs > low + place))[:, :2].all(axis=1)
            place[2] += highs[under, 2].max(initial=0.0)
            places.append(place)
        place = min(places, key=lambda xyz: xyz[2])
        pose[:3, :3], pose[:3, 3] = rotation, place
        lows, highs = np.vstack([lows, low + place]), np.vstack([highs, high + place])
    return poses


def _model(bodies: Sequence[Body], fixtures: Callable[[Any, dict[str, Any]], None], config: BinConfig) -> Any:
    """Return the mujoco model: what `fixtures` adds to a specification, and one free body for each of the bodies."""
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
    fixtures(spec, contact)
    kinds = list(dict.fromkeys(bodies))
    for kind, body in enumerate(kinds):
        for number, part in enumerate(body.parts):
            spec.add_mesh(name=f"part{kind}_{number}", uservert=part.ravel())
    for body in bodies:
        added = spec.worldbody.add_body(mass=body.mass, inertia=body.inertia, explicitinertial=True)
        added.add_freejoint()
        for number in range(len(body.parts)):
            name = f"part{kinds.index(body)}_{number}"
            added.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, mass=0, **contact)
    model = spec.compile()
    model.dof_damping[:] = np.concatenate(
        [[*np.full(3, body.mass * config.damping[0]), *(body.inertia * config.damping[1])] for body in bodies]
    )
    return model


def add_planes(spec: Any, contact: dict[str, Any], size: np.ndarray) -> None:
    """Add a bin's floor and four walls as planes, the geoms 0 to 4."""
    import mujoco

    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name="floor", type=plane, size=[1, 1, 1], **contact)
    for number, (x, y) in enumerate(WALLS):
        position = [x * size[0] / 2, y * size[1] / 2, 0]
        spec.worldbody.add_geom(
            name=f"wall{number}", type=plane, size=[1, 1, 1], pos=position, zaxis=[-x, -y, 0], **contact
        )


@dataclass(frozen=True, eq=False)
class Motion:
    """Where bodies are when a simulation ends, in simulated metres, and what it says; `fault` is empty if it went well.

    `touching` holds the numbers of the two bodies of each contact, from 1, 0 for what is fixed, and `geoms` of their
    geoms, fixed ones first.
    """

    T_world_body: np.ndarray
    fault: str
    penetration: float = 0.0
    capped: bool = False
    touching: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), dtype=int))
    geoms: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), dtype=int))
    places: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # of the contacts


def simulate(
    bodies: Sequence[Body],
    T_world_body: np.ndarray,
    fixtures: Callable[[Any, dict[str, Any]], None],
    config: BinConfig,
) -> Motion:
    """Let bodies fall until they rest, or the time is over, or mujoco warns."""
    import mujoco
    from scipy.spatial.transform import Rotation

    try:
        model = _model(bodies, fixtures, config)
    except ValueError as error:
        return Motion(T_world_body, f"mujoco refuses the shape: {error}")
    data = mujoco.MjData(model)
    quaternions = Rotation.from_matrix(T_world_body[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    data.qpos[:] = np.concatenate([T_world_body[:, :3, 3], quaternions], axis=1).ravel()
    steps = round(config.check_every / config.step)
    checks, calm = max(1, round(config.time_cap / config.check_every)), 0
    # Lest mujoco writes a log file into the working directory; its warnings are counted in the data.
    previous = mujoco.get_mju_user_warning()
    for _ in range(checks):
        mujoco.set_mju_user_warning(lambda message: None)
        try:
            mujoco.mj_step(model, data, nstep=steps)
        finally:
            mujoco.set_mju_user_warning(previous)
        if data.warning.number.any():
            break
        speed, rotation = np.linalg.norm(data.qvel.reshape(len(bodies), 2, 3), axis=2).max(axis=0)
        still = speed < config.rest_speed * SIMULATED_DIAGONAL and rotation < config.rest_rotation
        calm = calm + 1 if still else 0
        if calm == config.rest_checks:
            break
    warned = np.flatnonzero(data.warning.number)
    if warned.size:
        names = ", ".join(mujoco.mjtWarning(int(kind)).name for kind in warned)
        return Motion(T_world_body, f"the simulation broke down: {names}")
    mujoco.mj_forward(model, data)  # contacts of the last pose
    poses = np.tile(np.eye(4), (len(bodies), 1, 1))
    poses[:, :3, 3] = data.xpos[1:]
    poses[:, :3, :3] = data.xmat[1:].reshape(len(bodies), 3, 3)
    return Motion(
        poses,
        "",
        max(0.0, -float(data.contact.dist.min(initial=0.0))),
        calm < config.rest_checks,
        model.geom_bodyid[data.contact.geom],
        data.contact.geom.copy(),
        data.contact.pos.copy(),
    )


def _rest_in_bin(body: Body, T_bin_body: np.ndarray, size: np.ndarray, config: BinConfig) -> _Rest:
    """Let the copies of a body fall into a bin, and judge how they lie."""
    copies = len(T_bin_body)
    end = simulate([body] * copies, T_bin_body, lambda spec, contact: add_planes(spec, contact, size), config)
    if end.fault:
        return _Rest(T_bin_body, end.fault)
    on_floor = end.touching[(end.geoms == 0).any(axis=1)]
    on_wall = ((end.geoms > 0) & (end.geoms <= len(WALLS))).any(axis=1)
    corners = np.einsum("nij,vj->nvi", end.T_world_body[:, :3, :3], body.corners) + end.T_world_body[:, None, :3, 3]
    beyond = float(max((np.abs(corners[..., :2]) - size[:2] / 2).max(), -corners[..., 2].min()))
    faults, most = [], config.penetration * SIMULATED_DIAGONAL
    if end.penetration > most:
        faults.append(f"copies penetrate by {end.penetration / SIMULATED_DIAGONAL:.2%} of the diagonal")
    if beyond > most:
        faults.append(f"a copy reaches {beyond / SIMULATED_DIAGONAL:.2%} of the diagonal into a wall or the floor")
    if (end.places[on_wall, 2] > size[2]).any():
        faults.append("a copy leans on the wall above the rim")
    if len(np.unique(end.touching[end.touching > 0])) < copies:
        faults.append("a copy touches nothing")
    floor_share = len(np.unique(on_floor[on_floor > 0])) / copies
    return _Rest(end.T_world_body, ", ".join(faults), end.penetration, end.capped, floor_share)
