"""The collection of poses: what each search is made of, in which order, and what is kept of one that was ended."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from experiments import candidates as module
from experiments import reported_poses
from experiments.fits import FitOptions, weights_of
from experiments.searches import Sources
from kmn_jax.detection import EVIDENCE, Calibration, Candidates, DetectConfig
from kmn_jax.errors import InputError
from kmn_jax.models import Model, create_model
from tests.reference.named_models import Named
from tests.reference.networks import TINY
from tests.reference.parts import box_part, on_device

SOURCES = Sources(known_worlds=(Path("known"),))


@pytest.fixture(scope="module")
def network() -> Model:
    return create_model(TINY, jax.random.key(0))


def test_candidates_are_refined_in_the_turns_of_detection(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the first two places there are two candidates each; one beside them is just not probable enough."""
    part = on_device(box_part())
    places, odds = [9.0, 9.06, 0.0, 0.1, 0.8], [3.0, 1.0, 3.0, 0.0, -3.0]
    poses = np.tile(np.eye(4, dtype=np.float32), (5, 1, 1))
    poses[:, 0, 3] = np.array(places) * float(part.arrays.diameter)
    evidence = np.zeros((5, len(EVIDENCE)), dtype=np.float32)
    evidence[:, 0] = odds
    none: Any = None
    found = Candidates(poses, np.ones(5, dtype=bool), evidence, none, none, none, none)
    model = Calibration(EVIDENCE, (1.0,) + (0.0,) * (len(EVIDENCE) - 1), 0.0)
    rows, turns = module._turns(found, model, part)
    assert (rows.tolist(), turns.tolist()) == ([0, 2, 1, 3, 4], [0, 0, 1, 1, -1])
    rows, turns = module._turns(found._replace(usable=np.arange(5) == 4), model, part)
    assert (rows.tolist(), turns.tolist()) == ([4], [-1])
    monkeypatch.setattr(module, "CONFIG", DetectConfig(next_best=0))
    rows, turns = module._turns(found, model, part)
    assert (rows.tolist(), turns.tolist()) == ([0, 2, 4], [0, 0, -1])


class Asked:
    """Three searches, of which the third is of a known part, that find what a test can tell apart.

    Models are named by numbers: of poses as they are found, no model knows anything of the second part.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.order = [0, 1, 2]
        self.proposed: list[int] = []
        self.chosen_by: list[tuple[int, int]] = []
        monkeypatch.setattr(module, "searches", self.searches)
        monkeypatch.setattr(module, "_first_seeds", lambda search: None)
        monkeypatch.setattr(module, "_propose", lambda search, *given: partial(self.propose, search.scene))
        monkeypatch.setattr(module, "_explored", lambda search, propose, model: self.found(2, 10.0 + model))
        for of in (module, reported_poses):
            monkeypatch.setattr(of, "models_of_others", self.models)
            monkeypatch.setattr(of, "chosen", self.all_of)
        monkeypatch.setattr(module, "model_of", lambda poses, fits: 5)
        monkeypatch.setattr(reported_poses, "averaged", Named)
        monkeypatch.setattr(reported_poses, "scale_of", lambda *given: (1.5, 0.5))
        monkeypatch.setattr(module, "next_best_rows", lambda *given: np.zeros(0, dtype=int))
        monkeypatch.setattr(module, "refined_candidates", lambda part, scene, found, *_: found)

    def searches(self, sources: Sources, network: Any) -> Any:
        for row, own in enumerate(self.order):
            if own == 2 and not sources.known_worlds:
                continue

            def columns(found: Any, row: int = row, own: int = own) -> dict[str, np.ndarray]:
                count = int(found.usable.sum())
                numbers = {"object": 7 + own, "search": row, "narrowed": False}
                rows = {name: np.full(count, value) for name, value in numbers.items()}
                rows |= dict.fromkeys(("error", "largest_error"), np.where(np.arange(count) == 1, 0.5, 0.01))
                poses = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
                return rows | {"evidence": np.full((count, len(EVIDENCE)), found.evidence[0]), "T_camera_object": poses}

            facts = {"is_known": own == 2, "number": 7 + own, "name": "abcd"[own], "columns": columns}
            facts["is_empty"] = own == 3
            yield SimpleNamespace(row=row, on_device=own, scene=own, **facts)

    def models(self, poses: dict[str, np.ndarray], fits: FitOptions) -> dict[int, int]:
        assert len(weights_of(poses, fits)) == len(poses["error"])  # all columns that fits want are there
        return {7: 1, 8: 2, 9: 3} if poses["refined"].all() else {7: 1, 9: 3}

    def found(self, count: int, evidence: float) -> Any:
        none: Any = None
        poses = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
        return Candidates(poses, np.ones(count, dtype=bool), np.array([evidence]), none, none, none, none)

    def propose(self, own: int, rows: Any) -> Any:
        self.proposed.append(own)
        return self.found(1, 0.0)

    def all_of(self, found: Any, model: int, part: int, config: Any, exact: Any = None) -> Any:
        self.chosen_by.append((part, model))
        count = len(found.usable)
        return SimpleNamespace(kept=np.ones(count, dtype=bool), contenders=np.zeros(count, dtype=bool))


def test_unknown_parts_are_searched_as_detection_does_and_known_ones_at_first_seeds_alone(
    monkeypatch: pytest.MonkeyPatch, network: Model
) -> None:
    """A search of an unknown part is explored with the model that does not know it, one of a known part has ended."""
    asked = Asked(monkeypatch)
    result = module.collect(SOURCES, FitOptions(), network)
    refined = result["refined"]
    np.testing.assert_array_equal(result["search"][~refined], [0, 1, 2])
    np.testing.assert_array_equal(result["search"][refined], [0, 0, 1, 1])
    np.testing.assert_array_equal(result["known"], result["search"] == 2)
    np.testing.assert_array_equal(result["evidence"][refined, 0], [11, 11, 15, 15])
    assert result["due"][refined].all()
    np.testing.assert_array_equal(result["reported"], result["due"])
    assert sorted(asked.chosen_by[:4]) == [(0, 1), (0, 1), (1, 5), (1, 5)]
    assert sorted(asked.proposed) == [0, 1, 2]  # what was found first is kept in memory, ...
    monkeypatch.setattr(module, "_IN_MEMORY", 0)  # ... or found again
    again = module.collect(SOURCES, FitOptions(), network)
    assert sorted(asked.proposed[3:]) == [0, 0, 1, 1, 2]
    for name, values in result.items():
        np.testing.assert_array_equal(again[name], values)


def test_other_forms_of_poses_have_their_turns(monkeypatch: pytest.MonkeyPatch, network: Model) -> None:
    """Of two candidates, the second of which is refined first, the first has no second form."""
    asked = Asked(monkeypatch)
    asked.order = [0]
    monkeypatch.setattr(module, "_turns", lambda *given: (np.array([1, 0]), np.array([0, 1])))

    def forms(part: int, scene: int, found: Any, rows: np.ndarray, seed: int, config: Any) -> Any:
        assert rows.tolist() == [1, 0]
        return asked.found(4, 0.0)._replace(usable=np.array([True, True, True, False]))

    seen: list[list[int]] = []

    def in_turns(found: Any, turns: np.ndarray, *models: int) -> tuple[np.ndarray, np.ndarray]:
        seen.append(turns.tolist())
        return np.array([False, True, False]), np.array([True, True, False])

    monkeypatch.setattr(module, "refined_candidates", forms)
    monkeypatch.setattr(reported_poses, "_chosen_in_turns", in_turns)
    result = module.collect(Sources(), FitOptions(), network)
    assert seen == [[0, 1, 0]]  # of one outcome no scale is known
    assert result["turn"].tolist() == [-1, 0, 1, 0]
    assert result["reported"].tolist() == [False, False, True, False]
    assert result["due"].tolist() == [False, True, True, False]


def test_what_was_searched_before_an_end_is_not_searched_again(
    monkeypatch: pytest.MonkeyPatch, network: Model, tmp_path: Path
) -> None:
    asked, folder = Asked(monkeypatch), tmp_path / "searches"
    asked.order = [0, 2]
    before = module.collect(SOURCES, FitOptions(), network, folder)
    assert sorted(asked.proposed) == [0, 2]
    (folder / "a-refined.npz").unlink()
    asked.order = [1, 0, 3, 2]  # others may come between, and an empty one
    after = module.collect(SOURCES, FitOptions(), network, folder)
    assert sorted(asked.proposed[2:]) == [0, 1]
    for name, values in before.items():
        if name != "search":
            np.testing.assert_array_equal(after[name][after["search"] != 0], values)
    np.testing.assert_array_equal(after["search"], [0, 1, 3, 0, 0, 1, 1])
    count = len(asked.chosen_by)
    module.collect(SOURCES, FitOptions(), network, folder)
    assert len(asked.proposed) == 4
    scales = (), (1.5, 0.5)
    of_others = [(part, models + scale) for part, models in ((0, (1, 1)), (1, (2, 2))) for scale in scales]
    assert sorted(asked.chosen_by[count:]) == of_others  # for what is reported alone
    (folder / "b-found.npz").write_bytes(b"no numbers")
    with pytest.raises(InputError, match=r"b-found.npz holds no poses .*: remove it"):
        module.collect(SOURCES, FitOptions(), network, folder)
    with pytest.raises(InputError, match="holds searches by other weights or settings, or other evidence: remove it"):
        module.collect(Sources(method="FPFH"), FitOptions(), network, folder)


def test_bins_of_which_nothing_can_be_searched_are_refused(monkeypatch: pytest.MonkeyPatch, network: Model) -> None:
    asked = Asked(monkeypatch)
    asked.order = [3]
    with pytest.raises(InputError, match="nothing of the bins can be searched"):
        module.collect(SOURCES, FitOptions(), network)


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
        result = module.collect(SOURCES, FitOptions(), network, tmp_path / "searches")
        np.testing.assert_array_equal(result["search"][result["refined"]], [1, 1])
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
    assert asked == [(scene, "stranger", "chooser", module.CONFIG)]
    assert module._first_seeds(search) == (scene, "foreground", "stranger")


def test_what_was_searched_before_is_not_searched_again() -> None:
    first: Any = SimpleNamespace(seed_rows=np.array([3, 1]))
    asked: list[list[int]] = []
    propose: Any = module._going_on(first, lambda rows: asked.append(rows.tolist()) or "new")  # type: ignore[arg-type, func-returns-value]
    assert propose(np.array([3, 1])) is first
    assert [propose(np.array(rows)) for rows in ([1, 3], [3], [3, 1, 2])] == ["new"] * 3
    assert asked == [[1, 3], [3], [3, 1, 2]]
