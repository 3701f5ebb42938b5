"""Whether the lengths of an object and of a scene can belong together, and which unit would make them fit.

Files of clouds and depth images state no unit, and a wrong one is the commonest mistake with them. Nothing is changed
here, and no unit is guessed in silence: `resolve_unit` takes what was asked for, `length_problem` tells in one sentence
if that cannot be true. Its limits leave room for a single part and for a large bin of small ones. So a mistake by 1000
is found always, as it leads from one limit beyond the other, but one by 10 or 25.4 only for scenes near to a limit; and
centimetres and inches are too much alike to be told apart, so that the sentence names what else would fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from kmn_jax.errors import InputError
from kmn_jax.io._scans import Scan
from kmn_jax.units import METRES, check_unit

AUTO = "auto"
_ASSUMED = "mm"  # of objects whose files state no unit
_NAMES = {"mm": "millimetres", "cm": "centimetres", "m": "metres", "in": "inches"}
_PERCENTILES = (1, 99)  # of each axis: what lies beyond may be stray points
_SAMPLE = 2_000  # points whose neighbours are looked for
_MOST = 1_000_000  # points to look for them among

# What can be, each in diameters of the object: a view of a single part shows half of it at least, and a part that is
# far smaller than its scene, or not wider than three points are apart, cannot be found in it.
_EXTENT = (1 / 3, 200.0)
_DISTANCE = (1 / 3, 500.0)
_POINTS_ACROSS = 3.0

# What is usual; it only ranks units that can be. First in diameters, then in metres.
_USUAL_EXTENT, _USUAL_DISTANCE = (0.7, 20.0), (3.0, 40.0)
_USUAL_SIZES = {"object": (0.003, 0.5), "scene": (0.03, 2.0), "distance": (0.15, 3.0)}
_REAL_SIZES = (0.0005, 5.0)  # of an object: others bring a question
_NEAR_BASE = 0.1  # diameters of the part: a camera so near to a robot's base brings a question, ...
_FAR_FROM_BASE = 100.0  # metres: ... as does one so far away, ...
_USUAL_REACH = (0.1, 10.0)  # metres: ... if it would be there in another unit
_RARE = {"mm": 0.0, "m": 0.2, "in": 0.7, "cm": 1.0}
_RARE_MISTAKE = {"scene": 0.0, "object": 0.5}
_DOUBTFUL = 2.5  # units that are more unusual by less may be what a user means where nothing is found
_CLOSE = 1.0  # units that are not much more unusual than the best one, or than the one assumed, are named, too


@dataclass(frozen=True)
class UnitWords:
    """What says the unit of a scene's and of an object's lengths, with {} for mm, cm, m or in; by default flags."""

    scene: str = "--units {}"
    object: str = "--object-units {}"
    steps: str | None = "depth_scale in the camera file"  # what says how far one step of a stored depth is, if it can


_FLAGS = UnitWords()


@dataclass(frozen=True)
class SceneSize:
    """How large a scene is, in `unit`."""

    extent: float  # diagonal of the axis-aligned box around its points, without the outermost 1% along each axis
    spacing: float  # median distance of a point to the nearest other one
    distance: float | None  # median distance from the sensor, if it is known where that was
    unit: str


def resolve_unit(asked: str, object_unit: str, stated: str | None = None) -> str:
    """Return the unit of a scene's lengths: mm, cm, m or in.

    `asked` is one of them, or auto: then it is the unit that the file's format states, such as mm of a BOP image, and
    if it states none that of the object. What is returned is still to be checked by `length_problem`. Raises InputError
    for an unknown unit, and for one that contradicts the format.
    """
    if asked == AUTO:
        return check_unit(object_unit if stated is None else stated)
    if asked not in METRES:
        raise InputError(f"unit {asked!r} is not known: use one of {', '.join((AUTO, *METRES))}")
    if stated not in (None, asked):
        raise InputError(f"the scene's unit cannot be {asked}, as its format states {stated}: leave --units out")
    return asked


def scene_size(scan: Scan) -> SceneSize:
    """Measure a scan, a large one by a million of its points. Its distance is known if it is a depth image."""
    from scipy.spatial import cKDTree

    generator, points = np.random.default_rng(0), scan.points
    if len(points) > _MOST:
        drawn = np.zeros(len(points), dtype=bool)
        drawn[generator.integers(0, len(points), _MOST)] = True
        points = points[drawn]
    low, high = np.percentile(points.astype(np.float64), _PERCENTILES, axis=0)
    spacing = 0.0
    if len(points) > 1:
        chosen = points if len(points) <= _SAMPLE else generator.choice(points, _SAMPLE, replace=False)
        tree = cKDTree(points, compact_nodes=False, balanced_tree=False)  # for few questions
        nearest = tree.query(chosen, k=2, workers=2)[0][:, 1]
        # Fewer points of a surface are farther apart, by the root of their share.
        spacing = float(np.median(nearest)) * math.sqrt(len(points) / len(scan.points))
    distance = None
    if scan.camera is not None:
        distance = float(np.median(np.linalg.norm(points.astype(np.float64), axis=1)))
    return SceneSize(float(np.linalg.norm(high - low)), spacing, distance, scan.unit)


def length_problem(diameter: float, object_unit: str, scene: SceneSize, words: UnitWords = _FLAGS) -> str | None:
    """Tell in a sentence why an object of that diameter cannot be in a scene, None if it can.

    If another unit makes them fit, of the scene or else of the object, the sentence names the most usual one with its
    factor, others that would do as well, and by `words` what to say. Raises InputError for an unknown unit or a
    diameter of zero or less.
    """
    if not 0 < diameter < math.inf:
        raise InputError(f"diameter is {diameter}, but must be above zero and finite")
    fault = _fault(diameter, check_unit(object_unit), scene)
    if fault is None:
        return None
    changes = [("scene", unit, object_unit, replace(scene, unit=unit)) for unit in METRES if unit != scene.unit]
    changes += [("object", unit, unit, scene) for unit in METRES if unit != object_unit]
    candidates = sorted(
        (_oddity(diameter, one, other) + _RARE_MISTAKE[which], which, unit)
        for which, unit, one, other in changes
        if _fault(diameter, one, other) is None
    )
    steps = ""
    if scene.distance is not None and words.steps is not None:
        steps = f"; if the image's depth is stored in other steps than {scene.unit}, give {words.steps}"
    if not candidates:
        return (
            f"{fault}, and no other unit of {', '.join(METRES)} makes them fit: check that both are what they should"
            f" be{steps}"
        )
    (least, which, unit), *rest = candidates
    factor = METRES[unit] / METRES[scene.unit if which == "scene" else object_unit]
    change = f"{factor:.4g} times larger" if factor > 1 else f"{1 / factor:.4g} times smaller"
    others = ", ".join(f"{_NAMES[name]} for the {what}" for oddity, what, name in rest if oddity < least + _CLOSE)
    too = f" ({others} would fit, too)" if others else ""
    say = f"say {words.scene.format(unit)}"
    if which == "object":
        again = f"a card is made again by kmn prepare --units {unit}, a GLB or STEP file is to be exported again"
        say = f"say {words.object.format(unit)} ({again}){steps}"
    return f"{fault}: the {which} would fit {change}, so its lengths are probably {_NAMES[unit]}{too}: {say}"


def length_doubt(diameter: float, object_unit: str, scene: SceneSize) -> str | None:
    """Tell in a clause which other units of the scene would be about as usual, None if none would.

    It is for scenes in which nothing was found: their lengths can be right, but need not be.
    """
    most = _oddity(diameter, object_unit, scene) + _DOUBTFUL
    scenes = [replace(scene, unit=unit) for unit in METRES if unit != scene.unit]
    possible = [other for other in scenes if _fault(diameter, object_unit, other) is None]
    ranked = sorted((_oddity(diameter, object_unit, other), other.unit) for other in possible)
    units = [unit for oddity, unit in ranked if oddity <= most]
    if not units:
        return None
    names = " or ".join(_NAMES[unit] for unit in units)
    return f"if the scan's lengths are {names}, not {_NAMES[scene.unit]}, say --units {' or '.join(units)}"


def object_doubt(diameter: float, scene: SceneSize, *, scene_follows: bool) -> str | None:
    """Tell in a clause which other units than mm, which were assumed, an object may be in, None if none is as usual.

    `diameter` is in mm, so as it was read. It is for objects whose unit nobody stated, where nothing was found in a
    scene that they fit. `scene_follows` is whether the scene was read in the object's unit, for want of its own: then
    that has to be said, too, as else both would change.
    """
    most = _oddity(diameter, _ASSUMED, scene) + _CLOSE
    possible = [unit for unit in METRES if unit != _ASSUMED and _fault(diameter, unit, scene) is None]
    ranked = sorted((_oddity(diameter, unit, scene), unit) for unit in possible)
    units = [unit for oddity, unit in ranked if oddity <= most]
    if not units:
        return None
    names = " or ".join(_NAMES[unit] for unit in units)
    also = f", and --units {scene.unit} for the scan" if scene_follows else ""
    return (
        f"the object's unit was taken to be {_ASSUMED}, so that its diameter is {_digits(diameter)} {_ASSUMED}: if its"
        f" numbers are {names}, say --object-units {' or '.join(units)} (in Python unit=, for a card kmn prepare"
        f" --units){also}"
    )


def camera_question(distance: float, unit: str, diameter: float) -> str | None:
    """Ask whether a camera is really so near to a robot's base, or so far from it, None if it may be.

    `diameter` is that of the part, in the same unit; a camera exactly at the base's origin is meant to be there.
    """
    is_odd = distance < _NEAR_BASE * diameter or distance * METRES[check_unit(unit)] > _FAR_FROM_BASE
    low, high = _USUAL_REACH
    likely = sorted((_RARE[other], other) for other in METRES if low <= distance * METRES[other] <= high)
    if not is_odd or not likely or unit in (other for _, other in likely):
        return None
    other = likely[0][1]
    return (
        f"the camera would be {_digits(distance)} {unit} from the robot's base: is T_base_camera in {_NAMES[other]}?"
        f' Then give its lengths in {unit}, or say "unit": "{other}" in its file'
    )


def size_question(diameter: float, unit: str, words: str) -> str | None:
    """Ask whether an object is really so small or large, None if many are; `words`, with {}, say another unit."""
    metres = diameter * METRES[check_unit(unit)]
    if _REAL_SIZES[0] <= metres <= _REAL_SIZES[1]:
        return None
    low, high = _USUAL_SIZES["object"]
    likely = sorted((_RARE[other], other) for other in METRES if low <= diameter * METRES[other] <= high)
    remedy = ""
    if likely:
        other = likely[0][1]
        remedy = f" If its numbers are {_NAMES[other]}, say {words.format(other)}, or make what states {unit} again"
    return f"is the object really {_digits(diameter)} {unit} large?{remedy}"


def _fault(diameter: float, object_unit: str, scene: SceneSize) -> str | None:
    """Say what cannot be if the lengths of both were in their units."""
    in_diameters = METRES[scene.unit] / METRES[object_unit] / diameter
    named = f"the object of {_digits(diameter)} {object_unit}"
    shown = f"the scene of {_digits(scene.extent)} {scene.unit}"
    if scene.extent * in_diameters < _EXTENT[0]:
        return f"{named} is larger than {shown}"
    if scene.extent * in_diameters > _EXTENT[1]:
        return f"{named} is far too small for {shown}"
    if scene.spacing * in_diameters > 1 / _POINTS_ACROSS:
        return f"{named} is too small for a scene whose points are {_digits(scene.spacing)} {scene.unit} apart"
    if scene.distance is None or _DISTANCE[0] <= scene.distance * in_diameters <= _DISTANCE[1]:
        return None
    size = "large" if scene.distance * in_diameters < _DISTANCE[0] else "small"
    return f"{named} is too {size} for a scene {_digits(scene.distance)} {scene.unit} away"


def _oddity(diameter: float, object_unit: str, scene: SceneSize) -> float:
    """Return how unusual lengths in their units would be: logarithms of what they miss, added."""
    size, extent = diameter * METRES[object_unit], scene.extent * METRES[scene.unit]
    total = _RARE[object_unit] + _RARE[scene.unit] + _beyond(extent / size, _USUAL_EXTENT)
    total += _beyond(size, _USUAL_SIZES["object"]) + _beyond(extent, _USUAL_SIZES["scene"])
    if scene.distance is None:
        return total
    distance = scene.distance * METRES[scene.unit]
    return total + _beyond(distance / size, _USUAL_DISTANCE) + _beyond(distance, _USUAL_SIZES["distance"])


def _beyond(value: float, limits: tuple[float, float]) -> float:
    return max(0.0, math.log(limits[0] / value), math.log(value / limits[1]))


def _digits(value: float) -> str:
    """Return the first three digits of a length."""
    return f"{float(f'{value:.3g}'):g}"
