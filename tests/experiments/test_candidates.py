"""The poses that probabilities are fitted to: what is kept of a search, and what is stored."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from threading import Barrier, Event
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import candidates as module
from experiments.calibrate import Options, calibrate
from experiments.candidates import poses_to_fit
from experiments.fits import FitOptions
from experiments.searches import Sources
from kmn_jax.detection import (
    EVIDENCE,
    PICTURE_EVIDENCE,
    Calibration,
    Candidates,
    DetectConfig,
    DevicePart,
    chosen,
)
from kmn_jax.errors import InputError
from kmn_jax.models import Model, create_model, load_pretrained
from kmn_jax.objects import PartArrays
from kmn_jax.simulate import Surfels
from tests.reference.clouds import box_cloud
from tests.reference.networks import TINY


def test_crops_without_poses_are_dropped_and_the_others_keep_theirs() -> None:
    usable = np.array([False, False, True, False, False, False, False, True])  # two poses of each of four crops
    crop = np.repeat(np.arange(4), 2)
    said: Any = {"logits": np.arange(4)}
    found = Candidates(
        np.arange(8)[:, None], usable, np.arange(8)[:, None] * 10, np.arange(8), crop, said, crop[::2] * 7
    )
    few = module._with_poses(found)
    np.testing.assert_array_equal(few.evidence[:, 0], [20, 30, 60, 70])
    np.testing.assert_array_equal(few.usable, [True, False, False, True])
    np.testing.assert_array_equal(few.crop, [0, 0, 1, 1])
    np.testing.assert_array_equal(few.found["logits"], [1, 3])
    np.testing.assert_array_equal(few.seed_rows, [7, 21])
    none = module._with_poses(found._replace(usable=np.zeros(8, dtype=bool)))
    assert (len(none.usable), len(none.seed_rows)) == (2, 1)


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let two searches be made again, whose pictures tell search, pose and kind of evidence apart.

    Models are named by how many poses they take for right: what chooses is to be the one of ADI, and the exact one that
    of MSSD.
    """

    def searches(sources: Sources, network: Any) -> Any:
        for row in range(2):
            image = SimpleNamespace(errors=None)
            yield SimpleNamespace(row=row, on_device=row, scene=row, number=7 + row, image=image, errors=errors)

    def errors(poses: np.ndarray, measure: Any) -> np.ndarray:
        return np.full(len(poses), 0.01)

    def shown(poses: np.ndarray, part: int, scene: int, agreement: Any) -> np.ndarray:
        assert agreement == DetectConfig().search.agreement
        return poses[:, :1, 3] + 10 * scene + 100 * np.arange(len(PICTURE_EVIDENCE))

    def models(poses: dict[str, np.ndarray], fits: FitOptions) -> Any:
        assert poses["refined"].all()
        return [(np.unique(poses["object"]), int((poses["error"] < 0.1).sum()))]

    def all_but_the_first(found: Candidates, model: int, part: Any, config: Any, exact: int) -> Any:
        assert (model, exact) == (5, 2)
        assert found.evidence.shape[1] == len(EVIDENCE)
        return SimpleNamespace(kept=np.arange(len(found.usable)) > 0)

    monkeypatch.setattr(module, "searches", searches)
    monkeypatch.setattr(module, "picture_evidence", shown)
    monkeypatch.setattr(module, "held_out_models", models)
    monkeypatch.setattr(module, "chosen", all_but_the_first)


@pytest.fixture(scope="module")
def network() -> Model:
    return create_model(TINY, jax.random.key(0))


def store(path: Path, network: Model, names: tuple[str, ...] = EVIDENCE, **others: Any) -> None:
    """Write four poses of one search and two of another: of the first a found one and three refined ones."""
    poses = np.tile(np.eye(4, dtype=np.float32), (6, 1, 1))
    poses[:, 0, 3] = np.arange(6)
    stored = {
        "made_of": np.array(module._made_of(Sources(), FitOptions(), network)),
        "names": np.array(names),
        "used": np.array(names),
        "evidence": np.tile(np.arange(len(names), dtype=np.float32), (6, 1)),
        "error": np.full(6, 0.01),
        "largest_error": np.array([0.01, 0.2, 0.2, 0.2, 0.01, 0.01]),
        "object": np.array([7, 7, 7, 7, 8, 8]),
        "search": np.array([0, 0, 0, 0, 1, 1]),
        "narrowed": np.zeros(6, dtype=bool),
        "T_camera_object": poses,
        "refined": np.array([False, True, True, True, True, True]),
        "due": np.array([False, True, True, True, False, False]),
        "reported": np.zeros(6, dtype=bool),
    }
    np.savez(path, **stored | others)


_OF_CROPS = tuple(name for name in EVIDENCE if name not in PICTURE_EVIDENCE)


@pytest.mark.usefixtures("searched")
def test_stored_poses_are_judged_anew_by_other_evidence(
    tmp_path: Path, network: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, names = tmp_path / "poses.npz", ("what is gone", *reversed(_OF_CROPS))
    store(path, network, names)
    poses = poses_to_fit(Sources(), FitOptions(), network, path)
    assert poses["evidence"].shape == (6, len(EVIDENCE))
    for name in EVIDENCE:
        column = poses["evidence"][:, EVIDENCE.index(name)]
        if name in PICTURE_EVIDENCE:
            wanted = np.array([0, 1, 2, 3, 14, 15]) + 100 * PICTURE_EVIDENCE.index(name)
        else:
            wanted = np.full(6, names.index(name))
        np.testing.assert_array_equal(column, wanted)
    # Of refined poses that detection chooses among, those that are chosen.
    np.testing.assert_array_equal(poses["reported"], [False, False, True, True, False, False])
    with np.load(path) as stored:  # nothing is lost that another day's evidence may want
        assert set(stored["names"].tolist()) == {*EVIDENCE, "what is gone"}
        gone = stored["names"].tolist().index("what is gone")
        np.testing.assert_array_equal(stored["evidence"][:, gone], 0)
    assert sorted(tmp_path.iterdir()) == [path]
    with monkeypatch.context() as patch:
        patch.setattr(module, "searches", None)  # not once more
        again = poses_to_fit(Sources(), FitOptions(), network, path)
    assert again.keys() == poses.keys()
    for name, values in poses.items():
        np.testing.assert_array_equal(again[name], values)


@pytest.mark.usefixtures("searched")
def test_stored_poses_are_judged_anew_if_that_is_asked_for(tmp_path: Path, network: Model) -> None:
    path = tmp_path / "poses.npz"
    store(path, network)
    assert poses_to_fit(Sources(), FitOptions(), network, path)["evidence"][5, 0] == 0
    assert poses_to_fit(Sources(judge_anew=True), FitOptions(), network, path)["evidence"][5, 0] == 15


@pytest.mark.usefixtures("searched")
def test_stored_poses_that_cannot_be_judged_anew_stay(tmp_path: Path, network: Model) -> None:
    path, anew = tmp_path / "poses.npz", Sources(judge_anew=True)
    store(path, network, EVIDENCE[:-1])
    before = path.read_bytes()
    with pytest.raises(InputError, match=f"lacks {EVIDENCE[-1]}, which comes of crops"):
        poses_to_fit(Sources(), FitOptions(), network, path)
    assert path.read_bytes() == before
    other_images = {"error": np.array([0.01, 0.01, 0.01, 0.01, 0.3, 0.01])}
    for wrong in ({"object": np.full(6, 7)}, {"search": np.array([0, 0, 0, 0, 1, 2])}, other_images):
        store(path, network, **wrong)
        with pytest.raises(InputError, match="not those that the stored poses were found in"):
            poses_to_fit(anew, FitOptions(), network, path)


def test_poses_of_other_bins_are_refused(tmp_path: Path) -> None:
    path, output = tmp_path / "poses.npz", tmp_path / "a.json"
    for wrong in ({"made_of": np.array("others")}, {"more": np.zeros(1)}):
        store(path, load_pretrained(), **wrong)
        with pytest.raises(InputError, match="holds poses of other bins, weights or settings: remove it"):
            calibrate(Options(candidates=path, output=output))
    for content in (b"", b"no numbers"):
        path.write_bytes(content)
        with pytest.raises(InputError, match="holds no poses"):
            calibrate(Options(candidates=path, output=output))
    with pytest.raises(InputError, match="no poses to judge anew"):
        calibrate(Options(candidates=tmp_path / "none.npz", output=output, judge_anew=True))
    assert not output.exists()


def test_what_detection_refines_is_told_of_all_forms(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of six candidates four are refined, of which detection, which is stricter, refines two; one form is missing."""
    rows, forms = np.array([0, 2, 3, 5]), 3
    usable = np.ones(len(rows) * forms, dtype=bool)
    usable[5] = False  # the second form of the second candidate

    def stricter(found: None, model: None, part: None, config: DetectConfig) -> Any:
        assert config == DetectConfig()
        kept, contenders = np.zeros((2, 6), dtype=bool)
        kept[[1, 2]], contenders[5] = True, True
        return SimpleNamespace(kept=kept, contenders=contenders)

    monkeypatch.setattr(module, "chosen", stricter)
    nothing: Any = None
    fine: Any = SimpleNamespace(usable=usable)
    due = module._due(nothing, nothing, nothing, rows, fine)
    np.testing.assert_array_equal(due, [False, True, False, True, False, False, True, False, True, False, True])


class Asked:
    """Three searches, of which the third is of a known part, that find what a test can tell apart.

    Models are named by numbers: of poses as they are found, no model knows anything of the second part.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.order = [0, 1, 2]
        self.proposed: list[int] = []
        self.chosen_by: list[tuple[int, int]] = []
        models = {False: {7: 1, 9: 3}, True: {7: 1, 8: 2, 9: 3}}
        monkeypatch.setattr(module, "searches", self.searches)
        monkeypatch.setattr(module, "_first_seeds", lambda search: None)
        monkeypatch.setattr(module, "_propose", lambda search, *given: partial(self.propose, search.scene))
        monkeypatch.setattr(module, "_explored", lambda search, propose, model: self.found(2, 10.0 + model))
        monkeypatch.setattr(module, "_with_poses", lambda found: found)
        monkeypatch.setattr(module, "_models", lambda poses, fits: models[bool(poses["refined"].all())])
        monkeypatch.setattr(module, "model_of", lambda poses, fits: 5)
        monkeypatch.setattr(module, "chosen", self.all_of)
        monkeypatch.setattr(module, "refined_candidates", lambda part, scene, found, *_: found)

    def searches(self, sources: Sources, network: Any) -> Any:
        for row, own in enumerate(self.order):

            def columns(found: Any, row: int = row, own: int = own) -> dict[str, np.ndarray]:
                count = int(found.usable.sum())
                numbers = {"object": 7 + own, "search": row, "error": 0.01, "largest_error": 0.01, "narrowed": False}
                rows = {name: np.full(count, value) for name, value in numbers.items()}
                poses = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
                return rows | {"evidence": np.full((count, len(EVIDENCE)), found.evidence[0]), "T_camera_object": poses}

            facts = {"is_known": own == 2, "number": 7 + own, "name": "abcd"[own], "columns": columns}
            facts["is_empty"] = own == 3
            yield SimpleNamespace(row=row, on_device=own, scene=own, **facts)

    def found(self, count: int, evidence: float) -> Any:
        none: Any = None
        return Candidates(none, np.ones(count, dtype=bool), np.array([evidence]), none, none, none, none)

    def propose(self, own: int, rows: Any) -> Any:
        self.proposed.append(own)
        return self.found(1, 0.0)

    def all_of(self, found: Any, model: int, part: int, config: Any, exact: Any = None) -> Any:
        self.chosen_by.append((part, model))
        count = len(found.usable)
        return SimpleNamespace(kept=np.ones(count, dtype=bool), contenders=np.zeros(count, dtype=bool))


def test_unknown_parts_are_searched_as_detection_does_and_known_ones_at_first_seeds(
    monkeypatch: pytest.MonkeyPatch, network: Model
) -> None:
    """A search of an unknown part is explored with the model that does not know it, one of a known part is not."""
    asked = Asked(monkeypatch)
    result = module.collect(Sources(), FitOptions(), network)
    refined = result["refined"]
    np.testing.assert_array_equal(result["search"][~refined], [0, 1, 2])
    np.testing.assert_array_equal(result["search"][refined], [0, 0, 1, 1, 2])
    np.testing.assert_array_equal(result["evidence"][refined, 0], [11, 11, 15, 15, 0])
    np.testing.assert_array_equal(result["due"][refined], [True, True, True, True, False])
    np.testing.assert_array_equal(result["reported"], result["due"])
    assert sorted(asked.chosen_by[:5]) == [(0, 1), (0, 1), (1, 5), (1, 5), (2, 5)]
    assert sorted(asked.proposed) == [0, 1, 2]  # what was found first is kept in memory, ...
    monkeypatch.setattr(module, "_IN_MEMORY", 0)  # ... or found again
    again = module.collect(Sources(), FitOptions(), network)
    assert sorted(asked.proposed[3:]) == [0, 0, 1, 1, 2, 2]
    for name, values in result.items():
        np.testing.assert_array_equal(again[name], values)


def test_what_was_searched_before_an_end_is_not_searched_again(
    monkeypatch: pytest.MonkeyPatch, network: Model, tmp_path: Path
) -> None:
    asked, folder = Asked(monkeypatch), tmp_path / "searches"
    asked.order = [0, 2]
    before = module.collect(Sources(), FitOptions(), network, folder)
    assert sorted(asked.proposed) == [0, 2]
    (folder / "c-refined.npz").unlink()
    asked.order = [1, 0, 3, 2]  # others may come between, and an empty one
    after = module.collect(Sources(), FitOptions(), network, folder)
    assert sorted(asked.proposed[2:]) == [1, 2]
    for name, values in before.items():
        if name != "search":
            np.testing.assert_array_equal(after[name][after["search"] != 0], values)
    np.testing.assert_array_equal(after["search"], [0, 1, 3, 0, 0, 1, 1, 3])
    count = len(asked.chosen_by)
    module.collect(Sources(), FitOptions(), network, folder)
    assert len(asked.proposed) == 4
    assert asked.chosen_by[count:] == [(1, 2), (0, 1)]  # for what is reported alone
    (folder / "b-found.npz").write_bytes(b"no numbers")
    with pytest.raises(InputError, match=r"b-found.npz holds no poses .*: remove it"):
        module.collect(Sources(), FitOptions(), network, folder)
    with pytest.raises(InputError, match="holds searches by other weights or settings, or other evidence: remove it"):
        module.collect(Sources(method="FPFH"), FitOptions(), network, folder)


def test_searches_run_two_at_once_and_keep_their_order() -> None:
    both, drawn, release = Barrier(2, timeout=20), [], Event()
    items: list[Any] = list(range(6))

    def given() -> Iterator[Any]:
        for item in items:
            drawn.append(item)
            yield item

    def of_item(item: int) -> Any:
        if item < 2:
            both.wait()
        if item == 0:
            release.wait(20)  # ends after the second
            assert max(drawn) <= 3
        elif item == 1:
            release.set()
        return {"error": np.array([item])}

    found = module._side_by_side(of_item, given())  # type: ignore[arg-type]
    assert [int(part["error"][0]) for part in found] == items


def test_an_error_ends_what_was_to_be_searched_next() -> None:
    begun: list[int] = []

    def of_item(item: int) -> Any:
        begun.append(item)
        if item == 1:
            raise InputError("no such image")
        return {}

    items: Any = range(100)
    with pytest.raises(InputError, match="no such image"):
        module._side_by_side(of_item, items)  # type: ignore[arg-type]
    assert len(begun) < 8


def test_a_search_that_finds_nothing_is_kept_as_well(
    monkeypatch: pytest.MonkeyPatch, network: Model, tmp_path: Path
) -> None:
    asked = Asked(monkeypatch)

    def all_but_one(found: Any, model: int, part: int, config: Any, exact: Any = None) -> Any:
        kept = asked.all_of(found, model, part, config, exact)
        kept.kept &= part != 0
        return kept

    monkeypatch.setattr(module, "chosen", all_but_one)
    for _ in range(2):
        result = module.collect(Sources(), FitOptions(), network, tmp_path / "searches")
        np.testing.assert_array_equal(result["search"][result["refined"]], [1, 1, 2])
    assert sorted(asked.proposed) == [0, 1, 2]


@pytest.mark.parametrize("method", ["kmn_jax", "FPFH"])
def test_a_search_is_explored_as_by_detection(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    asked: list[Any] = []

    def explore(scene: Any, part: Any, propose: Any, model: Any, config: DetectConfig, clock: Any) -> Any:
        asked.append((scene, part, model, config))
        return propose("rows"), ("a warning",)

    monkeypatch.setattr(module, "explore", explore)
    monkeypatch.setattr(module, "search_at", lambda *given: given)
    monkeypatch.setattr(module, "fpfh_poses", lambda *given: given)
    monkeypatch.setattr(module, "seeds_over", lambda scene, free, part: (scene, free, part))
    scene = SimpleNamespace(foreground="foreground")
    search: Any = SimpleNamespace(part="stranger", on_device="on device", scene=scene)
    named: Any = {"network": "network", "config": "config", "chooser": "chooser"}
    propose = module._propose(search, named["network"], named["config"], method)
    wanted = {
        "kmn_jax": ("network", "on device", scene, "rows", 0, "config"),
        "FPFH": ("stranger", "on device", scene, "rows"),
    }
    assert module._explored(search, propose, named["chooser"]) == wanted[method]
    assert asked == [(scene, "stranger", "chooser", DetectConfig())]
    assert module._first_seeds(search) == (scene, "foreground", "stranger")


@pytest.mark.usefixtures("searched")
def test_poses_that_are_neither_right_nor_wrong_are_stored_alone(tmp_path: Path, network: Model) -> None:
    path = tmp_path / "poses.npz"
    store(path, network, error=np.array([0.01, 0.01, np.nan, 0.01, 0.01, 0.01]))
    poses = poses_to_fit(Sources(), FitOptions(), network, path)
    np.testing.assert_array_equal(poses["T_camera_object"][:, 0, 3], [0, 1, 3, 4, 5])


def test_another_method_does_not_replace_what_is_shipped() -> None:
    with pytest.raises(InputError, match="--output"):
        calibrate(Options(method="FPFH"))


def test_poses_are_chosen_among_as_those_of_a_search(motor: DevicePart) -> None:
    poses = np.tile(np.eye(4, dtype=np.float32), (8, 1, 1))
    poses[:, 0, 3] = [0, 0.1, 5, 5, 10, 10, 0, 5.1]
    usable = np.array([True, True, False, True, True, False, True, True])
    evidence = np.random.default_rng(0).normal(size=(8, len(EVIDENCE))).astype(np.float32)
    none: Any = np.zeros(8, dtype=np.int32)
    found = Candidates(poses, usable, evidence, none, none, none, none)
    weights = tuple(float(name == "near") for name in EVIDENCE)
    model = Calibration(EVIDENCE, weights, 0.0)
    whole = chosen(found, model, motor, DetectConfig(reported=0.0)).kept
    few = chosen(module._choosable(poses[usable], evidence[usable]), model, motor, DetectConfig(reported=0.0)).kept
    np.testing.assert_array_equal(few, whole[usable])
    assert 0 < few.sum() < len(few)


@pytest.fixture
def motor() -> DevicePart:
    cloud = box_cloud(0, 128, (1.0, 0.6, 0.4))
    points, normals = jnp.asarray(cloud[:, :3]), jnp.asarray(cloud[:, 3:])
    arrays = PartArrays(points, normals, jnp.zeros((128, 1)), jnp.float32(1.2))
    surfels = Surfels(points, normals, jnp.float32(2.5))
    return DevicePart(arrays, surfels, jnp.eye(4)[None], jnp.float32(0.1), jnp.eye(4)[None], jnp.zeros(1, bool))


def test_what_was_searched_before_is_not_searched_again() -> None:
    first: Any = SimpleNamespace(seed_rows=np.array([3, 1]))
    asked: list[list[int]] = []
    propose: Any = module._going_on(first, lambda rows: asked.append(rows.tolist()) or "new")  # type: ignore[arg-type, func-returns-value]
    assert propose(np.array([3, 1])) is first
    assert [propose(np.array(rows)) for rows in ([1, 3], [3], [3, 1, 2])] == ["new"] * 3
    assert asked == [[1, 3], [3], [3, 1, 2]]
