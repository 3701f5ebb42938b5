"""Poses of methods on cases, exported once with what made them, and read as often as they are scored.

One file for each method, object and noise, and one for the cases of an object and noise: an export goes on where it was
stopped. What was made by another recipe (config, data, weights, versions) is refused, not mixed in.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from safetensors.numpy import save

from experiments.evaluation.cases import Case, Method, ObjectImages, draw_cases
from experiments.evaluation.refinement import Refinement
from kmn_jax.errors import InputError
from kmn_jax.files import make_folder, read_safetensors, write_whole
from kmn_jax.report import commit

_HEADER = "kmn_jax evaluation 1"
_OF_METHOD = "method "


class Truth(NamedTuple):
    """The true poses of cases, and where their crops are; in millimetres and the camera's frame."""

    names: tuple[str, ...]
    T_camera_object: tuple[Float[np.ndarray, "i 4 4"], ...]  # of all copies in each case's scan
    copy: tuple[int, ...]
    visible: Float[np.ndarray, " c"]
    problems: tuple[str, ...]  # what could not be read when the cases were drawn


class Predictions(NamedTuple):
    """What a method found in each case, and how long it took, first call left out."""

    T_camera_object: Float[np.ndarray, "c 4 4"]
    refined: Float[np.ndarray, "c 4 4"]
    found: Bool[np.ndarray, " c"]
    seconds: Float[np.ndarray, " c"]
    refine_seconds: Float[np.ndarray, " c"]


@dataclass(frozen=True)
class Export:
    """A folder of predictions of one recipe."""

    folder: Path
    recipe: Mapping[str, Any]
    commit: str = "unknown"  # of the code that writes, for the record: versions say when poses have to be made anew

    @classmethod
    def open(cls, folder: Path, recipe: Mapping[str, Any], overwrite: bool) -> Export:
        """Claim a folder. Raises InputError if it holds predictions of another recipe and is not to be overwritten."""
        file = folder / "recipe.json"
        plain = json.loads(json.dumps(recipe, default=str))
        try:
            folder.mkdir(parents=True, exist_ok=True)
            old = json.loads(file.read_text(encoding="utf-8")) if file.exists() else None
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{file} cannot be read ({error}): choose another folder with --output") from None
        if not isinstance(old, dict | None) or not isinstance((old or {}).get("methods", {}), dict):
            raise InputError(f"{file} is no recipe: choose another folder with --output")
        if old is not None:
            stale = _differing(old, plain)
            if stale and not overwrite:
                raise InputError(
                    f"{folder} holds predictions of another recipe (differing: {', '.join(stale)}): give --overwrite to"
                    " make them anew, or another folder with --output"
                )
            for name in stale:
                method = name.removeprefix(_OF_METHOD)
                _delete(folder.glob(f"{_slug(method) if method != name else '*'}/*.safetensors"))
            if not any(not name.startswith(_OF_METHOD) for name in stale):  # what other methods found stays
                plain["methods"] = {**old.get("methods", {}), **plain.get("methods", {})}
        write_whole(file, (json.dumps(plain, indent=1) + "\n").encode())
        return cls(folder, plain, commit() or "unknown")

    def path(self, method: str, name: str, noise: float) -> Path:
        """Return the file of an object and noise."""
        return self.folder / _slug(method) / f"{_slug(name)}.noise{noise:g}.safetensors"

    def has(self, method: str, name: str, noise: float) -> bool:
        """Tell whether there is a file of an object and noise. Raises InputError if another recipe made it."""
        if not self.path(method, name, noise).exists():
            return False
        self._read(method, name, noise)
        return True

    def write_truth(self, name: str, noise: float, cases: Sequence[Case], problems: Sequence[str] = ()) -> None:
        """Write the true poses of cases, and what could not be read when they were drawn."""
        counts = [len(case.T_camera_object) for case in cases]
        tensors = {
            "poses": np.concatenate([case.T_camera_object for case in cases]) if cases else np.zeros((0, 4, 4)),
            "counts": np.array(counts, dtype=np.int64),
            "copy": np.array([case.copy for case in cases], dtype=np.int64),
            "visible": np.array([case.visible for case in cases], dtype=np.float64),
        }
        texts = {"names": [case.name for case in cases], "problems": list(problems)}
        self._write("cases", name, noise, tensors, {key: json.dumps(value) for key, value in texts.items()})

    def truth(self, name: str, noise: float) -> Truth:
        """Read the true poses of cases. Raises InputError if they are not there, or damaged."""
        tensors, metadata = self._read("cases", name, noise)
        try:
            names = tuple(map(str, json.loads(metadata["names"])))
            problems = tuple(map(str, json.loads(metadata["problems"])))
            counts, poses = tensors["counts"], tensors["poses"]
            _check_shapes(tensors, poses=(int(counts.sum()), 4, 4), counts=(len(names),), copy=(len(names),))
            known = {"visible": np.where(np.isnan(tensors["visible"]), 0, tensors["visible"])}
            _check_shapes(known, visible=(len(names),))
            if counts.min(initial=0) < 0:
                raise ValueError("counts below zero")
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise self._damage("cases", name, noise, error) from None
        split = tuple(np.split(poses, np.cumsum(counts)[:-1])) if len(counts) else ()
        return Truth(names, split, tuple(tensors["copy"].tolist()), tensors["visible"], problems)

    def write(self, method: str, name: str, noise: float, found: Predictions) -> None:
        """Write what a method found."""
        self._write(method, name, noise, found._asdict(), {})

    def read(self, method: str, name: str, noise: float) -> Predictions:
        """Read what a method found. Raises InputError if it is not there, or damaged."""
        tensors, _ = self._read(method, name, noise)
        try:
            found = Predictions(**tensors)
            cases = (len(found.found),)
            _check_shapes(tensors, T_camera_object=(*cases, 4, 4), refined=(*cases, 4, 4), found=cases)
            _check_shapes(tensors, seconds=cases, refine_seconds=cases)
        except (TypeError, ValueError) as error:
            raise self._damage(method, name, noise, error) from None
        return found

    def made_at(self, method: str, name: str, noise: float) -> str:
        """Return the commit that a method's poses were made at."""
        return self._read(method, name, noise)[1].get("commit", "unknown")

    def _write(
        self, method: str, name: str, noise: float, tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str]
    ) -> None:
        path = self.path(method, name, noise)
        make_folder(path.parent)
        plain = {key: np.ascontiguousarray(value) for key, value in tensors.items()}
        own = {"format": _HEADER, "recipe": self._digest(method), "commit": self.commit}
        write_whole(path, save(plain, metadata={**own, **metadata}))

    def _read(self, method: str, name: str, noise: float) -> tuple[dict[str, np.ndarray], dict[str, str]]:
        path = self.path(method, name, noise)
        tensors, metadata = read_safetensors(path)
        if metadata.get("format") != _HEADER or metadata.get("recipe") != self._digest(method):
            raise InputError(f"{path} was made by another recipe: delete it, and evaluate again")
        return tensors, metadata

    def _damage(self, method: str, name: str, noise: float, error: Exception) -> InputError:
        path = self.path(method, name, noise)
        return InputError(f"{path} is damaged ({str(error)[:80]}): delete it, and evaluate again")

    def _digest(self, method: str) -> str:
        """Return the SHA-256 of all that a method's poses depend on: not the other methods."""
        own = {**self.recipe, "methods": self.recipe.get("methods", {}).get(method)}
        return hashlib.sha256(json.dumps(own, sort_keys=True).encode()).hexdigest()


def _check_shapes(tensors: Mapping[str, np.ndarray], **shapes: tuple[int, ...]) -> None:
    for name, shape in shapes.items():
        if tensors[name].shape != shape or not np.isfinite(tensors[name]).all():
            raise ValueError(f"{name} has shape {tensors[name].shape}, or values that are not finite")


def _delete(paths: Iterable[Path]) -> None:
    """Delete those that are predictions, whole ones: what else lies there is somebody's own."""
    for path in paths:
        with contextlib.suppress(InputError):
            if read_safetensors(path)[1].get("format") == _HEADER:
                path.unlink()


def _differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return what differs between recipes, methods one by one; what only one of them has of these is no difference."""
    shared = [key for key in sorted({*old, *new} - {"methods"}) if old.get(key) != new.get(key)]
    before, now = old.get("methods", {}), new.get("methods", {})
    return shared + [f"{_OF_METHOD}{key}" for key in sorted({*before} & {*now}) if before[key] != now[key]]


def export(
    objects: Sequence[ObjectImages],
    methods: Mapping[str, Method],
    noises: Sequence[float],
    crops: int,
    random_seed: int,
    folder: Export,
) -> None:
    """Run all methods on all cases, but those of which there are files. Shows its progress."""
    from tqdm import tqdm

    units = [(found, noise) for found in objects for noise in noises]
    with tqdm(total=len(units) * len(methods), unit="set", desc="poses") as bar:
        for found, noise in units:
            missing = {key: method for key, method in methods.items() if not folder.has(key, found.name, noise)}
            bar.update(len(methods) - len(missing))
            known = folder.has("cases", found.name, noise)
            if not missing and known:
                continue
            problems: list[str] = []
            cases = list(draw_cases(found, crops, noise, random_seed, problems.append))
            folder.write_truth(found.name, noise, cases, problems)
            refine = Refinement(found.model)
            for key, method in missing.items():
                bar.set_postfix_str(f"{found.name[:24]}, noise {noise:g}, {method.name}", refresh=True)
                try:
                    solved = _solved(method.prepare(found.model), refine, cases)
                except InputError:
                    raise
                except Exception as error:  # of somebody else's library, mostly; what was found before is kept
                    kind = f"{type(error).__name__}: {error}".splitlines()[0]
                    where = f"{method.name} failed on {found.name} at noise {noise:g}"
                    raise InputError(f"{where} ({kind}): leave it out with --methods") from error
                folder.write(key, found.name, noise, solved)
                bar.update()


def _solved(solve: Callable[[Case], Any], refine: Refinement, cases: Sequence[Case]) -> Predictions:
    """Solve cases one after another; what is compiled or loaded first, for each size of crops, is not timed."""
    if not cases:
        none = np.zeros(0)
        return Predictions(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), np.zeros(0, dtype=bool), none, none)
    for case in {len(case.points).bit_length(): case for case in cases}.values():
        _timed(solve, refine, case)
    rows = [_timed(solve, refine, case) for case in cases]
    return Predictions(*(np.array(column) for column in zip(*rows, strict=True)))


def _timed(solve: Callable[[Case], Any], refine: Refinement, case: Case) -> tuple[Any, ...]:
    start = time.perf_counter()
    pose = solve(case)
    middle = time.perf_counter()
    nothing = np.eye(4)
    refined = nothing if pose is None else refine(case, pose)
    end = time.perf_counter()
    return nothing if pose is None else pose, refined, pose is not None, middle - start, end - middle


def check_files(names: Sequence[str], where: str) -> None:
    """Raise InputError if predictions of two of these objects would be in the same files; `where` to rename them."""
    taken: dict[str, str] = {}
    for name in names:
        if (slug := _slug(name)) in taken:
            both = f"the objects {taken[slug]!r} and {name!r}"
            raise InputError(f"{both} would have the same files of predictions: rename one of them in {where}")
        taken[slug] = name


def _slug(name: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in name)
