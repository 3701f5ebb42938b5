"""Images of BOP datasets with ground truth, bins and worlds, and whether what was found there is right."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32

from experiments.made_data import require_made
from experiments.test_sets import SPLIT
from experiments.worlds import NAMES, TARGETS, has_other_parts, kind_of
from kmn_jax.bop import BopDataset, BopFrame, BopInstance, FrameKey
from kmn_jax.data import load_models
from kmn_jax.detection import Scene, bin_content, into, make_scene, near_surface, symmetry_transforms
from kmn_jax.errors import InputError
from kmn_jax.geometry import measured_points
from kmn_jax.io import Scan
from kmn_jax.models import Model
from kmn_jax.objects import CARD_SUFFIX, ObjectConfig, Part, load_part, make_part, model_digest
from kmn_jax.pose import adi, mssd, symmetric_pose_error
from kmn_jax.programs import compiled_size
from kmn_jax.simulate import Bin

_UNIT = "mm"
_POINTS = 1000  # of an object's surface, for errors
_SHARED_POINTS = 500  # of it, to see which share lies on another
THRESHOLD = 0.1  # of the diameter: a pose with less ADI is right
_ALIKE = 0.03, 2 / 3  # diameters of a stranger, within which such a share of either surface lies on the other
_FAR = 0.5  # diameters: no threshold of an error is higher
LEAST_VISIBLE = 0.3  # share of a copy that is seen, from which on it ought to be found


@dataclass(frozen=True)
class TrueImage:
    """What is known of one image of copies of one part, in millimetres and the camera's frame."""

    key: FrameKey
    part: Part
    strangers: tuple[Part, ...]  # the nearest in size first, one a kind; that there is no copy of them is known
    truth: Float[np.ndarray, "i 4 4"]
    visible: Float[np.ndarray, " i"]  # share of each copy that is seen

    def errors(self, poses: Float[np.ndarray, "s 4 4"]) -> Float[np.ndarray, "s i"]:
        """Return the ADI of poses against each true one, in diameters; above a half it may be a bound."""
        return self._of_near(poses, adi_of_pairs)

    def largest_errors(self, poses: Float[np.ndarray, "s 4 4"]) -> Float[np.ndarray, "s i"]:
        """Return the MSSD of poses against each true one, in diameters; above a half it may be a bound."""
        turns = jnp.asarray(symmetry_transforms(self.part.symmetries))
        return self._of_near(poses, lambda pairs, points: mssd_of_pairs(pairs, points, turns))

    def looks_like(self, other: Part, poses: Float[np.ndarray, "s 4 4"]) -> Bool[np.ndarray, " s"]:
        """Return at which poses another part hardly differs from a copy.

        Two thirds of its surface then lie on that of the copy, and two thirds of that on its own: of a plate at the
        side of a box the first holds, the second does not.
        """
        from scipy.spatial import cKDTree

        near, least = _ALIKE[0] * other.diameter, _ALIKE[1]
        points = [part.points[:_SHARED_POINTS] for part in (other, self.part)]
        trees = [cKDTree(part.points) for part in (self.part, other)]  # the surface that the points are to lie on
        middles = [of.mean(axis=0) for of in points]
        found = poses[:, :3, :3] @ middles[0] + poses[:, :3, 3]
        copies = self.truth[:, :3, :3] @ middles[1] + self.truth[:, :3, 3]
        is_near = np.linalg.norm(found[:, None] - copies[None], axis=2) < 0.5 * (other.diameter + self.part.diameter)
        result = np.zeros(len(poses), dtype=bool)
        for row, copy in np.argwhere(is_near):
            T_own_other = np.linalg.inv(self.truth[copy]) @ poses[row]
            moved = into(np.linalg.inv(T_own_other), points[0]), into(T_own_other, points[1])
            result[row] |= all(
                np.isfinite(tree.query(of, distance_upper_bound=near)[0]).mean() >= least
                for tree, of in zip(trees, moved, strict=True)
            )
        return result

    def offset(self, pose: Float[np.ndarray, "4 4"], copy: int) -> tuple[float, float]:
        """Return by how many degrees, symmetries taken out, and millimetres a pose is off a true one."""
        own = self.part.symmetries
        given = (pose, self.truth[copy], own.rotations, own.axes, own.center)
        turn, shift = symmetric_pose_error(*(np.asarray(value, dtype=np.float32) for value in given))
        return float(np.degrees(turn)), float(shift)

    def _of_near(
        self, poses: Float[np.ndarray, "s 4 4"], errors_of: Callable[[np.ndarray, np.ndarray], jax.Array]
    ) -> Float[np.ndarray, "s i"]:
        """Return errors of poses against each true one, in diameters; of pairs that are far apart lower bounds.

        The mean distance to the points of another one is at least that of one's own middle to the ball that they are
        in; the largest one is at least that of the middles, of which a symmetry moves none out of its ball.
        """
        points = self.part.points[:_POINTS]
        middle = points.mean(axis=0)
        radius = np.linalg.norm(points - middle, axis=1).max()
        places, copies = (of[:, :3, :3] @ middle + of[:, :3, 3] for of in (poses, self.truth))
        errors = (np.linalg.norm(places[:, None] - copies[None], axis=2) - radius) / self.part.diameter
        near = errors <= _FAR
        rows, columns = np.nonzero(near)
        pairs = padded(np.stack([poses[rows], self.truth[columns]], axis=1))
        errors[near] = np.asarray(errors_of(pairs, points))[: len(rows)] / self.part.diameter
        return errors


@dataclass(frozen=True)
class BinImage(TrueImage):
    """One image of a bin of one part."""

    scene: Scene  # its foreground is what lies inside of the bin
    inside: Bool[np.ndarray, "h w"]  # the pixels that are measured inside of the bin


@dataclass(frozen=True)
class WorldImage(TrueImage):
    """One image of a world; the part is the one that is asked for, and there may be no copy of it."""

    family: str
    kind: str  # the part's family
    scan: Scan

    def cloud(self, margin: float | None = None) -> Scan:
        """Return the scan as a cloud; with a margin, in diameters, what is so near to the surface of a copy alone."""
        points = self.scan.points
        if margin is not None:
            points = points[near_surface(points, self.part.points, self.truth, margin * self.part.diameter)]
        return Scan(points, None, None, None, self.scan.unit)


def padded(pairs: Float[np.ndarray, "p 2 4 4"]) -> Float32[np.ndarray, "q 2 4 4"]:
    """Return pairs of poses as seen from near to them, padded to a power of two."""
    capacity = compiled_size(len(pairs))
    origin = pairs[:, :1, :3, 3].copy()  # float32 of millimetres far from the camera would lose digits
    near = pairs.copy()
    near[:, :, :3, 3] -= origin
    return np.concatenate([near, np.tile(np.eye(4), (capacity - len(pairs), 2, 1, 1))]).astype(np.float32)


@jax.jit
def adi_of_pairs(pairs: jax.Array, points: jax.Array) -> jax.Array:
    """Return the ADI of pairs of poses (p, 2, 4, 4), the second one the true one, of an object's points (m, 3)."""
    return jax.lax.map(lambda pair: adi(pair[0], pair[1], points), pairs)


@jax.jit
def mssd_of_pairs(pairs: jax.Array, points: jax.Array, symmetries: jax.Array) -> jax.Array:
    """Return the MSSD of pairs of poses (p, 2, 4, 4), the second one the true one, of an object's points (m, 3)."""
    return jax.lax.map(lambda pair: mssd(pair[0], pair[1], points, symmetries), pairs)


def bin_images(folder: Path, split: str, model: Model, every: int = 1, cards: Path | None = None) -> Iterator[BinImage]:
    """Yield every so many images of a dataset whose bins hold copies of one part each.

    Objects are read from their meshes, or, where Open3D is missing, from `cards` that `kmn prepare` made of them.
    Raises InputError if the folder is no such dataset, or a card is missing or of other weights.
    """
    dataset, parts = _opened(folder, split, model, cards)
    for key in dataset.keys[::every]:
        frame = dataset.frame(*key, masks=True).with_visibility()
        instances = frame.instances or ()
        if not instances or frame.bin is None or frame.T_camera_bin is None:
            raise InputError(f"{folder}: image {key.image_id} of scene {key.scene_id} has no poses or no bin")
        object_id = instances[0].object_id
        if object_id not in parts:
            raise InputError(f"{folder} has no model of object {object_id}, of which scene {key.scene_id} is")
        part = parts[object_id]
        inside = _inside(frame, frame.bin, frame.T_camera_bin, part)
        yield BinImage(
            key,
            part,
            _like_in_size(part, [pair for pair in parts.items() if pair[0] != object_id]),
            *_truth(instances),
            make_scene(_scan(frame), part.diameter, inside=inside[frame.depth > 0]),
            inside,
        )


def read_targets(folder: Path) -> list[tuple[FrameKey, int, str]]:
    """Return the images of world bins, each with the object that is asked for and the family of its scene.

    Raises InputError if the folder holds no world bins.
    """
    require_made(folder)
    try:
        targets = json.loads((folder / TARGETS).read_text(encoding="utf-8"))
        names = json.loads((folder / NAMES).read_text(encoding="utf-8"))
        keys = [FrameKey(int(target["scene_id"]), int(target["im_id"])) for target in targets]
        objects = [int(target["obj_id"]) for target in targets]
        return list(zip(keys, objects, [str(names[str(key.scene_id)]) for key in keys], strict=True))
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        reason = str(error)[:80]
        raise InputError(f"{folder} holds no world bins ({reason}): python -m experiments.build_data worlds") from None


def world_images(folder: Path, model: Model, every: int = 1) -> Iterator[WorldImage]:
    """Yield every so many images. Raises InputError if the folder holds no world bins, or others than its targets."""
    targets = read_targets(folder)
    dataset, parts = _opened(folder, SPLIT, model)
    kinds = {object_id: kind_of(dataset.model(object_id).name or "") for object_id in parts}
    keys = set(dataset.keys)
    for key, object_id, family in targets[::every]:
        if key not in keys or object_id not in parts:
            raise InputError(
                f"{folder} has no object {object_id} or no image {key.image_id} of scene {key.scene_id}, which its"
                f" {TARGETS} names: python -m experiments.build_data worlds"
            )
        part = parts[object_id]
        frame = dataset.frame(*key, masks=True).with_visibility()
        instances = frame.instances or ()
        others = [(kinds[number], other) for number, other in parts.items() if kinds[number] != kinds[object_id]]
        may_lie = has_other_parts(family, len(instances))
        yield WorldImage(
            key,
            part,
            () if may_lie else _like_in_size(part, others),
            *_truth(instances),
            family,
            kinds[object_id],
            _scan(frame),
        )


def _opened(folder: Path, split: str, model: Model, cards: Path | None = None) -> tuple[BopDataset, dict[int, Part]]:
    """Return a dataset and its parts. Raises InputError if one cannot be used."""
    require_made(folder)
    dataset = BopDataset(folder, split, unit=_UNIT)
    if cards is not None:
        digest = model_digest(model)
        files = {object_id: cards / f"obj_{object_id:06d}{CARD_SUFFIX}" for object_id in dataset.object_ids or ()}
        return dataset, {object_id: load_part(file, digest).in_unit(_UNIT) for object_id, file in files.items()}
    models, problems = load_models(dataset, ObjectConfig(num_points=4096))
    if problems:
        raise InputError(f"{folder}: {problems[0]}")
    return dataset, {object_id: make_part(found, model) for object_id, found in models.items()}


def _truth(instances: Sequence[BopInstance]) -> tuple[Float[np.ndarray, "i 4 4"], Float[np.ndarray, " i"]]:
    """Return the poses of copies, and which share of each is seen."""
    poses = np.array([instance.T_camera_object for instance in instances]).reshape(-1, 4, 4)
    return poses, np.array([instance.visible_fraction or 0.0 for instance in instances])


def _like_in_size(part: Part, others: Iterable[tuple[Hashable, Part]]) -> tuple[Part, ...]:
    """Return those of other parts, given with their kinds, that are nearest in size, the nearest first, one a kind."""
    nearest: dict[Hashable, Part] = {}
    for kind, other in sorted(others, key=lambda pair: abs(np.log(pair[1].diameter / part.diameter))):
        nearest.setdefault(kind, other)
    return tuple(nearest.values())


def _scan(frame: BopFrame) -> Scan:
    depth = frame.depth.astype(np.float32)
    return Scan(measured_points(depth, frame.camera), None, depth, frame.camera, _UNIT)


def _inside(frame: BopFrame, bin: Bin, T_camera_bin: Float[np.ndarray, "4 4"], part: Part) -> Bool[np.ndarray, "h w"]:
    """Return the pixels whose measured points lie inside of the bin; all measured ones if none does."""
    measured = frame.depth > 0
    inside = np.asarray(bin_content(frame.depth, frame.camera, T_camera_bin, bin, part.diameter)) & measured
    return inside if inside.any() else measured
