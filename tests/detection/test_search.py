"""The search as a function of scene, seeds and key: spread, padding, determinism; nothing is ever NaN."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import EVIDENCE, SceneArrays, SearchConfig, Sight, crop_features, search, seed_keys, spread_seeds
from kmn_jax.detection._evidence import evidence_of
from kmn_jax.detection._search import spread_rows
from kmn_jax.detection._verify import VerifyConfig, depth_buffer
from kmn_jax.geometry import Intrinsics
from kmn_jax.models import Model, create_model, encode_object
from kmn_jax.objects import PartArrays
from kmn_jax.pose import RansacConfig
from kmn_jax.simulate import Surfels
from tests.reference.clouds import box_cloud
from tests.reference.networks import TINY

NETWORK = replace(TINY, num_keypoints=6)
CONFIG = SearchConfig(ransac=RansacConfig(num_hypotheses=50, num_candidates=200), normal_points=256)


@pytest.fixture(scope="module")
def model() -> Model:
    return create_model(NETWORK, jax.random.key(0))


@pytest.fixture(scope="module")
def part(model: Model) -> PartArrays:
    cloud = box_cloud(0, 128).astype(np.float32)
    features = encode_object(model, cloud[:64], np.arange(6), np.float32(2)).features
    return PartArrays(jnp.asarray(cloud[:64, :3]), jnp.asarray(cloud[:64, 3:]), features, jnp.float32(2))


def scene(count: int = 700, capacity: int = 1024, seed: int = 0) -> SceneArrays:
    rng = np.random.default_rng(seed)
    points = np.zeros((capacity, 3), dtype=np.float32)
    points[:count] = rng.uniform(-2, 2, (count, 3)) * [1, 1, 0.2] + [0, 0, 6]
    return SceneArrays(jnp.asarray(points), jnp.arange(capacity) < count)


def run(
    model: Model, part: PartArrays, where: SceneArrays, seeds: list[int], real: int | None = None
) -> dict[str, jax.Array]:
    """Return the fields of hypotheses and predictions, and the evidence."""
    rows, flags = jnp.asarray(seeds, "i4"), jnp.arange(len(seeds)) < (len(seeds) if real is None else real)
    one, other = seed_keys(jax.random.key(0), len(seeds))
    crops = crop_features(
        model.graphdef, model.parameters, where, rows, flags, part.diameter, one, CONFIG, num_points=64
    )
    found, said = search(model.graphdef, model.parameters, part, crops, other, CONFIG)
    surfels = Surfels(part.points, part.normals, jnp.float32(10))
    camera = Intrinsics(*(jnp.float32(number) for number in (50, 50, 32, 32, 64, 64)))
    sight = Sight(depth_buffer(where.points, where.mask, camera, (64, 64)), camera)
    proof = evidence_of(found, said, crops, part, surfels, sight, VerifyConfig())
    return found._asdict() | said._asdict() | {"evidence": proof}


def test_seeds_are_candidates_far_from_each_other() -> None:
    where = scene()
    candidates = jnp.asarray(np.asarray(where.points)[:, 0] > 0)
    found, real = spread_seeds(where, candidates, 12)
    seeds = np.asarray(found)
    assert bool(real.all())
    assert bool(candidates[seeds].all())
    assert bool(where.mask[seeds].all())
    points = np.asarray(where.points)[seeds]
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)[~np.eye(12, dtype=bool)]
    chosen = np.asarray(where.points)[np.flatnonzero(candidates & where.mask)]
    holes = np.linalg.norm(chosen[:, None] - points[None], axis=2).min(axis=1).max()
    assert apart.min() >= 0.9 * holes


def test_few_candidates_come_again_and_are_told() -> None:
    where = scene()
    candidates = jnp.zeros(1024, dtype=bool).at[jnp.array([3, 500])].set(True)
    seeds, real = spread_seeds(where, candidates, 5)
    assert set(np.asarray(seeds).tolist()) == {3, 500}
    assert set(np.asarray(seeds)[np.asarray(real)].tolist()) == {3, 500}
    assert int(real.sum()) == 2
    assert not bool(spread_seeds(where, jnp.zeros(1024, dtype=bool), 5)[1].any())


def test_hypotheses_are_finite_and_those_of_their_key(model: Model, part: PartArrays) -> None:
    where = scene()
    found, again = (run(model, part, where, [0, 10, 200]) for _ in range(2))
    for name, value in found.items():
        assert value.shape[0] == 3
        assert bool(jnp.isfinite(value).all()), name
        np.testing.assert_array_equal(value, again[name])
    assert np.allclose(np.linalg.det(np.asarray(found["T_scene_object"])[..., :3, :3]), 1, atol=1e-4)
    np.testing.assert_allclose(found["scores"].sum(axis=2), 1, atol=1e-4)
    evidence = dict(zip(EVIDENCE, np.moveaxis(np.asarray(found["evidence"]), 2, 0), strict=True))
    total = sum(evidence[name] for name in ("explained", "violated", "occluded", "unknown"))
    assert ((np.abs(total - 1) < 1e-3) | (total == 0)).all()  # nothing of a pose behind the sensor is visible
    for name in set(EVIDENCE) - {"log_inliers", "straight"}:
        assert (evidence[name] >= 0).all(), name
        assert (evidence[name] <= 1.001).all(), name


def test_a_seed_among_nothing_gives_no_pose(model: Model, part: PartArrays) -> None:
    points = jnp.zeros((1024, 3)).at[:, 2].set(1.0).at[0].set(jnp.array([50.0, 0, 1]))
    found = run(model, part, SceneArrays(points, jnp.arange(1024) < 1), [0, 0, 0])
    assert not bool(found["found"].any())
    assert bool(jnp.isfinite(found["T_scene_object"]).all())
    assert bool(jnp.isfinite(found["evidence"]).all())


def test_seeds_that_are_not_real_are_skipped(model: Model, part: PartArrays) -> None:
    all_three, first_two = (run(model, part, scene(), [5, 9, 60], real) for real in (3, 2))
    assert bool((all_three["scores"][2] > 0).any())
    assert not bool(first_two["found"][2].any())
    assert not bool(first_two["on_object"][2].any())
    np.testing.assert_array_equal(first_two["T_scene_object"][2], np.tile(np.eye(4), (CONFIG.num_modes, 1, 1)))
    for name, value in all_three.items():
        np.testing.assert_array_equal(value[:2], first_two[name][:2])


def test_padding_changes_nothing(model: Model, part: PartArrays) -> None:
    where = scene()
    rubbish = jnp.where(where.mask[:, None], where.points, 6.0)
    one, other = (run(model, part, where._replace(points=points), [5, 9, 60]) for points in (where.points, rubbish))
    for name, value in one.items():
        np.testing.assert_array_equal(value, other[name])


@pytest.mark.parametrize(("total", "count"), [(5, 8), (700, 512), (307_200, 32_768), (1_900_000, 40_000)])
def test_rows_are_spread_over_large_masks_too(total: int, count: int) -> None:
    """Products of places and totals are beyond 32 bits."""
    mask = np.ones(total + 7, dtype=bool)
    mask[3:10] = False
    rows, real = spread_rows(jnp.asarray(mask), count)
    order = np.flatnonzero(mask)
    assert real.sum() == min(total, count)
    places = np.arange(count, dtype=np.int64) * total // count if total > count else np.arange(total)
    np.testing.assert_array_equal(np.asarray(rows)[np.asarray(real)], order[places])
