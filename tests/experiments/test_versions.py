"""What makes exported poses stale: the versions of stages, which are raised where these give other results."""

from __future__ import annotations

import builtins
import io
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import evaluate
from experiments.evaluation.best_of import BestOf, SeveralPoses
from experiments.evaluation.cases import Case, Method, ObjectImages, draw_cases
from experiments.evaluation.configs import find_config
from experiments.evaluation.methods import Ours, OwnNetworks
from experiments.evaluation.predictions import Export
from experiments.evaluation.refinement import Refinement
from experiments.evaluation.rivals import FastGlobal, Fpfh, Kiss, OverMatches, PointPairs, described
from experiments.evaluation.sources import bop_objects
from experiments.evaluation.tuned import RIVALS
from experiments.evaluation.versions import VERSIONS, versions_of
from kmn_jax.errors import InputError
from kmn_jax.models import load_model, load_pretrained
from kmn_jax.objects import ObjectModel
from kmn_jax.pose import Matches, adi
from tests.reference.clouds import box_cloud
from tests.reference.poses import some_poses

SMALL = Path(evaluate.__file__).parent / "assets" / "small_test_set"
WEIGHTS = SMALL.parent / "small.safetensors"  # not the released ones: other weights give other poses, not other stages
RECORD = Path(__file__).with_name("stages.json")
AGAIN = "then record what it gives: python -m tests.experiments.test_versions"
METHODS = {name: make() for name, (_, make) in RIVALS.items()}


@cache
def gear() -> ObjectImages:
    return bop_objects(SMALL, "test", print, most_images=2)[1]


@cache
def cases() -> tuple[Case, ...]:
    return tuple(draw_cases(gear(), 2, 0.01))


@cache
def half_seen() -> tuple[ObjectModel, Case]:
    """The side of the part that a camera sees, as object and as crop: what searches find without doubt."""
    pose, model = cases()[0].T_camera_object[0], gear().model
    points = model.points @ pose[:3, :3].T + pose[:3, 3]
    seen = ((model.normals @ pose[:3, :3].T) * points).sum(axis=1) < 0
    side = replace(model, points=model.points[seen], normals=model.normals[seen])
    return side, Case("alone/0", points[seen].astype(np.float32), pose[None], 0, 1.0)


def described_cases() -> np.ndarray:
    """Where crops are, and how many points they have and how these are spread, in diameters."""
    size = gear().model.diameter
    return np.array(
        [
            [*case.points[0] / size, np.log(len(case.points)), *case.points.mean(0) / size, *case.points.std(0) / size]
            for case in cases()
        ]
    )


def in_diameters(pose: np.ndarray | None, case: Case) -> np.ndarray:
    """A pose relative to the crop's first point."""
    if pose is None:
        return np.zeros((3, 4))
    return np.column_stack([pose[:3, :3], (pose[:3, 3] - case.points[0]) / gear().model.diameter])


def solved(method: Method) -> np.ndarray:
    side, case = half_seen()
    return in_diameters(method.prepare(side)(case), case)


def ours() -> np.ndarray:
    """What the network says of a crop, and how far poses are from the true ones at the median: which they are exactly,
    rounding decides.
    """
    method, model, crops = Ours("ours", load_model(WEIGHTS)), gear().model, tuple(draw_cases(gear(), 8, 0.0))
    part, solve = method.part(model), method.prepare(model)
    said = method.predict(part, crops[0])
    shares = np.bincount(said.keypoint, minlength=part.num_keypoints) / len(said.keypoint)
    points = model.points[:1000]
    errors = [
        min(float(adi(pose, true, points)) for true in case.T_camera_object) / model.diameter
        for case in crops
        if (pose := solve(case)) is not None
    ]
    middle = (said.points.mean(axis=0) - crops[0].points[0]) / model.diameter
    return np.array([*middle, *part.features.mean(axis=0), *shares, said.on_object.mean(), np.median(errors)])


def refined() -> np.ndarray:
    refine, turned = Refinement(gear().model), np.eye(4)
    turned[:3, :3] = [[np.cos(0.05), -np.sin(0.05), 0], [np.sin(0.05), np.cos(0.05), 0], [0, 0, 1]]
    turned[:3, 3] = 0.02 * gear().model.diameter
    return np.array([in_diameters(refine(case, case.T_camera_object[case.copy] @ turned), case) for case in cases()])


def over_matches() -> np.ndarray:
    """Matches of which a third is wrong: threads end Open3D's search where they like, but then it ends at the truth."""
    cloud, pose = box_cloud(0, 90).astype(np.float64), some_poses(1)[0]
    seen, normals = cloud[:, :3] @ pose[:3, :3].T + pose[:3, 3], cloud[:, 3:] @ pose[:3, :3].T
    seen[::3] = np.roll(seen[::3], 1, axis=0)
    ones = np.ones(len(cloud), dtype=bool)
    matches = Matches(cloud[:, :3], cloud[:, 3:], seen, normals, ones, ones, np.False_, np.float32(50))  # type: ignore[arg-type]
    found = OverMatches()(matches, 50.0, 0)
    assert found is not None
    return found[:3] / [1, 1, 1, 50]


def fpfh() -> np.ndarray:
    """Its features: threads of Open3D's RANSAC end each other's search, so that no two poses are the same."""
    found = described(half_seen()[1].points, None, METHODS["fpfh"].features, gear().model.diameter)
    assert found is not None
    return np.append(found.features.data.mean(axis=1) / 100, np.log(len(found.cloud.points)))


class Known:
    """Poses that are known: turned over, moved into the part, and the true one."""

    @property
    def settings(self) -> dict[str, bool]:
        return {"known": True}

    def prepare_several(self, _: ObjectModel) -> SeveralPoses:
        def solve(case: Case, count: int) -> list[np.ndarray]:
            true = case.T_camera_object[0]
            turned, deep = true @ np.diag([1.0, -1, -1, 1]), true.copy()
            deep[:3, 3] += 0.3 * gear().model.diameter * true[:3, 3] / np.linalg.norm(true[:3, 3])
            return [turned, deep, true][:count]

        return solve


# What rounding may change, as on another processor; of a diameter, or of what a rotation holds.
TOLERANCES = dict.fromkeys(VERSIONS, 0.02) | {"FastGlobal": 0.1, "Kiss": 0.05}
STAGES: dict[str, Callable[[], np.ndarray]] = {
    "cases": described_cases,
    "refinement": refined,
    "Ours": ours,
    "OverMatches": over_matches,
    "Fpfh": fpfh,
    "FastGlobal": lambda: solved(METHODS["fgr"]),
    "PointPairs": lambda: solved(replace(METHODS["ppf"], sampling=0.1)),
    "Kiss": lambda: solved(METHODS["kiss"]),
    "BestOf": lambda: solved(BestOf("some", Known(), 3)),
}


@pytest.mark.parametrize("stage", VERSIONS)
def test_a_stage_gives_what_it_gave_when_its_version_was_raised(stage: str) -> None:
    recorded = json.loads(RECORD.read_text())[stage]
    assert recorded["version"] == VERSIONS[stage], f"the version of {stage} was raised: {AGAIN}"
    same = np.allclose(STAGES[stage](), recorded["gives"], atol=TOLERANCES[stage], rtol=0)
    assert same, f"{stage} gives other results: raise its version in experiments/evaluation/versions.py, {AGAIN}"


def recipe(**changed: Any) -> dict[str, Any]:
    model = load_pretrained()
    ours = {"ours": Ours("ours", model), "open3d": Ours("open3d", model, search=OverMatches())}
    methods = {**ours, "own": OwnNetworks("own", {}), **METHODS}
    return json.loads(json.dumps(evaluate.recipe_of(replace(find_config("demo"), **changed), methods), default=str))


@cache
def usual_recipe() -> dict[str, Any]:
    return recipe()


@pytest.mark.parametrize(
    ("stage", "stale"),
    [
        ("cases", "versions"),
        ("refinement", "versions"),
        ("Ours", "method open3d, method ours, method own"),
        ("OverMatches", "method open3d"),
        ("Fpfh", "method fpfh, method fpfh_best"),
        ("FastGlobal", "method fgr"),
        ("PointPairs", "method ppf, method ppf_best"),
        ("Kiss", "method kiss"),
        ("BestOf", "method fpfh_best, method ppf_best"),
    ],
)
def test_a_raised_version_makes_the_poses_of_its_own_stage_stale(
    stage: str, stale: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(2):
        Export.open(tmp_path, usual_recipe(), overwrite=False)
    monkeypatch.setitem(VERSIONS, stage, 1 + VERSIONS[stage])
    with pytest.raises(InputError) as refused:
        Export.open(tmp_path, recipe(), overwrite=False)
    assert f"(differing: {stale})" in str(refused.value)


def test_other_cases_make_all_poses_stale(tmp_path: Path) -> None:
    for same in (usual_recipe(), recipe()):
        Export.open(tmp_path, same, overwrite=False)
    with pytest.raises(InputError, match=r"\(differing: config\)"):
        Export.open(tmp_path, recipe(random_seed=1), overwrite=False)


def test_source_that_moves_or_is_edited_makes_nothing_stale(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is recorded hangs on no file of source: none is read for it, and none is named in it."""
    read: list[str] = []

    def noting(opened: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(file: Any, *arguments: Any, **options: Any) -> Any:
            read.append(str(file))
            return opened(file, *arguments, **options)

        return wrapper

    monkeypatch.setattr(builtins, "open", noting(builtins.open))
    monkeypatch.setattr(io, "open", noting(io.open))
    text = json.dumps(recipe())
    assert any(name.endswith("scene_gt.json") for name in read)
    assert [name for name in read if name.endswith((".py", ".pyc"))] == []
    assert ".py" not in text


def test_versions_name_every_method_and_the_library_that_is_its_alone() -> None:
    named = [versions_of(method) for method in METHODS.values()]
    assert named[0] == {"Fpfh": VERSIONS["Fpfh"]}
    assert {"kiss-matcher", "opencv-contrib-python-headless"} <= {name for one in named for name in one}
    kinds = {kind.__name__ for kind in (Ours, OverMatches, Fpfh, FastGlobal, PointPairs, Kiss, BestOf)}
    assert set(STAGES) == set(VERSIONS) == {"cases", "refinement"} | kinds


def main() -> None:
    """Record what the stages give whose versions were raised, or that are named."""
    recorded = json.loads(RECORD.read_text()) if RECORD.exists() else {}
    for stage, gives in STAGES.items():
        if recorded.get(stage, {}).get("version") != VERSIONS[stage] or stage in sys.argv[1:]:
            recorded[stage] = {"version": VERSIONS[stage], "gives": np.round(gives(), 4).tolist()}
            print(f"recorded {stage}")
    lines = [f" {json.dumps(stage)}: {json.dumps(recorded[stage])}" for stage in STAGES]
    RECORD.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    main()
