"""Versions of what makes poses: exported poses are made anew where they would come out otherwise, and only there.

They are numbers that are raised by hand, not digests. Source changes without any pose changing, as when a file moves or
a comment is edited; outputs differ in rounding, and with it in what a search draws, between processors and libraries,
without anybody's change. What is forgotten by hand is found by tests/experiments/test_versions.py, which holds what
each stage gave on a small input when its version was raised last, and fails where that has changed since.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from experiments.evaluation.best_of import BestOf, Several
from experiments.evaluation.cases import Method
from experiments.evaluation.methods import Ours, OwnNetworks

# Raise a number when the code it names gives other results for the same input and the same settings, which are
# recorded beside it; not when it is moved, renamed, made faster or differs in the last digits.
VERSIONS = {
    # Of all methods: raising one of these makes all poses stale.
    "cases": 1,  # what is read of a scan, and which crops of it are drawn: cases, sources, clouds
    "refinement": 2,  # the ICP that follows every method
    # Of methods, by their classes: raising one makes the poses of that method stale, and no others.
    "Ours": 3,  # encoding of an object, network, matches and the search of a crop; also with an object's own network
    "OverMatches": 1,  # another search over our matches, beside "Ours"
    "Fpfh": 1,
    "FastGlobal": 1,
    "PointPairs": 1,
    "Kiss": 1,
    "BestOf": 1,  # the choice among several poses, beside the method that they are of
}
_SHARED = ("cases", "refinement")
_LIBRARIES = ("jax", "jaxlib", "numpy", "open3d")  # of all methods: open3d reads scans


def shared_versions() -> dict[str, Any]:
    """Return the versions that decide the poses of all methods; None of a library that is not there."""
    return {stage: VERSIONS[stage] for stage in _SHARED} | _of_libraries(_LIBRARIES)


def versions_of(method: Method | Several) -> dict[str, Any]:
    """Return the versions that decide the poses of a method alone."""
    if isinstance(method, BestOf):
        return versions_of(method.base) | {"BestOf": VERSIONS["BestOf"]}
    stages: list[type] = [Ours if isinstance(method, OwnNetworks) else type(method)]
    if isinstance(method, Ours) and method.search is not None:
        stages.append(type(method.search))
    library = getattr(method, "library", None)
    return {kind.__name__: VERSIONS[kind.__name__] for kind in stages} | _of_libraries([library] if library else [])


def _of_libraries(names: Iterable[str]) -> dict[str, str | None]:
    def found(name: str) -> str | None:
        try:
            return version(name)
        except PackageNotFoundError:
            return None

    return {name: found(name) for name in names}
