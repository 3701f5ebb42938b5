"""Grasps of a part: where a gripper may hold it, and the gripper as a few boxes; and the file that says so."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from kmn_jax.errors import InputError, finite_numbers, known_fields, shown
from kmn_jax.io import in_other_unit, pose_of, read_file
from kmn_jax.limits import parse_json
from kmn_jax.units import METRES, check_unit


@dataclass(frozen=True, eq=False)
class Gripper:
    """A gripper in its own frame: it approaches along z, two fingers close along x, the origin is between their tips.

    Lengths are in the unit of the grasps that it is for.
    """

    centers: Float[np.ndarray, "b 3"]  # of boxes that do not move with the width
    sizes: Float[np.ndarray, "b 3"]
    finger: Float[np.ndarray, "3"] | None = None  # each one's thickness along x, breadth along y and length along z
    reach: float = 0.0  # how far fingertips are beyond the origin
    approach: float = 0.0  # how far it comes, and goes again, straight along z

    def boxes(self, width: float) -> tuple[Float[np.ndarray, "c 3"], Float[np.ndarray, "c 3"]]:
        """Return centres and sizes of the boxes that it sweeps as it comes, the fingers `width` apart."""
        centers, sizes = self.centers, self.sizes
        if self.finger is not None:
            thickness, _, length = self.finger
            x, z = (width + thickness) / 2, self.reach - length / 2
            centers = np.concatenate([centers, [[-x, 0, z], [x, 0, z]]])
            sizes = np.concatenate([sizes, [self.finger, self.finger]])
        back = np.array([0, 0, self.approach])
        return centers - back / 2, sizes + back


@dataclass(frozen=True, eq=False)
class Grasp:
    """One way to hold a part."""

    name: str
    T_object_grasp: Float[np.ndarray, "4 4"]  # the gripper's frame in the part's
    width: float = 0.0  # between the fingers


@dataclass(frozen=True)
class Grasps:
    """The ways to hold a part, the preferred one first, and the gripper. Lengths are in `unit`."""

    unit: str
    gripper: Gripper
    grasps: tuple[Grasp, ...]

    def in_unit(self, unit: str) -> Grasps:
        """Return the same grasps with their lengths in another unit."""
        factor, own = METRES[self.unit] / METRES[check_unit(unit)], self.gripper
        gripper = Gripper(
            own.centers * factor,
            own.sizes * factor,
            None if own.finger is None else own.finger * factor,
            own.reach * factor,
            own.approach * factor,
        )
        return Grasps(
            unit,
            gripper,
            tuple(
                replace(
                    one, T_object_grasp=in_other_unit(one.T_object_grasp, self.unit, unit), width=one.width * factor
                )
                for one in self.grasps
            ),
        )


def load_grasps(path: str | Path) -> Grasps:
    """Read a file of grasps, JSON as docs/grasps.md describes it. Raises InputError if it is none."""
    path = Path(path)
    content = read_file(path, "a file of grasps")
    try:
        found = parse_json(content.decode("utf-8"))
        return _grasps(known_fields(found, "the file", {"unit", "gripper", "grasps"}))
    except ValueError as error:  # InputError is one
        raise InputError(f"{path} cannot be used as grasps: {shown(error)}") from None


def _grasps(found: Mapping[str, Any]) -> Grasps:
    if "unit" not in found:
        raise InputError('it has no unit: say which its lengths are in, such as "unit": "mm"')
    own = known_fields(found.get("gripper"), "gripper", {"boxes", "fingers", "approach"})
    boxes = [
        known_fields(box, f"box {number} of the gripper", {"center", "size"})
        for number, box in enumerate(_list(own.get("boxes", []), "boxes of the gripper"), start=1)
    ]
    centers = [_numbers(box.get("center"), "center of a box") for box in boxes]
    sizes = [_numbers(box.get("size"), "size of a box", above_zero=True) for box in boxes]
    finger, reach = None, 0.0
    if "fingers" in own:
        fingers = known_fields(own["fingers"], "fingers", {"size", "reach"})
        finger = _numbers(fingers.get("size"), "size of the fingers", above_zero=True)
        reach = _number(fingers.get("reach", 0), "reach of the fingers", -np.inf)
    if not boxes and finger is None:
        raise InputError("its gripper has neither boxes nor fingers")
    gripper = Gripper(
        np.array(centers).reshape(-1, 3),
        np.array(sizes).reshape(-1, 3),
        finger,
        reach,
        _number(own.get("approach", 0.0), "approach", 0.0),
    )
    grasps = []
    for number, value in enumerate(_list(found.get("grasps"), "grasps"), start=1):
        one = known_fields(value, f"grasp {number}", {"name", "width", "T_object_grasp", "xyz", "xyzw"})
        width = _number(one.get("width", 0), f"width of grasp {number}", 0.0)
        try:
            pose = pose_of(one, "T_object_grasp")
        except InputError as error:
            raise InputError(f"grasp {number}: {error}") from None
        grasps.append(Grasp(str(one.get("name", number)), pose, width))
    if not grasps:
        raise InputError("it holds no grasps")
    return Grasps(check_unit(str(found["unit"])), gripper, tuple(grasps))


def _list(value: Any, name: str) -> list[Any]:
    if not isinstance(value, list):
        raise InputError(f"{name} must be a list")
    return value


def _numbers(value: Any, name: str, above_zero: bool = False) -> Float[np.ndarray, "3"]:
    numbers = finite_numbers(value, f"the {name}", 3)
    if above_zero and not (numbers > 0).all():
        raise InputError(f"the {name} must be 3 numbers above zero, x, y and z")
    return numbers


def _number(value: Any, name: str, least: float) -> float:
    real = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
    if not real or value < least:
        raise InputError(f"the {name} must be a number{'' if least < 0 else ' of zero or more'}")
    return float(value)
