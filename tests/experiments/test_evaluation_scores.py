"""Recall, its intervals and the tables, on poses whose errors are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

from experiments.evaluation.cases import Case
from experiments.evaluation.configs import noise_name
from experiments.evaluation.predictions import Export, Predictions
from experiments.evaluation.published import RECALL
from experiments.evaluation.report import beaten_by, headline
from experiments.evaluation.scores import (
    Cell,
    accuracy_rows,
    cells_of,
    object_rows,
    paired_rows,
    pooled,
    recall_rows,
    seed_rows,
    wilson,
)
from kmn_jax.errors import InputError
from kmn_jax.objects import ObjectModel
from tests.bop.bop_sample import box_model
from tests.reference.poses import some_poses

NOISE = 0.01


def shifted(poses: np.ndarray, by: np.ndarray) -> np.ndarray:
    moved = poses.copy()
    moved[:, :3, 3] += by
    return moved


@pytest.fixture(scope="module")
def model() -> ObjectModel:
    return box_model()


@pytest.fixture
def exported(tmp_path: Path, model: ObjectModel) -> Export:
    """Six cases: three right, one off by a quarter of the diameter, one on another copy, one without a pose."""
    poses = some_poses(6, spread=5 * model.diameter)
    others = shifted(poses, np.array([10 * model.diameter, 0, 0]))
    points = np.zeros((60, 3), dtype=np.float32)
    cases = [Case(f"1/{row}", points, np.stack([poses[row], others[row]]), 0, 1.0) for row in range(6)]
    found = poses.copy()
    found[3, :3, 3] += 0.25 * model.diameter * poses[3, :3, 2]
    found[4] = others[4]
    folder = Export.open(tmp_path / "out", {"config": 1}, overwrite=False)
    folder.write_truth("box", NOISE, cases)
    there = np.array([True, True, True, True, True, False])
    seconds = np.linspace(0.1, 0.6, 6)
    folder.write("ours", "box", NOISE, Predictions(found, poses, there, seconds, seconds))
    return folder


def test_a_pose_is_right_on_any_copy_and_only_within_the_gate(exported: Export, model: ObjectModel) -> None:
    coarse, refined = cells_of(exported, {"box": model}, {"ours": "kmn_jax"}, [NOISE])
    assert coarse.method == "kmn_jax"
    assert refined.method == "kmn_jax + ICP"
    assert np.isinf(coarse.errors[5])
    np.testing.assert_allclose(coarse.errors[[0, 1, 2, 4]], 0, atol=1e-5)
    assert coarse.errors[3] == pytest.approx(0.25, abs=1e-4)
    assert coarse.recall() == pytest.approx(4 / 6)
    assert coarse.seed_recall() == pytest.approx(3 / 6)
    np.testing.assert_array_equal(coarse.on_seed, [True, True, True, True, False, False])
    assert refined.recall() == pytest.approx(5 / 6)
    np.testing.assert_allclose(refined.seconds, 2 * coarse.seconds)


def test_how_exact_poses_are(exported: Export, model: ObjectModel) -> None:
    coarse, _ = cells_of(exported, {"box": model}, {"ours": "kmn_jax"}, [NOISE])
    off = coarse.offsets
    assert off is not None
    right = coarse.errors < 0.1
    np.testing.assert_allclose(off.millimetres[right], 0, atol=1e-3 * model.diameter)
    np.testing.assert_allclose(off.degrees[right], 0, atol=0.05)
    np.testing.assert_allclose([off.shares[3], off.mssd[3]], 0.25, atol=1e-3)
    assert off.millimetres[3] == pytest.approx(0.25 * model.diameter, rel=1e-3)
    assert all(np.isinf(column[5]) for column in off)
    (row,) = accuracy_rows([pooled([coarse, coarse], "all")], NOISE)
    assert row["MSSD recall"] == "0.67"
    # Four of six are below all thresholds, one of them from 0.3 on.
    assert row["MSSD recall, BOP"] == f"{(4 + 0.5) / 6:.2f}"
    assert all(float(text) < 0.1 for text in row["shifted, % of the diameter"].split(" / "))
    assert accuracy_rows([cell("FPFH", "a", 9)], 0.0) == []
    assert accuracy_rows([coarse], 0.5) == []


def test_the_gate_by_the_diagonal_is_the_wider_one(model: ObjectModel) -> None:
    cell = Cell(
        "m", "o", 0.0, np.array([0.05, 0.105, 0.2]), np.ones(3, bool), np.full(3, 1.1), np.ones(3), np.full(3, "scan")
    )
    assert cell.recall("diameter") == pytest.approx(1 / 3)
    assert cell.recall("diagonal") == pytest.approx(2 / 3)


@pytest.mark.parametrize(
    ("right", "total", "interval"),
    [(5, 10, (0.2366, 0.7634)), (0, 10, (0.0, 0.2775)), (10, 10, (0.7225, 1.0)), (95, 100, (0.8882, 0.9785))],
)
def test_wilson_intervals(right: int, total: int, interval: tuple[float, float]) -> None:
    np.testing.assert_allclose(wilson(right, total), interval, atol=1e-4)


def test_an_interval_of_nothing_is_everything() -> None:
    assert wilson(0, 0) == (0.0, 1.0)


def cell(method: str, name: str, right: int, total: int = 100, noise: float = 0.0) -> Cell:
    errors = np.where(np.arange(total) < right, 0.0, np.inf)
    scans = np.array([f"{name}/{row % 20}" for row in range(total)])
    return Cell(method, name, noise, errors, errors < 1, np.ones(total), np.full(total, 0.01), scans)


def test_tables_and_where_others_find_more() -> None:
    cells = [
        cell("kmn_jax + ICP", "a", 80),
        cell("FPFH", "a", 99),
        cell("kmn_jax + ICP", "b", 90),
        cell("FPFH", "b", 91),
    ]
    rows = recall_rows(cells, "all")
    assert [row["method"] for row in rows] == ["kmn_jax + ICP", "FPFH"]
    assert rows[0]["noise 0%"].startswith("0.85 (")
    assert rows[0]["crops"] == 200
    assert rows[0]["mean ms"] == pytest.approx(10)
    by_object = object_rows(cells, 0.0)
    assert [list(row) for row in by_object] == [["method", "a", "b"]] * 2
    assert by_object[1]["b"].startswith("0.91 (")
    assert pooled([cells[0], cells[2]], "all").recall() == pytest.approx(0.85)


def test_paired_differences_take_scans_as_independent() -> None:
    own, other = cell("kmn_jax + ICP", "a", 100), cell("FPFH", "a", 100)
    lost = np.where(np.isin(other.scenes, ["a/0", "a/1"]), np.inf, 0.0)
    ahead, low, high = own.ahead_of(replace(other, errors=lost))
    spread = 1.959964 * np.sqrt(0.1 * 0.9 / 19)  # two scans of twenty, in which all five crops go wrong together
    np.testing.assert_allclose([ahead, low, high], [0.1, 0.1 - spread, 0.1 + spread], atol=1e-9)
    apart = replace(other, errors=lost, scenes=np.arange(100).astype(str))
    assert apart.ahead_of(own)[2] - apart.ahead_of(own)[1] < 1.5 * spread
    assert own.ahead_of(own) == (0.0, 0.0, 0.0)
    single = np.zeros(len(own.errors), dtype=int)
    assert replace(own, scenes=single).ahead_of(replace(other, errors=lost, scenes=single)) == (ahead, -1.0, 1.0)
    cells = [own, replace(other, errors=lost)] + [replace(one, noise=0.05) for one in (own, other)]
    (row,) = paired_rows(cells, "kmn_jax + ICP")
    assert row["method"] == "FPFH"
    assert row["noise 0%"].startswith("+0.100 (-0.0")
    assert row["noise 5%, by diagonal"] == "+0.000 (+0.000 to +0.000)"


def test_the_headline_is_of_all_objects_without_noise() -> None:
    cells = [cell("kmn_jax + ICP", "a", 80), cell("kmn_jax + ICP", "b", 90), cell("FPFH", "a", 60)]
    cells += [cell("FPFH", "b", 70), cell("FPFH + ICP", "a", 70), cell("FPFH + ICP", "b", 80)]
    cells += [replace(one, noise=0.05, errors=np.full(100, np.inf)) for one in cells]
    rivals = {"FPFH", "FPFH + ICP"}
    assert headline(cells, "kmn_jax + ICP", rivals) == (
        "kmn_jax + ICP finds the right pose in 85% of the crops of 2 objects, the best rival, FPFH + ICP, in 75%"
        " (noise 0%)."
    )
    assert headline(cells[:1], "kmn_jax + ICP", rivals) == (
        "kmn_jax + ICP finds the right pose in 80% of the crops of 1 object (noise 0%)."
    )
    assert headline(cells, "none", rivals) == ""


def test_methods_that_find_more_are_named_at_either_gate() -> None:
    own, near = "kmn_jax + ICP", "kmn_jax, trained for the object"
    errors = np.where(np.arange(100) < 85, 0.105, np.inf)  # right by the diagonal alone
    wide = replace(cell(near, "b", 85), errors=errors, diagonal=np.full(100, 1.1))
    cells = [cell(own, "a", 80), cell("FPFH", "a", 99), cell(own, "b", 90), cell("FPFH", "b", 91), wide]
    cells += [cell("kmn_jax", "a", 90), cell(near, "a", 80)]
    lines = beaten_by(cells, own, {"FPFH", near})
    assert lines == [
        "a, noise 0%, by diameter: FPFH 0.99, kmn_jax + ICP 0.80 (beyond the intervals)",
        "b, noise 0%, by diameter: FPFH 0.91, kmn_jax + ICP 0.90 (within the intervals)",
        "a, noise 0%, by diagonal: FPFH 0.99, kmn_jax + ICP 0.80 (beyond the intervals)",
        "b, noise 0%, by diagonal: FPFH 0.91, kmn_jax + ICP 0.90 (within the intervals)",
    ]
    cells[2] = cell(own, "b", 80)
    assert beaten_by(cells, own, {near}) == [
        "b, noise 0%, by diagonal: kmn_jax, trained for the object 0.85, kmn_jax + ICP 0.80 (within the intervals)"
    ]
    assert [line[:2] for line in beaten_by(cells, own, {"kmn_jax"})] == ["a,", "a,"]


def test_small_noises_have_columns_of_their_own() -> None:
    cells = [cell("FPFH", "a", right, noise=noise) for noise, right in ((0.0, 90), (0.004, 80), (0.07, 10))]
    (row,), (seeds,) = recall_rows(cells, "all"), seed_rows(cells)
    assert [row[name][:4] for name in ("noise 0%", "noise 0.4%", "noise 7%")] == ["0.90", "0.80", "0.10"]
    assert list(seeds) == ["method", "noise 0%", "noise 0.4%", "noise 7%"]
    assert {*RECALL["industrial"][0]} == {"method", *map(noise_name, (0.0, 0.01, 0.05))}


def test_a_method_can_be_added_and_one_of_other_settings_is_refused(tmp_path: Path, model: ObjectModel) -> None:
    folder, none = tmp_path / "methods", np.zeros((0, 4, 4))
    nothing = Predictions(none, none, np.zeros(0, dtype=bool), np.zeros(0), np.zeros(0))

    def opened(methods: dict[str, int], overwrite: bool = False) -> Export:
        return Export.open(folder, {"config": 1, "methods": methods}, overwrite)

    opened({"a": 1}).write("a", "box", NOISE, nothing)
    opened({"b": 1}).write("b", "box", NOISE, nothing)
    with pytest.raises(InputError, match=r"differing: method a\)"):
        opened({"a": 2})
    kept = opened({"a": 1, "b": 1})
    assert len(kept.read("a", "box", NOISE).found) == len(kept.read("b", "box", NOISE).found) == 0
    own = folder / "a" / "network.safetensors"
    own.write_bytes(save({"weights": np.zeros(1)}))  # somebody's own
    changed = opened({"a": 2}, overwrite=True)
    assert not changed.path("a", "box", NOISE).exists()
    assert own.exists()
    assert len(changed.read("b", "box", NOISE).found) == 0


def test_what_another_recipe_made_is_refused(tmp_path: Path, exported: Export, model: ObjectModel) -> None:
    Export.open(tmp_path / "out", {"config": 1}, overwrite=False)
    with pytest.raises(InputError, match="differing: config"):
        Export.open(tmp_path / "out", {"config": 2}, overwrite=False)
    assert exported.read("ours", "box", NOISE).found.sum() == 5  # nothing was lost
    fresh = Export.open(tmp_path / "out", {"config": 2}, overwrite=True)
    with pytest.raises(InputError, match=r"noise0\.01"):
        fresh.read("ours", "box", NOISE)


def test_a_file_of_another_recipe_or_none_is_refused(tmp_path: Path, exported: Export) -> None:
    other = Export.open(tmp_path / "other", {"config": 2}, overwrite=False)
    source = exported.path("ours", "box", NOISE)
    target = other.path("ours", "box", NOISE)
    target.parent.mkdir()
    target.write_bytes(source.read_bytes())
    with pytest.raises(InputError, match="another recipe"):
        other.read("ours", "box", NOISE)
    target.write_bytes(source.read_bytes()[:100])
    with pytest.raises(InputError, match="box"):
        other.read("ours", "box", NOISE)
    (tmp_path / "other" / "recipe.json").write_text("{")
    with pytest.raises(InputError, match=r"recipe\.json"):
        Export.open(tmp_path / "other", {"config": 2}, overwrite=False)
    (tmp_path / "other" / "recipe.json").write_text("[]")
    with pytest.raises(InputError, match="is no recipe"):
        Export.open(tmp_path / "other", {"config": 2}, overwrite=True)
