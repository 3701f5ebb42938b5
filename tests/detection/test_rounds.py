"""How long a bin is searched: until seeds are near to all of it, or poses explain it."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import (
    EVIDENCE,
    THOROUGH,
    Calibration,
    CandidateConfig,
    CropFeatures,
    DetectConfig,
    Detections,
    Hypotheses,
    Predictions,
    Probabilities,
    Scene,
    Solver,
    detect,
    make_scene,
    seeds_over,
)
from kmn_jax.detection._candidates import NUM_SEEDS
from kmn_jax.detection._coverage import CoverageConfig
from kmn_jax.errors import InputError
from kmn_jax.models import Model, create_model
from kmn_jax.objects import Part
from kmn_jax.typing import PRNGKey
from tests.detection.box_sample import box_part, box_view
from tests.reference.networks import TINY

SURE = Calibration(EVIDENCE, (0.0,) * len(EVIDENCE), 3.0)
QUICK = DetectConfig()
DIAMETER = 0.8


@pytest.fixture(scope="module")
def model() -> Model:
    return create_model(TINY, jax.random.key(0))


@pytest.fixture(scope="module")
def scene() -> Scene:
    view = box_view()
    return make_scene(view, "m", np.ones(len(view.points), dtype=bool), 131_072)


def answering(found_from: int, real: list[np.ndarray]) -> Solver:
    """Return a solver that remembers the seeds it was asked for and finds a part at each until some round."""

    def solve(part: Part, scene: Scene, crops: CropFeatures, key: PRNGKey) -> tuple[Hypotheses, Predictions]:
        valid = np.asarray(crops.valid)
        real.append(np.asarray(crops.seed)[valid])
        there = jnp.asarray(valid & (len(real) < found_from))[:, None]
        poses = jnp.tile(jnp.eye(4), (len(valid), 1, 1, 1)).at[:, 0, :3, 3].set(crops.seed)
        size = crops.mask.shape[1]
        said = Predictions(crops.mask, jnp.zeros((len(valid), size, len(part.features))))
        return Hypotheses(poses, there, there.astype(jnp.int32), there.astype(jnp.float32)), said

    return solve


def rounds(model: Model, scene: Scene, found_from: int, config: DetectConfig) -> tuple[list[np.ndarray], Detections]:
    asked: list[np.ndarray] = []
    solver = answering(found_from, asked)
    small = replace(box_part(), diameter=DIAMETER)
    return asked, detect(model, Probabilities(SURE, SURE), small, scene, 0, config, solver=solver)


def nearest_seeds(asked: list[np.ndarray], scene: Scene) -> np.ndarray:
    return np.linalg.norm(scene.points[::50, None] - np.concatenate(asked)[None], axis=2).min(axis=1)


def test_a_bin_is_searched_until_a_seed_is_near_to_all_of_it(model: Model, scene: Scene) -> None:
    asked, found = rounds(model, scene, 0, THOROUGH)
    assert len(asked[0]) == NUM_SEEDS
    assert max(len(seeds) for seeds in asked[1:]) == THOROUGH.later_seeds
    seeds = np.concatenate(asked)
    apart = np.linalg.norm(seeds[:, None] - seeds[None], axis=2)[np.triu_indices(len(seeds), 1)]
    assert apart.min() > THOROUGH.coverage.searched_finely * DIAMETER
    # But for a few stray points, and what is between the spacing of seeds and the reach of one.
    assert np.mean(nearest_seeds(asked, scene) <= CandidateConfig().seed_spacing * DIAMETER) > 0.98
    assert not found.warnings
    assert found.reason is not None
    assert f"any of the {len(seeds)} places" in found.reason


def test_where_nothing_is_found_it_is_searched_coarsely(model: Model, scene: Scene) -> None:
    fine, coarse = (rounds(model, scene, 0, config)[0] for config in (THOROUGH, QUICK))
    assert len(np.concatenate(coarse)) < len(np.concatenate(fine))
    assert np.mean(nearest_seeds(coarse, scene) <= 1.1 * QUICK.coverage.searched * DIAMETER) > 0.98
    assert np.isin(np.concatenate(coarse), np.concatenate(fine)).all()  # it only ends earlier


def test_a_search_that_is_given_up_says_so(model: Model, scene: Scene) -> None:
    asked, found = rounds(model, scene, 0, DetectConfig(most_seeds=40, later_seeds=5))
    assert [len(seeds) for seeds in asked] == [NUM_SEEDS, 5, 5]
    assert "of the foreground was not searched" in found.warnings[0]


def test_likely_poses_cover_what_they_explain(model: Model, scene: Scene) -> None:
    nothing, something = (rounds(model, scene, until, THOROUGH)[0] for until in (0, 99))
    assert len(np.concatenate(something)) < len(np.concatenate(nothing))


def test_seeds_are_no_more_than_asked_for_or_needed(scene: Scene) -> None:
    config, part = CandidateConfig(), replace(box_part(), diameter=DIAMETER)
    assert int(seeds_over(scene, scene.foreground, part, config, 7).real.sum()) == 7
    one_point = np.zeros_like(scene.foreground)
    one_point[0] = True
    assert int(seeds_over(scene, one_point, part, config).real.sum()) == 1


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (DetectConfig, {"most_seeds": 0}),
        (DetectConfig, {"later_seeds": 0}),
        (DetectConfig, {"reported": 0.6}),
        (CoverageConfig, {"explained": 0.0}),
        (CoverageConfig, {"searched": 0.1}),
        (CoverageConfig, {"searched_finely": 0.0}),
        (CoverageConfig, {"patience": 0}),
    ],
)
def test_contradictory_values_are_refused(kind: type, values: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(values))):
        kind(**values)
