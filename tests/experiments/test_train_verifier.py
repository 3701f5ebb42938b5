"""The training of the pose verifier: it learns what tells right from wrong, the same each time."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import train_verifier as module
from experiments.train_verifier import Options, fitted, log_odds_of, train_verifier
from kmn_jax.detection import PREDICTED_CHANNELS
from kmn_jax.errors import InputError
from kmn_jax.models import VERIFIER_CHANNELS, load_verifier
from kmn_jax.report import markdown_table

SIDE = 8


def drawn(count: int, random_seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return cells of poses that are right where there is no gap in the third channel, in one corner or another."""
    rng = np.random.default_rng(random_seed)
    cells = rng.normal(0, 0.1, (count, SIDE, SIDE, VERIFIER_CHANNELS))
    right = rng.random(count) < 0.5
    for row in np.flatnonzero(~right):
        top, left = rng.choice([0, SIDE - 3], 2)
        cells[row, top : top + 3, left : left + 3, 2] += 1
    return cells.astype(np.float16), right.astype(np.float32)


def options(tmp_path: Path, **others: Any) -> Options:
    given = {
        "candidates": tmp_path / "poses.npz",
        "output": tmp_path / "verifier.safetensors",
        "epochs": 4,
        "batch": 16,
    }
    return Options(**given | others)


def test_it_learns_from_a_corner_of_the_picture(tmp_path: Path) -> None:
    cells, right = drawn(320)
    cells[160:, ..., 2] = 0
    weights = np.where(np.arange(320) < 160, 2.0, 0.0).astype(np.float32)  # the others tell nothing, and count nothing
    verifier, again = (fitted(cells, right, weights, options(tmp_path, epochs=12)) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, verifier.parameters, again.parameters)
    other = fitted(cells, right, weights, options(tmp_path, epochs=12, random_seed=1))
    assert not np.array_equal(other.parameters["out"]["bias"][...], verifier.parameters["out"]["bias"][...])
    fresh, truth = drawn(200, 1)
    for one in (verifier, other):
        assert ((log_odds_of(one, fresh) > 0) == (truth > 0)).mean() > 0.9


def test_pictures_are_turned_as_wholes() -> None:
    cells = np.arange(SIDE * SIDE * 2, dtype=np.float32).reshape(SIDE, SIDE, 2)
    found = {
        np.asarray(module._turned(cells, np.array([up, left, across]))).tobytes()
        for up in (False, True)
        for left in (False, True)
        for across in (False, True)
    }
    wanted = {np.rot90(one, turns).tobytes() for one in (cells, cells[::-1]) for turns in range(4)}
    assert found == wanted


def test_what_was_measured_is_spoiled_in_half_of_the_pictures() -> None:
    cells = jnp.ones((48, 48, VERIFIER_CHANNELS))
    spoiled = np.asarray(jax.vmap(module._spoiled, in_axes=(None, 0))(cells, jax.random.split(jax.random.key(0), 200)))
    measured = np.delete(spoiled, PREDICTED_CHANNELS, axis=-1)
    assert (spoiled[..., PREDICTED_CHANNELS] == 1).all()
    assert (measured == measured[..., :1]).all()
    lost = measured[..., 0] == 0
    assert 0.4 < lost.any(axis=(1, 2)).mean() < 0.6
    heights, widths = lost.any(axis=2).sum(axis=1), lost.any(axis=1).sum(axis=1)
    np.testing.assert_array_equal(lost.sum(axis=(1, 2)), heights * widths)  # rectangles
    for sizes in (heights, widths):
        assert sizes.max() in (23, 24, 25)
        assert len(np.unique(sizes)) > 15  # at the edges of the picture smaller ones


def test_how_well_it_does_is_told() -> None:
    log_odds, right = np.array([3.0, 2.0, 1.0, -1.0]), np.array([1.0, 1.0, 0.0, 1.0])
    told = module._judged(log_odds, right)
    assert (told["poses"], told["right"]) == (4, 0.75)
    assert told["loss"] == pytest.approx(np.log1p(np.exp([-3, -2, 1, 1])).mean())
    assert told["recall at 95% right"] == pytest.approx(2 / 3)
    assert module._judged(log_odds, np.zeros(4))["recall at 95% right"] == 0


def test_known_parts_are_learned_from_and_others_told_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cells, right = drawn(80)
    poses = {
        "error": np.where(right > 0, 0.01, np.inf),
        "object": np.repeat([101, 102, 3], [40, 20, 20]),
        "known": np.arange(80) < 60,
        "refined": np.arange(80) >= 60,  # of known parts nothing is
        "due": (np.arange(80) >= 60) & (np.arange(80) % 4 == 0),
        "reported": np.zeros(80, dtype=bool),
        "row": np.arange(80),
    }
    poses["error"][5] = np.nan  # neither right nor wrong
    seen_errors = poses["error"].copy()
    seen_errors[7] = np.nan  # the same, once it is moved
    seen_errors[8] = np.inf if right[8] else 0.0  # another outcome
    asked: list[Any] = []

    def fit(cells: np.ndarray, right: np.ndarray, weights: np.ndarray, options: Options) -> Any:
        asked.append((cells, right, weights))
        return module.create_verifier(jax.random.key(0))

    monkeypatch.setattr(module, "read_poses", lambda *given: (dict(poses), ("a column",), ("a column",)))
    monkeypatch.setattr(
        module, "_seen", lambda poses, options, network: (cells[poses["row"]], seen_errors[poses["row"]])
    )
    monkeypatch.setattr(module, "fitted", fit)
    given = options(tmp_path, json=tmp_path / "told.json")
    result = train_verifier(given)
    ((seen, labels, weights),) = asked
    rows = np.delete(np.arange(60), [5, 7])
    learned = weights > 0
    np.testing.assert_array_equal(seen[learned], cells[rows])
    np.testing.assert_array_equal(labels[learned], seen_errors[rows] < module.THRESHOLD)
    assert labels[learned][6] != (poses["error"][8] < module.THRESHOLD)
    weights = weights[learned]
    np.testing.assert_allclose(weights.mean(), 1, rtol=1e-6)
    np.testing.assert_allclose(weights[-1] / weights[0], (38 / 20) ** 0.5, rtol=1e-6)
    assert [(row["poses of"], row["poses"]) for row in result["verifier"]] == [("known parts", 58), ("other parts", 5)]
    assert load_verifier(given.output)
    assert markdown_table(result["verifier"]) in given.output.with_suffix(".md").read_text(encoding="utf-8")
    assert (tmp_path / "told.json").exists()
    poses["known"][:] = False
    with pytest.raises(InputError, match="holds no poses of known worlds"):
        train_verifier(given)


def test_each_pose_has_the_cells_of_its_own_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = SimpleNamespace(surfels=1.0, arrays=SimpleNamespace(diameter=2.0))

    def errors(poses: np.ndarray, of: str) -> np.ndarray:
        assert of == "errors"
        return poses[:, 0, 3] / 100

    def searched(poses: Any, options: Any, network: Any) -> Any:
        for row in (1, 0):
            scene, image = SimpleNamespace(image=10.0 * row), SimpleNamespace(errors="errors")
            facts = {"on_device": part, "scene": scene, "image": image, "errors": errors, "is_known": row == 1}
            facts["name"] = f"search-{row}"
            yield SimpleNamespace(**facts), np.flatnonzero(poses["search"] == row)

    shown: list[float] = []

    def cells(pose: np.ndarray, surfels: float, image: float, diameter: float) -> np.ndarray:
        shown.append(float(pose[0, 3]))
        shape = (module.VERIFIER_SIDE, module.VERIFIER_SIDE, VERIFIER_CHANNELS)
        return np.full(shape, pose[0, 3] + image + surfels * diameter)

    def moved(poses: np.ndarray, on_device: Any, image: float) -> np.ndarray:
        assert (on_device, image) == (part, 10.0)
        return poses + 0.5

    monkeypatch.setattr(module, "searches_of", searched)
    monkeypatch.setattr(module, "_cells", cells)
    monkeypatch.setattr(module, "polish", moved)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = np.arange(4)
    stored = {"error": np.full(4, 0.2), "search": np.array([0, 1, 0, 1]), "T_camera_object": poses}
    nothing: Any = None
    found, off = module._seen(stored, options(tmp_path), nothing)
    assert found.dtype == np.float16
    np.testing.assert_array_equal(found[:, 3, 5, 2], [2, 13.5, 4, 15.5])
    np.testing.assert_allclose(off, [0.2, 0.015, 0.2, 0.035])
    np.testing.assert_array_equal(stored["T_camera_object"][:, 0, 3], np.arange(4))
    assert len(shown) == 4
    again = module._seen(stored, options(tmp_path), nothing)  # what was ended goes on
    np.testing.assert_array_equal(again[0], found)
    np.testing.assert_array_equal(again[1], off)
    assert len(shown) == 4
    poses[2, 0, 3] = 7
    np.testing.assert_array_equal(module._seen(stored, options(tmp_path), nothing)[0][:, 3, 5, 2], [2, 13.5, 9, 15.5])
    assert sorted(shown[4:]) == [0, 7]  # of the search that found other poses
    stored["error"] = stored["error"] / 2
    np.testing.assert_allclose(module._seen(stored, options(tmp_path), nothing)[1], [0.1, 0.015, 0.1, 0.035])


def test_what_cannot_be_trained_is_refused(tmp_path: Path) -> None:
    cells, right = drawn(8)
    with pytest.raises(InputError, match="8 poses are less than a batch of 16"):
        fitted(cells, right, np.ones(8), options(tmp_path))
    with pytest.raises(InputError, match="7 poses are less than a batch of 16"):
        fitted(*drawn(40), (np.arange(40) < 7).astype(float), options(tmp_path))
    for wrong in ({"epochs": 0}, {"batch": 0}):
        with pytest.raises(InputError, match="must be at least 1"):
            options(tmp_path, **wrong)
    for rate in ({"learning_rate": 0.0}, {"weight_decay": -1.0}):
        with pytest.raises(InputError, match="must"):
            fitted(*drawn(16), np.ones(16), options(tmp_path, **rate))
    with pytest.raises(InputError, match=r"poses\.npz does not exist: python -m experiments\.calibrate --candidates"):
        train_verifier(options(tmp_path))
    (tmp_path / "poses.npz").write_bytes(b"damaged")
    with pytest.raises(InputError, match="holds no poses"):
        train_verifier(options(tmp_path))
