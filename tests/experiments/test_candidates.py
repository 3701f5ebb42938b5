"""The poses that probabilities are fitted to: what is kept of a search, and what is stored."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import candidates as module
from experiments import reported_poses
from experiments.calibrate import Options, calibrate
from experiments.candidates import poses_to_fit
from experiments.fits import FitOptions
from experiments.searches import Sources
from kmn_jax.detection import (
    EVIDENCE,
    PICTURE_EVIDENCE,
    VERIFIED,
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
from tests.reference.named_models import Named
from tests.reference.networks import TINY


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> set[Named]:
    """Let two searches be made again, whose pictures tell search, pose and kind of evidence apart.

    Models are named by how many poses they take for right: what chooses is to be the mean of those of ADI and of MSSD,
    at last on the scale of what was chosen at first, and the exact one that of MSSD. Returned is what was asked.
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

    def shown_to_verifier(poses: np.ndarray, part: int, scene: int) -> np.ndarray:
        return -poses[:, 0, 3] - 10 * scene

    def models(poses: dict[str, np.ndarray], fits: FitOptions) -> dict[int, int]:
        assert poses["refined"].all()
        return dict.fromkeys(np.unique(poses["object"]).tolist(), int((poses["error"] < 0.1).sum()))

    def scale(poses: dict[str, np.ndarray], logits: np.ndarray, fits: FitOptions) -> tuple[float, float]:
        assert asked == {(4, 2)}
        np.testing.assert_array_equal(poses["T_camera_object"][:, 0, 3], [2, 3])
        return 1.5, 0.5

    asked: set[Named] = set()

    def all_but_the_first(found: Candidates, model: Named, part: Any, config: Any, exact: int) -> Any:
        asked.add(model)
        assert exact == 2
        assert found.evidence.shape[1] == len(EVIDENCE)
        return SimpleNamespace(kept=np.arange(len(found.usable)) > 0)

    monkeypatch.setattr(module, "searches", searches)
    monkeypatch.setattr(module, "picture_evidence", shown)
    monkeypatch.setattr(module, "verified", shown_to_verifier)
    monkeypatch.setattr(reported_poses, "models_of_others", models)
    monkeypatch.setattr(reported_poses, "averaged", Named)
    monkeypatch.setattr(reported_poses, "scale_of", scale)
    monkeypatch.setattr(reported_poses, "chosen", all_but_the_first)
    return asked


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
        "error": np.array([0.01, 0.01, 0.01, 0.5, 0.01, 0.01]),
        "largest_error": np.array([0.01, 0.2, 0.2, 0.2, 0.01, 0.01]),
        "object": np.array([7, 7, 7, 7, 8, 8]),
        "search": np.array([0, 0, 0, 0, 1, 1]),
        "known": np.zeros(6, dtype=bool),
        "narrowed": np.zeros(6, dtype=bool),
        "T_camera_object": poses,
        "refined": np.array([False, True, True, True, True, True]),
        "turn": np.array([-1, 0, 0, 0, -1, -1]),
        "due": np.zeros(6, dtype=bool),
        "reported": np.zeros(6, dtype=bool),
    }
    np.savez(path, **stored | others)


_OF_CROPS = tuple(name for name in EVIDENCE if name not in (*PICTURE_EVIDENCE, VERIFIED))


def test_stored_poses_are_judged_anew_by_other_evidence(
    tmp_path: Path, network: Model, monkeypatch: pytest.MonkeyPatch, searched: set[Named]
) -> None:
    path, names = tmp_path / "poses.npz", ("what is gone", *reversed(_OF_CROPS))
    store(path, network, names)
    poses = poses_to_fit(Sources(), FitOptions(), network, path)
    assert poses["evidence"].shape == (6, len(EVIDENCE))
    for name in EVIDENCE:
        column = poses["evidence"][:, EVIDENCE.index(name)]
        if name in PICTURE_EVIDENCE:
            wanted = np.array([0, 1, 2, 3, 14, 15]) + 100 * PICTURE_EVIDENCE.index(name)
        elif name == VERIFIED:  # which sees refined poses alone
            wanted = np.array([0, -1, -2, -3, -14, -15])
        else:
            wanted = np.full(6, names.index(name))
        np.testing.assert_array_equal(column, wanted)
    assert searched == {(4, 2), (4, 2, 1.5, 0.5)}
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
def test_another_verifier_sees_refined_poses_alone(
    tmp_path: Path, network: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, known = tmp_path / "poses.npz", Sources(known_worlds=(Path("known"),))
    made_of = np.array(module._made_of(known, FitOptions(), network))
    store(path, network, (*EVIDENCE[:-1], "another verifier"), made_of=made_of)
    assert EVIDENCE[-1] == VERIFIED
    asked, searches = [], module.searches
    monkeypatch.setattr(module, "searches", lambda *given: asked.append(given[0]) or searches(*given))  # type: ignore[func-returns-value]
    monkeypatch.setattr(module, "picture_evidence", None)  # it is there
    poses = poses_to_fit(known, FitOptions(), network, path)
    np.testing.assert_array_equal(poses["evidence"][:, -1], [0, -1, -2, -3, -14, -15])
    np.testing.assert_array_equal(poses["evidence"][:, :-1], np.tile(np.arange(len(EVIDENCE) - 1), (6, 1)))
    assert asked == [Sources()]  # where no pose is refined, none is looked for


@pytest.mark.usefixtures("searched")
def test_stored_poses_are_judged_anew_if_that_is_asked_for(tmp_path: Path, network: Model) -> None:
    path = tmp_path / "poses.npz"
    store(path, network)
    assert poses_to_fit(Sources(), FitOptions(), network, path)["evidence"][5, 0] == 0
    assert poses_to_fit(Sources(judge_anew=True), FitOptions(), network, path)["evidence"][5, 0] == 15


@pytest.mark.usefixtures("searched")
def test_stored_poses_that_cannot_be_judged_anew_stay(tmp_path: Path, network: Model) -> None:
    path, anew = tmp_path / "poses.npz", Sources(judge_anew=True)
    store(path, network, tuple(name for name in EVIDENCE if name != _OF_CROPS[-1]))
    before = path.read_bytes()
    with pytest.raises(InputError, match=f"lacks {_OF_CROPS[-1]}, which comes of crops"):
        poses_to_fit(Sources(), FitOptions(), network, path)
    assert path.read_bytes() == before
    other_images = {"error": np.array([0.01, 0.01, 0.01, 0.01, 0.3, 0.01])}
    for wrong in ({"object": np.full(6, 7)}, {"search": np.array([0, 0, 0, 0, 1, 2])}, other_images):
        store(path, network, **wrong)
        with pytest.raises(InputError, match="not those that the stored poses were found in"):
            poses_to_fit(anew, FitOptions(), network, path)


@pytest.mark.usefixtures("searched")
def test_poses_that_were_chosen_for_another_share_of_searches_in_vain_are_refused(
    tmp_path: Path, network: Model
) -> None:
    path = tmp_path / "poses.npz"
    store(path, network)
    poses_to_fit(Sources(), FitOptions(), network, path)
    with pytest.raises(InputError, match="holds poses of other bins, weights or settings: remove it"):
        poses_to_fit(Sources(), FitOptions(in_vain=0.3), network, path)


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
    choosable = reported_poses._choosable(poses[usable], evidence[usable])
    few = chosen(choosable, model, motor, DetectConfig(reported=0.0)).kept
    np.testing.assert_array_equal(few, whole[usable])
    assert 0 < few.sum() < len(few)


def test_of_later_turns_detection_sees_what_is_near_an_unsure_pose(motor: DevicePart) -> None:
    """Where the first copy is sure, of the second one a pose of the second turn becomes so, before the third."""
    places, odds = [0.0, 0.02, 5.0, 5.02, 5.04, 0.04], [4.0, 5.0, 0.0, 4.0, 6.0, 7.0]
    turns, exact = np.array([0, 1, 0, 1, 2, -1]), Calibration(EVIDENCE, (1.0,) + (0.0,) * (len(EVIDENCE) - 1), 0.0)
    poses = np.tile(np.eye(4, dtype=np.float32), (6, 1, 1))
    poses[:, 0, 3] = places
    evidence = np.zeros((6, len(EVIDENCE)), dtype=np.float32)
    evidence[:, 0] = odds
    found = reported_poses._choosable(poses, evidence)
    kept, due = reported_poses._chosen_in_turns(found, turns, exact, exact, motor)
    assert due.tolist() == [True, False, True, True, False, False]
    assert kept.tolist() == [True, False, False, True, False, False]
    evidence[2, 0] = -3.0  # nothing stands where the second copy is
    kept, due = reported_poses._chosen_in_turns(found, turns, exact, exact, motor)
    assert due.tolist() == [True, False, True, False, False, False]
    evidence[0, 0], evidence[2, 0] = 2.0, 0.0  # nothing is sure any more
    kept, due = reported_poses._chosen_in_turns(found, turns, exact, exact, motor)
    assert due.tolist() == [True, False, True, False, False, False]
    kept, due = reported_poses._chosen_in_turns(found, np.minimum(turns, 0), exact, exact, motor)
    assert due.tolist() == [True] * 5 + [False]
    assert kept.tolist() == [False, True, False, False, True, False]


@pytest.fixture
def motor() -> DevicePart:
    cloud = box_cloud(0, 128, (1.0, 0.6, 0.4))
    points, normals = jnp.asarray(cloud[:, :3]), jnp.asarray(cloud[:, 3:])
    arrays = PartArrays(points, normals, jnp.zeros((128, 1)), jnp.float32(1.2))
    surfels = Surfels(points, normals, jnp.float32(2.5))
    return DevicePart(arrays, surfels, jnp.eye(4)[None], jnp.float32(0.1), jnp.eye(4)[None], jnp.zeros(1, bool))
